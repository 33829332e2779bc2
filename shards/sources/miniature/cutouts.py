"""Trees, vehicles, people and street furniture as small cut-out pictures.

Invariant: a cut-out depends on its arguments alone and is drawn once a process.
"""

from __future__ import annotations

import math
from functools import cached_property, lru_cache

import numpy as np
from PIL import Image, ImageDraw

from shards.sources.miniature.towns import RGB, tone

Box = tuple[float, float, float, float]
LEAVES: dict[str, tuple[RGB, RGB, RGB]] = {
    "spring": ((122, 158, 74), (142, 172, 88), (216, 176, 186)),
    "summer": ((62, 106, 50), (76, 120, 56), (54, 96, 52)),
    "autumn": ((196, 124, 46), (176, 84, 40), (206, 164, 62)),
}
EVERGREENS: dict[str, RGB] = {"conifer": (52, 84, 58), "cypress": (52, 84, 58)}
TREES = {"round": 140, "poplar": 76, "cypress": 50, "conifer": 90}  # width in pixels of 180 pixels high
PAINTS: tuple[RGB, ...] = (
    (186, 190, 194), (44, 48, 54), (150, 34, 36), (40, 70, 122), (232, 232, 228),
    (92, 98, 92), (196, 168, 66), (64, 110, 92),
)  # fmt: skip
GLASS, BLACK, IRON, WOOD = (46, 56, 66), (26, 26, 28), (52, 56, 58), (120, 84, 56)


class Cutout:
    """A picture with its outline; `lights` are boxes in pixels that shine at night."""

    def __init__(self, width: int, height: int, base: RGB) -> None:
        self._image = Image.new("RGBA", (width, height), (*base, 0))  # the border keeps the base's colour when reduced
        self.draw = ImageDraw.Draw(self._image)
        self.ratio = width / height
        self.lights: list[Box] = []

    @cached_property
    def layers(self) -> tuple[Image.Image, Image.Image]:
        """Picture (RGB) and outline (L)."""
        return self._image.convert("RGB"), self._image.getchannel("A")


@lru_cache(maxsize=256)
def tree(species: str, season: str, snow: bool, variant: int) -> Cutout:
    """A tree 180 pixels high, foot at the bottom centre."""
    rng = np.random.default_rng([variant, *map(ord, species)])
    high, wide, bare = 180, TREES[species], season == "winter" and species not in EVERGREENS
    leaf = EVERGREENS.get(species) or LEAVES.get(season, LEAVES["summer"])[variant % 3]
    made, bark, middle = Cutout(wide, high, (84, 72, 62) if bare else leaf), (92, 76, 62), wide / 2

    made.draw.line((middle, high, middle, high * 0.43), fill=bark, width=7)
    for a, r in rng.uniform((-2.6, 0.3), (-0.5, 1), (60, 2)).tolist():  # branches, seen in winter
        tip = middle + wide * 0.42 * r * math.cos(a), high * 0.55 + high * 0.45 * r * math.sin(a)
        elbow = (middle + tip[0]) / 2, (high * 0.6 + tip[1]) / 2 - 8 * r
        twig = (226, 230, 236) if snow else tone(bark, 0.8 + 0.4 * r)
        made.draw.line((middle, high * 0.62, *elbow, *tip), fill=twig, width=2 if r > 0.6 else 3)
    leaves = 0 if bare else 420
    for k, (a, r, size, shade) in enumerate(rng.uniform((0, 0, 2.6, -0.1), (6.28, 1, 6.4, 0.1), (leaves, 4)).tolist()):
        across, up = math.sqrt(r) * math.cos(a), math.sqrt(r) * math.sin(a)
        x, y = middle + across * wide * 0.42, high * 0.4 + up * high * 0.36
        if species == "conifer":
            across, up = math.cos(a), 2 * r - 1
            x, y = middle + across * wide * (0.03 + 0.43 * r), high * (0.04 + 0.84 * r)
        # lit from above, newest leaves in front
        colour = tone(leaf, min(max(0.72 + 0.5 * k / leaves - 0.28 * up + shade, 0.5), 1.35))
        colour = (236, 240, 246) if snow and k % 3 == 0 else colour
        made.draw.ellipse((x - size, y - size * 0.8, x + size, y + size * 0.8), fill=colour)
    return made


VEHICLES = {"car": (4.3, 1.5), "van": (5.2, 2.2), "bus": (10.5, 3.0)}  # length and height in metres
# outline of body and windows, and the middles of the wheels, in shares of length and height; all drive right
BODIES = {
    "car": ((0, 0.86), (0.01, 0.5), (0.1, 0.42), (0.26, 0.04), (0.66, 0.02), (0.82, 0.42), (0.98, 0.54), (1, 0.86)),
    "van": ((0, 0.86), (0, 0.06), (0.72, 0.04), (0.93, 0.46), (1, 0.6), (1, 0.86)),
    "bus": ((0, 0.9), (0, 0.06), (0.02, 0), (0.98, 0), (1, 0.06), (1, 0.9)),
}
WINDOWS = {
    "car": [
        ((0.2, 0.4), (0.29, 0.1), (0.46, 0.09), (0.46, 0.4)),
        ((0.49, 0.4), (0.49, 0.09), (0.64, 0.09), (0.77, 0.4)),
    ],
    "van": [((0.74, 0.46), (0.74, 0.16), (0.79, 0.2), (0.9, 0.46))],
    "bus": [((x, 0.16), (x + 0.12, 0.16), (x + 0.12, 0.5), (x, 0.5)) for x in np.linspace(0.03, 0.85, 7).tolist()],
}


