"""A wall's painter: rectangles in metres, masonry and windows, from which facades are made.

Invariant: a `Wall` depends on its building and face alone; its `lights` and `ledges` tell the photo what may shine at
night and where snow lies.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from PIL import Image, ImageChops, ImageDraw, ImageFont

from shards.sources.miniature.styles import RGB, Family

PX = 15  # pixels a metre
Box = tuple[float, float, float, float]


@dataclass
class Wall:
    """A facade's picture (RGB) and outline (L, or None for a full rectangle), `width` x `height` metres."""

    picture: Image.Image
    alpha: Image.Image | None
    width: float
    height: float
    lights: list[Box] = field(default_factory=list)  # windows, in pixels of the picture
    shops: list[Box] = field(default_factory=list)  # shop windows and signs: lit all evening
    ledges: list[tuple[float, float, float]] = field(default_factory=list)  # x0, x1, y where snow rests
    _levels: dict[int, tuple[Image.Image, Image.Image | None]] = field(default_factory=dict)

    def level(self, shrink: int) -> tuple[Image.Image, Image.Image | None]:
        """Picture and outline at 1 / shrink of their size, for walls far away."""
        if shrink not in self._levels:
            alpha = self.alpha.reduce(shrink) if self.alpha is not None else None
            self._levels[shrink] = (self.picture.reduce(shrink), alpha)
        return self._levels[shrink]


