"""Facades: flat pictures of walls with windows, doors, shops and signs, later laid on the houses in perspective.

Invariant: a wall depends on its building and face alone; its panes and ledges tell the photo what may shine at night
and where snow lies.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageChops, ImageDraw, ImageFont

from shards.sources.miniature.place import Building
from shards.sources.miniature.towns import RGB, SIGN_COLOURS, SIGNS, tone

PX = 15  # pixels a metre
MANSARD = 2.7  # metres of a storey under a steep roof
GLASS, INK, PAPER = (84, 100, 116), (46, 42, 42), (238, 232, 220)
Box = tuple[float, float, float, float]


class Wall:
    """A wall's picture (RGB), `width` x `height` metres, drawn in metres from its lower left corner.

    `panes` are windows and how likely each is lit after dark; `ledges` (x0, x1, y) carry snow; `alpha` (L) cuts a
    gable out, None is a full rectangle.
    """

    def __init__(self, b: Building, width: float, rise: float, face: int) -> None:
        self.width, self.height, self.family = width, b.height + rise, b.family
        self.rng = np.random.default_rng([b.seed, face])
        self.size = (max(int(width * PX), 8), max(int(self.height * PX), 8))
        self.colour = tone(b.family.walls[b.seed % len(b.family.walls)], 0.93 + 0.14 * (b.seed % 97) / 97)
        x, y = (int(self.rng.integers(0, max(512 - side, 1))) for side in self.size)
        tile = masonry(b.family.pattern).crop((x, y, x + self.size[0], y + self.size[1]))
        self.picture = ImageChops.multiply(Image.new("RGB", self.size, self.colour), tile)
        self.draw = ImageDraw.Draw(self.picture)
        self.alpha: Image.Image | None = None
        self.panes: list[tuple[Box, float]] = []
        self.ledges: list[tuple[float, float, float]] = []

    def box(self, x0: float, y0: float, x1: float, y1: float) -> Box:
        """Left, top, right, bottom in pixels."""
        return x0 * PX, (self.height - y1) * PX, x1 * PX, (self.height - y0) * PX

    def rect(self, x0: float, y0: float, x1: float, y1: float, colour: RGB) -> None:
        a, b, c, d = self.box(x0, y0, x1, y1)
        if c > a and d > b:
            self.draw.rectangle((a, b, max(c - 1, a), max(d - 1, b)), fill=colour)

    def disc(self, x: float, y: float, r: float, colour: RGB, start: int = 0) -> None:
        """A disc, or with a `start` of 180 its upper half."""
        self.draw.pieslice(self.box(x - r, y - r, x + r, y + r), start, 360, fill=colour)

    def pane(self, x0: float, y0: float, x1: float, y1: float, colour: RGB, lit: float = 0.36) -> None:
        """A window's glass, lit after dark with this chance."""
        if x1 > x0:
            self.rect(x0, y0, x1, y1, colour)
            self.panes.append((self.box(x0, y0, x1, y1), lit))

    def window(self, x: float, y: float, w: float, h: float) -> None:
        """One window with its lower left corner at (x, y)."""
        f, rng = self.family, self.rng
        glass, curtain = tone(GLASS, float(rng.uniform(0.6, 1.15))), rng.random()
        self.rect(x - 0.14, y - 0.2, x + w + 0.14, y + h + 0.14, tone(f.trim, 0.95))
        self.pane(x, y, x + w, y + h, glass)
        self.rect(x, y + h * 0.55, x + w, y + h, tone(glass, 0.78))
        if curtain < 0.4:
            self.rect(x, y + h * 0.4, x + w * (1 if curtain < 0.25 else 0.3), y + h, (206, 200, 188))
        self.ledges.append((x - 0.2, x + w + 0.2, y - 0.1))
        self.rect(x + w / 2 - 0.05, y, x + w / 2 + 0.05, y + h, f.trim)
        if f.window == "sash":
            self.rect(x, y + h / 2 - 0.05, x + w, y + h / 2 + 0.05, f.trim)
        elif f.window == "arch":
            self.disc(x + w / 2, y + h, w / 2 + 0.14, tone(f.trim, 0.9), 180)
            self.disc(x + w / 2, y + h, w / 2 - 0.06, tone(glass, 0.75), 180)
        elif f.window == "shutter":
            for s in (x - 0.14 - w * 0.48, x + w + 0.14):
                self.rect(s, y - 0.05, s + w * 0.48, y + h + 0.05, f.accent)

    def cut(self, edge: list[tuple[float, float]]) -> None:
        """Takes away what lies above a line from the left to the right edge, and draws its coping."""
        line = [(x * PX, (self.height - y) * PX) for x, y in edge]
        self.alpha = Image.new("L", self.size, 255)
        ImageDraw.Draw(self.alpha).polygon([(0, 0), *line, (self.size[0], 0)], fill=0)
        self.draw.line(line, fill=tone(self.family.trim, 0.95), width=5)


