"""The towns of the miniature: what their builders built again and again.

Invariant: a place gets its buildings from its town's few families, so that places of one town look alike and only
their arrangement and details tell them apart.
"""

from __future__ import annotations

from dataclasses import dataclass

RGB = tuple[int, int, int]


@dataclass(frozen=True)
class Family:
    """A kind of house: `walls` are its colours, sizes are in metres, `roof` and `pattern` name ways of drawing."""

    walls: tuple[RGB, ...]
    pattern: str  # brick, plaster, stone, panel, timber, glass
    window: str  # sash, shutter, arch, ribbon, french, curtain
    trim: RGB
    accent: RGB  # shutters, doors, railings
    roof: str  # flat, eaves, gable, stepped, mansard
    roof_colour: RGB
    width: tuple[float, float]
    floors: tuple[int, int]
    storey: float
    bay: float  # distance between windows
    shops: float  # share of houses with a shop
    balconies: float = 0.0


@dataclass(frozen=True)
class Town:
    """A town's families (with their shares), its trees, ground and far view."""

    name: str
    code: str
    families: tuple[Family, ...]
    shares: tuple[float, ...]
    trees: tuple[str, ...]
    paving: RGB
    road: RGB
    skyline: tuple[int, int, int, int]  # most of its far towers, widest, lowest and highest of them in metres
    hills: float  # share of places with hills behind
    marking: RGB