@lru_cache(maxsize=4)
def grain(seed: int) -> Image.Image:
    """A 1024 x 512 grey noise around 236 of several sizes, for stains and rough plaster."""
    rng = np.random.default_rng(seed)
    total = np.zeros((512, 1024), dtype=np.float32)
    for cells, weight in ((8, 9.0), (32, 7.0), (128, 5.0), (512, 6.0)):
        coarse = rng.normal(0, weight, (max(cells // 2, 2), cells)).astype(np.float32)
        total += np.asarray(Image.fromarray(coarse).resize((1024, 512), Image.Resampling.BICUBIC))
    return Image.fromarray(np.clip(238 + total, 150, 255).astype(np.uint8))


@lru_cache(maxsize=16)
def lettering(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Pillow's own font, so that pictures do not depend on the machine's fonts."""
    return ImageFont.load_default(size)


def tone(colour: RGB, factor: float, shift: float = 0.0) -> RGB:
    """The colour made lighter or darker."""
    r, g, b = (int(min(max(c * factor + shift, 0), 255)) for c in colour)
    return r, g, b


class Painter:
    """Draws one wall in metres from its lower left corner."""

    def __init__(self, width: float, height: float, colour: RGB) -> None:
        self.width, self.height = width, height
        self.size = (max(int(width * PX), 8), max(int(height * PX), 8))
        self.image = Image.new("RGB", self.size, colour)
        self.draw = ImageDraw.Draw(self.image)
        self.wall = Wall(self.image, None, width, height)

    def box(self, x0: float, y0: float, x1: float, y1: float) -> Box:
        return x0 * PX, (self.height - y1) * PX, x1 * PX, (self.height - y0) * PX

    def rect(self, x0: float, y0: float, x1: float, y1: float, colour: RGB) -> None:
        a, b, c, d = self.box(x0, y0, x1, y1)
        if c > a and d > b:
            self.draw.rectangle((a, b, max(c - 1, a), max(d - 1, b)), fill=colour)

    def poly(self, points: list[tuple[float, float]], colour: RGB) -> None:
        self.draw.polygon([(x * PX, (self.height - y) * PX) for x, y in points], fill=colour)

    def text(self, x: float, y: float, high: float, words: str, colour: RGB) -> None:
        """Words centred at (x, y), `high` metres tall."""
        self.draw.text(
            (x * PX, (self.height - y) * PX), words, fill=colour, font=lettering(max(int(high * PX), 5)), anchor="mm"
        )


@lru_cache(maxsize=16)
def masonry(kind: str) -> Image.Image:
    """A 512 x 512 RGB relief of courses and stains, to multiply a wall's colour with."""
    rng = np.random.default_rng([3, *map(ord, kind)])
    relief = Image.new("L", (512, 512), 255)
    draw = ImageDraw.Draw(relief)
    if kind == "brick":
        for x, y, shade in zip(
            rng.uniform(0, 512, 900), rng.integers(0, 171, 900) * 3, rng.integers(205, 240, 900), strict=True
        ):
            draw.rectangle((x, y, x + 5, y + 1), fill=int(shade))
        for y in range(2, 512, 3):
            draw.line((0, y, 512, y), fill=216)
    elif kind == "stone":
        for row, y in enumerate(range(0, 512, 8)):
            draw.line((0, y, 512, y), fill=214)
            for x in range(9 * (row % 2), 512, 18):
                draw.line((x, y, x, y + 8), fill=222)
    elif kind == "timber":
        for y in range(0, 512, 4):
            draw.line((0, y, 512, y), fill=214)
    noise = grain(len(kind) % 4).crop((0, 0, 512, 512))
    relief = ImageChops.multiply(relief, noise)
    return Image.merge("RGB", (relief, relief, relief))


def pattern(p: Painter, family: Family, colour: RGB, rng: np.random.Generator) -> None:
    """The bare wall: its colour under the family's masonry, with the joints of panels or a plaster's painted foot."""
    w, h = p.width, p.height
    tile = masonry(family.pattern)
    x, y = int(rng.integers(0, 512 - min(p.size[0], 500))), int(rng.integers(0, 512 - min(p.size[1], 500)))
    tile = tile.crop((x, y, x + p.size[0], y + p.size[1])) if max(p.size) <= 500 else tile.resize(p.size)
    p.image.paste(ImageChops.multiply(p.image, tile))
    if family.pattern == "panel":
        for v in np.arange(0, h, family.storey):
            p.rect(0, float(v), w, float(v) + 0.14, tone(colour, 0.78))
        for u in np.arange(0, w, family.bay):
            p.rect(float(u), 0, float(u) + 0.08, h, tone(colour, 0.85))
    elif family.pattern == "plaster" and rng.random() < 0.5:
        p.rect(0, 0, w, float(rng.uniform(0.5, 1.1)), tone(colour, 0.8))


def window(p: Painter, f: Family, x: float, y: float, w: float, h: float, rng: np.random.Generator) -> None:
    """One window with its lower left corner at (x, y)."""
    glass = tone((84, 100, 116), float(rng.uniform(0.6, 1.15)))
    frame = f.trim
    p.rect(x - 0.14, y - 0.1, x + w + 0.14, y + h + 0.14, tone(frame, 0.9))
    p.rect(x - 0.2, y - 0.2, x + w + 0.2, y - 0.06, tone(frame, 1.06))
    p.rect(x, y, x + w, y + h, glass)
    p.rect(x, y + h * 0.55, x + w, y + h, tone(glass, 0.78))
    curtain = rng.random()
    if curtain < 0.3:
        p.rect(x, y + h * 0.4, x + w, y + h, (206, 200, 188))
    elif curtain < 0.5:
        p.rect(x, y, x + w * 0.25, y + h, (190, 184, 176))
        p.rect(x + w * 0.75, y, x + w, y + h, (190, 184, 176))
    p.wall.lights.append(p.box(x, y, x + w, y + h))
    p.wall.ledges.append(((x - 0.2) * PX, (x + w + 0.2) * PX, (p.height - y + 0.1) * PX))
    p.rect(x + w / 2 - 0.05, y, x + w / 2 + 0.05, y + h, frame)
    if f.window == "sash":
        p.rect(x, y + h / 2 - 0.05, x + w, y + h / 2 + 0.05, frame)
    elif f.window == "arch":
        a, b, c, _ = p.box(x - 0.14, y, x + w + 0.14, y + h)
        r = (c - a) / 2
        p.draw.pieslice((a, b - r * 0.9, c, b + r * 0.9), 180, 360, fill=tone(frame, 0.9))
        p.draw.pieslice((a + 3, b - r * 0.9 + 3, c - 3, b + r * 0.9), 180, 360, fill=tone(glass, 0.75))
    elif f.window == "shutter":
        for s in (x - 0.14 - w * 0.48, x + w + 0.14):
            p.rect(s, y - 0.05, s + w * 0.48, y + h + 0.05, f.accent)
            for k in np.arange(y + 0.1, y + h, 0.27):
                p.rect(s + 0.06, k, s + w * 0.48 - 0.06, k + 0.09, tone(f.accent, 0.72))