@lru_cache(maxsize=128)
def vehicle(kind: str, paint: int, rear: bool) -> Cutout:
    """A vehicle from its side (driving right) or its rear, 40 pixels a metre."""
    length, high = VEHICLES[kind]
    w, h = int((min(length, high * 1.1) if rear else length) * 40), int(high * 40)
    body = ((176, 40, 40), (40, 96, 150), (220, 176, 60))[paint % 3] if kind == "bus" else PAINTS[paint]
    made = Cutout(w, h, body)
    shape = lambda points, colour: made.draw.polygon([(x * w, y * h) for x, y in points], fill=colour)  # noqa: E731
    if rear:
        shape(((0.08, 0.8), (0.92, 0.8), (0.92, 1.0), (0.08, 1.0)), BLACK)
        shape(((0.04, 0.92), (0.02, 0.5), (0.14, 0), (0.86, 0), (0.98, 0.5), (0.96, 0.92)), body)
        shape(((0.16, 0.42), (0.22, 0.08), (0.78, 0.08), (0.84, 0.42)), GLASS)
        made.lights = [(x * w, 0.52 * h, (x + 0.15) * w, 0.62 * h) for x in (0.05, 0.8)]
    else:
        shape(BODIES[kind], body)
        for window in WINDOWS[kind]:
            shape(window, GLASS)
        for x in (0.2, 0.8):
            for r, colour in ((13, BLACK), (6, (150, 150, 152))):
                made.draw.ellipse((x * w - r, h - 14 - r, x * w + r, h - 14 + r), fill=colour)
        made.lights = [(0, h * 0.56, w * 0.03, h * 0.66), (w * 0.96, h * 0.58, w, h * 0.68)]
        made.draw.rectangle(made.lights[1], fill=(236, 230, 206))
    for lamp in made.lights[: 2 if rear else 1]:
        made.draw.rectangle(lamp, fill=(176, 32, 30))
    return made


@lru_cache(maxsize=64)
def person(variant: int) -> Cutout:
    """Someone walking, 88 pixels high."""
    made, rng = Cutout(64, 88, (70, 66, 66)), np.random.default_rng([variant, 5])
    coat, legs, skin = (
        tone((r, g, b), 1) for r, g, b in rng.integers((30, 25, 100), (200, 90, 200), (3, 3)).T.tolist()
    )
    made.draw.polygon(((27, 50), (37, 50), (42, 87), (38, 87), (32, 60), (26, 87), (22, 87)), fill=legs)
    made.draw.polygon(((24, 28), (28, 24), (36, 24), (40, 28), (39, 56), (25, 56)), fill=coat)
    made.draw.ellipse((27, 13, 37, 25), fill=skin)
    return made


# width, height in pixels, and boxes with their colour (None: the thing's own paint), drawn in order
FURNITURE: dict[str, tuple[int, int, tuple[tuple[Box, RGB | None], ...]]] = {
    "lamp": (40, 180, (((18, 20, 22, 180), IRON), ((10, 2, 30, 6), IRON), ((11, 5, 29, 23), (214, 214, 206)))),
    "bench": (120, 60, (((4, 10, 116, 22), WOOD), ((4, 30, 116, 38), WOOD), ((14, 10, 19, 60), IRON),
                        ((101, 10, 106, 60), IRON))),
    "roadsign": (40, 150, (((18, 30, 22, 150), IRON), ((2, 2, 38, 38), None), ((9, 14, 31, 26), (236, 236, 236)))),
    "kiosk": (130, 150, (((10, 30, 120, 150), None), ((2, 18, 128, 34), IRON), ((20, 50, 110, 100), GLASS))),
}  # fmt: skip


@lru_cache(maxsize=64)
def furniture(kind: str, variant: int) -> Cutout:
    """Lamps, benches, signs, kiosks and hedges."""
    if kind == "hedge":
        wide, rng = 60 * (variant + 4), np.random.default_rng(variant)
        made = Cutout(wide, 60, (62, 92, 54))
        for x, y, f in rng.uniform((0, 14, 0.7), (wide, 60, 1.2), (wide // 5, 3)).tolist():
            made.draw.ellipse((x - 9, y - 9, x + 9, y + 9), fill=tone((62, 92, 54), f))
        return made
    width, height, parts = FURNITURE[kind]
    made = Cutout(width, height, IRON)
    for box, colour in parts:
        made.draw.rounded_rectangle(box, min(box[2] - box[0], 40) / 4, fill=colour or PAINTS[variant])
    made.lights = [parts[-1][0]] if kind in ("lamp", "kiosk") else []
    return made