def blotches(rng: np.random.Generator, shape: tuple[int, int], octaves: dict[int, float]) -> NDArray[np.float64]:
    """Smooth noise of this shape: the sum of grids of so many rows, each with its strength."""
    total, (high, wide) = np.zeros(shape), shape
    for rows, strength in octaves.items():
        coarse = Image.fromarray(rng.normal(0, strength, (rows, rows * wide // high)).astype(np.float32))
        total += np.asarray(coarse.resize((wide, high), Image.Resampling.BICUBIC))
    return total


@lru_cache(maxsize=8)
def masonry(kind: str) -> Image.Image:
    """512 x 512 pixels of courses and stains."""
    relief = 238 + blotches(np.random.default_rng([3, *map(ord, kind)]), (512, 512), {8: 9.0, 32: 7.0, 512: 6.0})
    course = {"brick": 3, "stone": 8, "timber": 4}.get(kind, 512)
    relief[::course] *= 0.85
    for row in range(0, 512, course) if kind == "stone" else ():
        relief[row : row + course, 9 * (row // course % 2) :: 18] *= 0.88
    return Image.fromarray(relief.clip(120, 255).astype(np.uint8)).convert("RGB")


lettering = lru_cache(maxsize=16)(ImageFont.load_default)  # Pillow's own font: pictures do not depend on the machine


def front(b: Building, width: float) -> Wall:
    """The full face of a house, with its gable or mansard."""
    f, up = b.family, b.height
    rise = {"gable": width * 0.5, "stepped": width * 0.5 + 0.6, "mansard": MANSARD}.get(f.roof, 0.0)
    wall = Wall(b, width, {"": rise, "church": width * 0.55, "tower": 0.0}[b.landmark], 1)
    if b.landmark:
        _landmark(wall, up, b.landmark == "church")
        return wall
    count = max(int((width - 0.8) / f.bay), 1)
    step = (width - 0.8) / count
    bays = [0.4 + (k + 0.5) * step for k in range(count)]  # their middles
    for floor in range(1, b.floors):
        _storey(wall, floor * f.storey, bays, step)
    _ground(wall, bays, step)
    if f.roof in ("gable", "stepped"):
        _gable(wall, up, rise)
        return wall
    wall.rect(0, up - 0.35, width, up, tone(f.trim, 0.85))
    wall.ledges.append((0, width, up))
    wall.rect(0, up, width, up + rise, f.tiles)
    for x in bays if f.roof == "mansard" else ():
        wall.rect(x - 0.75, up + 0.3, x + 0.75, up + 2.2, tone(f.trim, 0.95))
        wall.pane(x - 0.5, up + 0.4, x + 0.5, up + 1.9, GLASS)
    return wall


def side(b: Building, width: float) -> Wall:
    """A plain side wall with few windows."""
    wall = Wall(b, width, MANSARD if b.family.roof == "mansard" and not b.landmark else 0.0, 2)
    wall.rect(0, b.height, width, wall.height, b.family.tiles)
    for floor in range(b.floors):
        for x in np.arange(1.6, width - 1.6, b.family.bay * 2).tolist():
            if wall.rng.random() < 0.35:
                wall.window(x, floor * b.family.storey + 1.2, 0.9, 1.4)
    return wall


def _storey(wall: Wall, y: float, bays: list[float], step: float) -> None:
    """The windows of an upper storey whose floor is at y, with its balcony."""
    f, rng, w, tall = wall.family, wall.rng, wall.width, wall.family.window == "french"
    if f.window in ("curtain", "ribbon"):  # glass from wall to wall
        low, top = (y + 0.5, y + f.storey - 0.1) if f.window == "curtain" else (y + 0.9, y + 2.3)
        wall.rect(0.2, low - 0.2, w - 0.2, top, tone(f.trim, 0.9))
        for x in bays:
            glass = tone((142, 160, 170) if rng.random() < 0.35 else (96, 122, 142), float(rng.uniform(0.75, 1.15)))
            wall.pane(x - step / 2 + 0.06, low, x + step / 2 - 0.06, top, glass)
        return
    wide, high = min(step * 0.5, 1.15), (2.2 if tall else 1.55)
    for x in bays:
        wall.window(x - wide / 2, y + (0.25 if tall else 0.85), wide, high)
    if rng.random() < f.railed:
        wall.rect(0.2, y - 0.05, w - 0.2, y + 0.2, tone(f.trim, 0.75))
        wall.rect(0.2, y + 1.0, w - 0.2, y + 1.1, f.accent)
        for x in np.arange(0.2, w - 0.2, 0.27).tolist():
            wall.rect(x, y + 0.2, x + 0.07, y + 1.0, f.accent)


def _ground(wall: Wall, bays: list[float], step: float) -> None:
    """A door, and a shop with its sign or plain windows."""
    f, rng, w, top = wall.family, wall.rng, wall.width, wall.family.storey
    door, paint = float(rng.choice([0.7, w - 1.9, w / 2 - 0.6])), SIGN_COLOURS[int(rng.integers(len(SIGN_COLOURS)))]
    if rng.random() < f.shops and w > 4.5:
        wall.rect(0.2, 0, w - 0.2, top - 0.15, tone(paint, 0.8) if rng.random() < 0.6 else tone(f.trim, 0.7))
        wall.pane(0.5, 0.5, door - 0.25, top - 1.05, (70, 82, 90), 0.85)
        wall.pane(door + 1.45, 0.5, w - 0.5, top - 1.05, (70, 82, 90), 0.85)
        wall.rect(0.2, top - 0.95, w - 0.2, top - 0.2, paint)
        word = str(rng.choice(SIGNS))
        font = lettering(max(int(min(0.62, (w - 1.0) / (0.62 * len(word))) * PX), 5))
        at, ink = (w / 2 * PX, (wall.height - top + 0.6) * PX), PAPER if sum(paint) < 420 else INK
        wall.draw.text(at, word, fill=ink, font=font, anchor="mm")
        if rng.random() < 0.45:  # an awning
            for k, x in enumerate(np.arange(0.2, w - 0.5, 0.6).tolist()):
                wall.rect(x, top - 1.6, x + 0.6, top - 0.95, PAPER if k % 2 else paint)
    else:
        for x in bays:
            if abs(x - door - 0.55) > 1.5:
                wall.window(x - 0.55, 1.0, min(1.1, step * 0.55), 1.4)
    wall.rect(door - 0.15, 0, door + 1.3, 2.5, tone(f.trim, 0.85))
    wall.rect(door, 0, door + 1.15, 2.3, f.accent if rng.random() < 0.6 else paint)


def _gable(wall: Wall, eave: float, rise: float) -> None:
    """Cuts the wall's top into a triangle or steps, with the attic's window."""
    w, top = wall.width, eave + rise - 0.05
    wall.window(w / 2 - 0.45, eave + rise * 0.12, 0.9, min(1.3, rise * 0.45))
    left = [(0.0, eave)]
    for k in range(1, 6) if wall.family.roof == "stepped" else ():
        high = eave + k * (top - eave) / 5
        left += [(left[-1][0], high), (w * 0.5 * k / 5.8, high)]
    wall.cut([*left, (w / 2, top), *[(w - x, y) for x, y in reversed(left)]])


def _landmark(wall: Wall, eave: float, church: bool) -> None:
    """A church's portal, rose window and gable, or a tower's windows under its clock."""
    f, middle, y = wall.family, wall.width / 2, 6.6 if church else eave - 3.2
    for x, low in ((-0.64, 2.6), (0.38, 2.6)) if church else [(-0.17, float(v)) for v in np.arange(3.5, y - 3, 4)]:
        wall.window(middle * (1 + x), low, middle * 0.26, 2.4)
    wall.pane(middle - 0.6, y - 0.6, middle + 0.6, y + 0.6, GLASS, 0.85)
    wall.disc(middle, y, 1.4, tone(f.trim, 0.9))
    wall.disc(middle, y, 1.15, (72, 66, 96) if church else PAPER)
    if church:
        wall.rect(middle - 1.5, 0, middle + 1.5, 3.2, tone(f.trim, 0.9))
        wall.rect(middle - 1.1, 0, middle + 1.1, 2.9, f.accent)
        wall.cut([(0, eave), (middle, wall.height), (wall.width, eave)])
    else:
        wall.rect(middle - 0.07, y, middle + 0.07, y + 0.95, INK)  # the clock's hands
        wall.rect(middle, y - 0.07, middle + 0.7, y + 0.07, INK)
        wall.rect(0, eave - 0.4, wall.width, eave - 0.1, tone(f.trim, 0.9))