BRICK_RED, BRICK_DARK, BRICK_TAN = (150, 84, 66), (104, 66, 58), (178, 132, 98)
HARBOUR = Town(
    "Haverhaven", "HVN",
    (
        Family((BRICK_RED, BRICK_DARK, (128, 72, 60)), "brick", "sash",
               (232, 228, 214), (42, 66, 54), "stepped", (92, 60, 52), (5.2, 7.0), (3, 4), 3.0, 1.9, 0.35),
        Family(((196, 186, 168), (168, 150, 132), (120, 126, 128)), "plaster", "sash",
               (244, 240, 230), (60, 74, 98), "gable", (108, 66, 54), (5.0, 7.4), (2, 4), 3.0, 2.0, 0.4),
        Family((BRICK_DARK, BRICK_TAN), "brick", "arch",
               (206, 196, 176), (70, 44, 40), "eaves", (84, 70, 66), (8.0, 13.0), (2, 3), 3.2, 2.3, 0.3),
        Family(((186, 182, 174), (150, 156, 158)), "panel", "ribbon",
               (210, 212, 212), (190, 96, 52), "flat", (120, 120, 120), (11.0, 16.0), (3, 5), 3.1, 2.6, 0.3),
    ),
    (0.4, 0.3, 0.2, 0.1), ("round", "poplar"), (158, 142, 130), (98, 94, 94), (9, 30, 18, 55), 0.25, (226, 224, 214),
)  # fmt: skip
COAST = Town(
    "Portalba", "PAL",
    (
        Family(((226, 178, 120), (232, 202, 150), (214, 142, 104)), "plaster", "shutter",
               (240, 228, 206), (70, 116, 96), "eaves", (178, 96, 66), (6.5, 10.0), (2, 4), 3.1, 2.4, 0.35, 0.25),
        Family(((238, 230, 214), (230, 214, 196)), "plaster", "shutter",
               (216, 198, 170), (58, 108, 158), "flat", (196, 130, 98), (6.0, 9.0), (2, 3), 3.1, 2.3, 0.3, 0.35),
        Family(((206, 188, 158), (190, 170, 140)), "stone", "arch",
               (226, 212, 186), (104, 66, 42), "eaves", (170, 92, 62), (8.0, 12.0), (2, 3), 3.5, 2.7, 0.4),
        Family(((222, 160, 150), (196, 204, 186)), "plaster", "french",
               (246, 238, 226), (120, 70, 60), "eaves", (182, 104, 74), (7.0, 11.0), (3, 5), 3.0, 2.3, 0.5, 0.6),
    ),
    (0.4, 0.2, 0.15, 0.25), ("cypress", "round", "poplar"), (196, 180, 156), (122, 116, 110),
    (8, 26, 14, 30), 1.0, (232, 230, 222),
)  # fmt: skip
BOULEVARD = Town(
    "Graumont", "GRM",
    (
        Family(((216, 204, 180), (206, 196, 176), (224, 214, 196)), "stone", "french",
               (232, 224, 206), (58, 60, 66), "mansard", (104, 112, 124), (10.0, 15.0), (4, 5), 3.1, 2.2, 0.6, 0.7),
        Family(((198, 186, 164), (188, 178, 162)), "stone", "sash",
               (222, 212, 192), (76, 66, 60), "mansard", (92, 98, 110), (8.0, 12.0), (3, 5), 3.1, 2.1, 0.5, 0.3),
        Family(((188, 150, 122), (176, 134, 108)), "brick", "arch",
               (224, 212, 188), (52, 70, 62), "eaves", (98, 102, 110), (9.0, 13.0), (3, 4), 3.3, 2.4, 0.4, 0.2),
        Family(((158, 166, 172), (176, 178, 176)), "glass", "curtain",
               (120, 128, 134), (54, 60, 66), "flat", (110, 110, 112), (12.0, 18.0), (4, 6), 3.3, 1.6, 0.3),
    ),
    (0.45, 0.3, 0.15, 0.1), ("round", "poplar"), (178, 172, 162), (106, 104, 102), (9, 30, 18, 55), 0.25,
    (230, 230, 226),
)  # fmt: skip
GRID = Town(
    "Eastgate", "EGT",
    (
        Family(((152, 86, 70), (136, 78, 66), (168, 112, 88)), "brick", "sash",
               (200, 190, 172), (50, 48, 50), "flat", (90, 84, 82), (7.0, 10.0), (3, 5), 3.2, 2.0, 0.55),
        Family(((170, 164, 154), (142, 138, 134)), "panel", "ribbon",
               (188, 188, 184), (66, 84, 110), "flat", (96, 96, 96), (12.0, 18.0), (3, 6), 3.4, 2.6, 0.4),
        Family(((122, 140, 152), (104, 120, 134), (140, 150, 150)), "glass", "curtain",
               (90, 100, 110), (40, 44, 50), "flat", (80, 84, 88), (13.0, 20.0), (4, 7), 3.6, 1.7, 0.35),
        Family(((206, 198, 178), (164, 178, 170), (190, 160, 140)), "timber", "sash",
               (240, 240, 232), (94, 58, 50), "gable", (86, 82, 84), (6.5, 9.0), (2, 3), 3.0, 2.2, 0.2),
    ),
    (0.45, 0.2, 0.15, 0.2), ("round", "conifer"), (166, 164, 160), (88, 88, 90), (16, 34, 30, 120), 0.25,
    (222, 186, 70),
)  # fmt: skip
TOWNS = (HARBOUR, COAST, BOULEVARD, GRID)
SIGNS = (
    "CAFE", "BAKERY", "BOOKS", "HOTEL", "PHARMACY", "FLOWERS", "MARKET", "BAR", "TAILOR", "OPTIC", "SHOES", "BANK",
    "RADIO", "FRUIT", "TOYS", "BIKES", "PAPER", "MUSIC", "DELI", "WINE", "FISH", "TEA", "PIZZA", "ART", "HAIR", "KEYS",
)  # fmt: skip
SIGN_COLOURS: tuple[RGB, ...] = (
    (150, 38, 40), (30, 84, 62), (28, 56, 108), (206, 154, 40), (52, 44, 48), (238, 232, 216), (116, 54, 96),
    (40, 120, 136),
)  # fmt: skip


def tone(colour: RGB, factor: float) -> RGB:
    """The colour made lighter or darker."""
    r, g, b = (int(min(c * factor, 255)) for c in colour)
    return r, g, b
