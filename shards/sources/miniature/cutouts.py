"""Trees, vehicles, people and street furniture as small cut-out pictures.

Invariant: a cut-out depends on its arguments alone and is drawn once a process.
"""

from __future__ import annotations

import math
from functools import cached_property, lru_cache

import numpy as np
from PIL import Image, ImageDraw

from shards.sources.miniature.towns import RGB, tone

LEAVES: dict[str, tuple[RGB, RGB, RGB]] = {
    "spring": ((122, 158, 74), (142, 172, 88), (216, 176, 186)),
    "summer": ((62, 106, 50), (76, 120, 56), (54, 96, 52)),
    "autumn": ((196, 124, 46), (176, 84, 40), (206, 164, 62)),
}
EVERGREEN: RGB = (52, 84, 58)
TREES = {"round": 140, "poplar": 76, "cypress": 50, "conifer": 90, "bush": 300}  # width in pixels of 180 pixels high
PAINTS: tuple[RGB, ...] = (
    (186, 190, 194), (44, 48, 54), (150, 34, 36), (40, 70, 122), (232, 232, 228),
    (92, 98, 92), (196, 168, 66), (64, 110, 92),
)  # fmt: skip
GLASS, BLACK, IRON, WOOD, RED = (46, 56, 66), (26, 26, 28), (52, 56, 58), (120, 84, 56), (176, 32, 30)
STEEL, PALE = (150, 150, 152), (226, 222, 206)
# Width and height in centimetres, then what is drawn in this order: Pillow's name of the shape, its colour (None: the
# thing's own paint), whether it shines after dark, and its coordinates from the upper left corner. Vehicles look right.
Part = tuple[str, RGB | None, bool, tuple[float, ...]]
THINGS: dict[str, tuple[int, int, tuple[Part, ...]]] = {
    "car": (430, 150, (
        ("polygon", None, False, (0, 129, 4, 75, 43, 63, 112, 6, 284, 3, 353, 63, 421, 81, 430, 129)),
        ("polygon", GLASS, False, (86, 60, 125, 15, 198, 14, 198, 60)),
        ("polygon", GLASS, False, (211, 60, 211, 14, 275, 14, 331, 60)),
        ("ellipse", BLACK, False, (54, 84, 118, 148)), ("ellipse", STEEL, False, (71, 101, 101, 131)),
        ("ellipse", BLACK, False, (312, 84, 376, 148)), ("ellipse", STEEL, False, (329, 101, 359, 131)),
        ("rectangle", RED, True, (0, 84, 13, 99)), ("rectangle", PALE, True, (413, 87, 430, 102)))),
    "van": (520, 220, (
        ("polygon", None, False, (0, 189, 0, 13, 374, 9, 484, 101, 520, 132, 520, 189)),
        ("polygon", GLASS, False, (385, 101, 385, 35, 411, 44, 468, 101)),
        ("ellipse", BLACK, False, (72, 154, 136, 218)), ("ellipse", STEEL, False, (89, 171, 119, 201)),
        ("ellipse", BLACK, False, (384, 154, 448, 218)), ("ellipse", STEEL, False, (401, 171, 431, 201)),
        ("rectangle", RED, True, (0, 123, 16, 145)), ("rectangle", PALE, True, (499, 128, 520, 150)))),
    "bus": (1050, 300, (
        ("polygon", None, False, (0, 270, 0, 18, 21, 0, 1030, 0, 1050, 18, 1050, 270)),
        *(("rectangle", GLASS, False, (x, 48, x + 126, 150)) for x in range(32, 900, 143)),
        ("ellipse", BLACK, False, (178, 234, 242, 298)), ("ellipse", STEEL, False, (195, 251, 225, 281)),
        ("ellipse", BLACK, False, (808, 234, 872, 298)), ("ellipse", STEEL, False, (825, 251, 855, 281)),
        ("rectangle", RED, True, (0, 168, 20, 198)), ("rectangle", PALE, True, (1030, 174, 1050, 204)))),
    "rear": (180, 160, (
        ("rectangle", BLACK, False, (14, 128, 166, 160)),
        ("polygon", None, False, (7, 147, 4, 80, 25, 0, 155, 0, 176, 80, 173, 147)),
        ("polygon", GLASS, False, (29, 67, 40, 13, 140, 13, 151, 67)),
        ("rectangle", RED, True, (9, 83, 36, 99)), ("rectangle", RED, True, (144, 83, 171, 99)))),
    "person": (60, 175, (
        ("polygon", GLASS, False, (16, 95, 44, 95, 50, 175, 38, 175, 30, 115, 20, 175, 8, 175)),
        ("polygon", None, False, (12, 50, 20, 32, 40, 32, 48, 50, 46, 105, 14, 105)),
        ("ellipse", (196, 150, 124), False, (19, 5, 41, 31)))),
    "lamp": (100, 530, (
        ("rectangle", IRON, False, (45, 50, 55, 530)), ("rectangle", IRON, False, (22, 4, 78, 16)),
        ("ellipse", PALE, True, (22, 14, 78, 70)))),
    "bench": (180, 90, (
        ("rectangle", WOOD, False, (6, 15, 174, 33)), ("rectangle", WOOD, False, (6, 45, 174, 57)),
        ("rectangle", IRON, False, (20, 15, 28, 90)), ("rectangle", IRON, False, (152, 15, 160, 90)))),
    "roadsign": (70, 260, (
        ("rectangle", IRON, False, (31, 52, 39, 260)), ("ellipse", None, False, (2, 2, 68, 68)),
        ("rectangle", PALE, False, (14, 25, 56, 45)))),
    "kiosk": (234, 270, (
        ("rectangle", None, False, (18, 54, 216, 270)), ("rectangle", IRON, False, (4, 32, 230, 61)),
        ("rectangle", GLASS, True, (36, 90, 198, 180)))),
}  # fmt: skip


