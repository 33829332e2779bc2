"""The towns of the miniature: what their builders built again and again.

Invariant: a place gets its buildings from its town's few families, so that places of one town look alike and only
their arrangement and details tell them apart.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

RGB = tuple[int, int, int]
# colours in hexadecimal, sizes in metres, ranges as least-most; shops, railed: share of houses, of storeys
FAMILIES = """
town share walls                   pattern window  trim    accent  roof    tiles   width  floors storey bay shops railed
HVN  0.4   #965442/#68423a/#80483c brick   sash    #e8e4d6 #2a4236 stepped #5c3c34 5.2-7  3-4    3      1.9 0.35  0
HVN  0.3   #c4baa8/#a89684/#787e80 plaster sash    #f4f0e6 #3c4a62 gable   #6c4236 5-7.4  2-4    3      2   0.4   0
HVN  0.2   #68423a/#b28462         brick   arch    #cec4b0 #462c28 eaves   #544642 8-13   2-3    3.2    2.3 0.3   0
HVN  0.1   #bab6ae/#969c9e         panel   ribbon  #d2d4d4 #be6034 flat    #787878 11-16  3-5    3.1    2.6 0.3   0
PAL  0.4   #e2b278/#e8ca96/#d68e68 plaster shutter #f0e4ce #467460 eaves   #b26042 6.5-10 2-4    3.1    2.4 0.35  0.25
PAL  0.2   #eee6d6/#e6d6c4         plaster shutter #d8c6aa #3a6c9e flat    #c48262 6-9    2-3    3.1    2.3 0.3   0.35
PAL  0.15  #cebc9e/#beaa8c         stone   arch    #e2d4ba #68422a eaves   #aa5c3e 8-12   2-3    3.5    2.7 0.4   0
PAL  0.25  #dea096/#c4ccba         plaster french  #f6eee2 #78463c eaves   #b6684a 7-11   3-5    3      2.3 0.5   0.6
GRM  0.45  #d8ccb4/#cec4b0/#e0d6c4 stone   french  #e8e0ce #3a3c42 mansard #68707c 10-15  4-5    3.1    2.2 0.6   0.7
GRM  0.3   #c6baa4/#bcb2a2         stone   sash    #ded4c0 #4c423c mansard #5c626e 8-12   3-5    3.1    2.1 0.5   0.3
GRM  0.15  #bc967a/#b0866c         brick   arch    #e0d4bc #34463e eaves   #62666e 9-13   3-4    3.3    2.4 0.4   0.2
GRM  0.1   #9ea6ac/#b0b2b0         glass   curtain #788086 #363c42 flat    #6e6e70 12-18  4-6    3.3    1.6 0.3   0
EGT  0.45  #985646/#884e42/#a87058 brick   sash    #c8beac #323032 flat    #5a5452 7-10   3-5    3.2    2   0.55  0
EGT  0.2   #aaa49a/#8e8a86         panel   ribbon  #bcbcb8 #42546e flat    #606060 12-18  3-6    3.4    2.6 0.4   0
EGT  0.15  #7a8c98/#687886/#8c9696 glass   curtain #5a646e #282c32 flat    #505458 13-20  4-7    3.6    1.7 0.35  0
EGT  0.2   #cec6b2/#a4b2aa/#bea08c timber  sash    #f0f0e8 #5e3a32 gable   #565254 6.5-9  2-3    3      2.2 0.2   0
"""
# towers: at most so many far ones, the widest, the lowest and the highest of them; hills: share of places with a ridge
GROUNDS = """
town name       trees                paving  road    marking towers       hills
HVN  Haverhaven round/poplar         #9e8e82 #625e5e #e2e0d6 9-30-18-55   0.25
PAL  Portalba   cypress/round/poplar #c4b49c #7a746e #e8e6de 8-26-14-30   1
GRM  Graumont   round/poplar         #b2aca2 #6a6866 #e6e6e2 9-30-18-55   0.25
EGT  Eastgate   round/conifer        #a6a4a0 #58585a #deba46 16-34-30-120 0.25
"""


@dataclass(frozen=True)
class Family:
    """A kind of house, a row of `FAMILIES`; `pattern`, `window` and `roof` name ways of drawing."""

    town: str
    share: float
    walls: tuple[RGB, ...]
    pattern: str
    window: str
    trim: RGB
    accent: RGB  # shutters, doors, railings
    roof: str
    tiles: RGB
    width: tuple[float, float]
    floors: tuple[int, int]
    storey: float
    bay: float  # between the middles of two windows
    shops: float
    railed: float


@dataclass(frozen=True)
class Town:
    """A row of `GROUNDS` and the town's families: what all its places share."""

    town: str
    name: str
    trees: tuple[str, ...]
    paving: RGB
    road: RGB
    marking: RGB
    towers: tuple[int, int, int, int]
    hills: float
    families: list[Family]


def _cell(text: str) -> Any:
    if "/" in text or "-" in text:
        return tuple(_cell(part) for part in re.split("[/-]", text))
    if text[0] == "#":
        return tuple(bytes.fromhex(text[1:]))
    return (float(text) if "." in text else int(text)) if text[0].isdigit() else text


def _rows(table: str) -> list[dict[str, Any]]:
    head, *rows = (line.split() for line in table.strip().splitlines())
    return [dict(zip(head, map(_cell, row), strict=True)) for row in rows]


_FAMILIES = [Family(**row) for row in _rows(FAMILIES)]
TOWNS = [Town(**row, families=[f for f in _FAMILIES if f.town == row["town"]]) for row in _rows(GROUNDS)]
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