class Cutout:
    """A picture with its outline; `lights` are boxes in pixels that shine at night."""

    def __init__(self, width: int, height: int, base: RGB) -> None:
        self._image = Image.new("RGBA", (width, height), (*base, 0))  # the border keeps the base's colour when reduced
        self.draw = ImageDraw.Draw(self._image)
        self.ratio = width / height
        self.lights: list[list[float]] = []

    @cached_property
    def layers(self) -> tuple[Image.Image, Image.Image]:
        """Picture (RGB) and outline (L)."""
        return self._image.convert("RGB"), self._image.getchannel("A")


@lru_cache(maxsize=256)
def thing(kind: str, variant: int) -> Cutout:
    """A key of `THINGS` in one of eight paints, 40 pixels a metre."""
    (width, height, parts), paint = THINGS[kind], PAINTS[variant]
    made = Cutout(int(width * 0.4), int(height * 0.4), paint)
    for shape, colour, shines, places in parts:
        pixels = [0.4 * place for place in places]
        getattr(made.draw, shape)(pixels, fill=colour or paint)
        made.lights += [pixels] if shines else []
    return made


@lru_cache(maxsize=256)
def tree(species: str, season: str, snow: bool, variant: int) -> Cutout:
    """A tree or bush 180 pixels high, foot at the bottom centre."""
    rng, evergreen = np.random.default_rng([variant, *map(ord, species)]), species in ("conifer", "cypress", "bush")
    high, wide, bare = 180, TREES[species], season == "winter" and not evergreen
    leaf = EVERGREEN if evergreen else LEAVES.get(season, LEAVES["summer"])[variant % 3]
    made, bark, middle = Cutout(wide, high, (84, 72, 62) if bare else leaf), (92, 76, 62), wide / 2
    made.draw.line((middle, high, middle, high * 0.43), fill=bark, width=7)
    for a, r in rng.uniform((-2.6, 0.3), (-0.5, 1), (60 if bare else 0, 2)).tolist():
        tip = middle + wide * 0.42 * r * math.cos(a), high * 0.55 + high * 0.45 * r * math.sin(a)
        elbow = (middle + tip[0]) / 2, (high * 0.6 + tip[1]) / 2 - 8 * r
        twig = (226, 230, 236) if snow else tone(bark, 0.8 + 0.4 * r)
        made.draw.line((middle, high * 0.62, *elbow, *tip), fill=twig, width=2 if r > 0.6 else 3)
    leaves = 0 if bare else 420
    for k, (a, r, size, shade) in enumerate(rng.uniform((0, 0, 2.6, -0.1), (6.28, 1, 6.4, 0.1), (leaves, 4)).tolist()):
        across, up = math.sqrt(r) * math.cos(a), math.sqrt(r) * math.sin(a)
        x, y = middle + across * wide * 0.42, high * (0.4 + up * 0.36)
        if species == "conifer":
            x, y, up = middle + math.cos(a) * wide * (0.03 + 0.43 * r), high * (0.04 + 0.84 * r), 2 * r - 1
        elif species == "bush":
            y, size = high * (0.6 + up * 0.36), size * 2
        # lit from above, newest leaves in front
        colour = tone(leaf, min(max(0.72 + 0.5 * k / leaves - 0.28 * up + shade, 0.5), 1.35))
        colour = (236, 240, 246) if snow and k % 3 == 0 else colour
        made.draw.ellipse((x - size, y - size * 0.8, x + size, y + size * 0.8), fill=colour)
    return made
