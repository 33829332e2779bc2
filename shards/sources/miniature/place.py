"""A street of the miniature: its houses, trees and furniture, made from its seed alone.

Invariant: everything here is the identity of the street's places; hours, seasons, traffic and cameras belong to photos.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from shards.sources.miniature.towns import TOWNS, Family, Town

REACH = 62.0  # metres of houses built to either side of where photographers stand
FRONTS = {"row": (17, 22), "crossing": (17, 21), "avenue": (8, 11), "square": (26, 34)}  # metres, axis to houses
HEIGHTS = {"lamp": (5.2, 5.5), "bench": (0.9, 0.9), "roadsign": (2.6, 2.6), "kiosk": (2.7, 2.7), "bush": (1.0, 1.4)}
SMALL, SHARES = ("bench", "roadsign", "kiosk", "bush"), (0.32, 0.32, 0.12, 0.24)


@dataclass(frozen=True)
class Building:
    """A box on the ground, in metres; `fronts` are its faces with the full facade (south, west, east)."""

    x0: float
    x1: float
    z0: float
    z1: float
    height: float
    family: Family
    floors: int
    seed: int
    fronts: tuple[str, ...]
    landmark: str = ""  # church, tower or nothing


@dataclass(frozen=True)
class Thing:
    """A tree, lamp, sign, bench, kiosk or bush standing at (x, z), `size` metres high."""

    kind: str
    x: float
    z: float
    size: float
    variant: int


@dataclass
class Place:
    """A street, `length` metres of which are photographed: along x, or along z for an avenue.

    Args:
        kind: a key of `FRONTS`; view: the heading photographers choose, in radians from +z.
        kerb, front: metres from the street's axis to the road's edge and to the houses.
        gaps: both edges of each side street, in metres along the row; zebras: where one may cross it.
        skyline: bearing (radians), width, height, distance (metres); hills: phases of the far ridge, if any.
    """

    town: Town
    kind: str
    length: float
    front: float
    kerb: float
    view: float
    gaps: list[tuple[float, float]] = field(default_factory=list)
    zebras: list[float] = field(default_factory=list)
    buildings: list[Building] = field(default_factory=list)
    things: list[Thing] = field(default_factory=list)
    skyline: list[list[float]] = field(default_factory=list)
    hills: list[float] = field(default_factory=list)

    def spot(self, across: float, along: float) -> tuple[float, float]:
        """x and z of a point by its metres across and along the street."""
        return (across, along) if self.kind == "avenue" else (along, across)


def kind_of(seed: tuple[int, ...], length: float) -> str:
    """row, crossing, avenue or square; a street of several places is no square."""
    shares = [0.4, 0.35, 0.25, 0.0] if length else [0.36, 0.26, 0.24, 0.14]
    return str(np.random.default_rng(seed).choice(list(FRONTS), p=shares))


def make_place(town: int, seed: tuple[int, ...], length: float = 0.0) -> Place:
    """The street with this seed in this town; with a length of 0 it is a single place."""
    rng, style, kind = np.random.default_rng([*seed, 1]), TOWNS[town], kind_of(seed, length)
    front, walk, view, zebra = rng.uniform(
        (FRONTS[kind][0], 2.8, -1, -9), (FRONTS[kind][1], 4.5, 1, 9 + length)
    ).tolist()
    place = Place(style, kind, length, front, 11.0 if kind == "square" else front - walk, view * 0.45)
    if kind == "avenue":
        place.view, zebra = view * 0.22, zebra + 14
        for side, face in ((-1, "east"), (1, "west")):
            _houses(place, rng, -14.0, 100.0 + length, side * front, face)
        if rng.random() < 0.55:
            _church(place, rng, 0.0, 104.0 + length)
    else:
        middle = float(rng.uniform(-8, 8)) if kind == "crossing" else REACH + length
        while middle < REACH + length:
            half = float(rng.uniform(4, 6))
            place.gaps.append((middle - half, middle + half))
            middle += float(rng.uniform(45, 75)) if length else 2 * REACH
        edges = [-REACH, *[edge for gap in place.gaps for edge in gap], REACH + length]
        for start, end in zip(edges[::2], edges[1::2], strict=True):
            _houses(place, rng, start, end, front, "south")
        for left, right in place.gaps:
            _houses(place, rng, front + 16.0, 100.0, left, "east")
            _houses(place, rng, front + 16.0, 100.0, right, "west")
            if not length:
                place.view = float(np.arctan2((left + right) * 0.3, front)) + view * 0.2
        if kind == "square":
            _church(place, rng, float(rng.uniform(-7, 7)), front - float(rng.uniform(0, 4)))
    place.zebras = [zebra] if rng.random() < 0.35 else []
    _furnish(place, rng)
    most, widest, lowest, highest = style.towers
    low, high = (-1.6, widest / 3, lowest, 180), (1.6, widest, highest, 420)
    place.skyline = rng.uniform(low, high, (int(rng.integers(most // 2, most)), 4)).tolist()
    place.hills = rng.uniform(0, 6.28, 3).tolist() if rng.random() < style.hills else []
    return place


def _houses(place: Place, rng: np.random.Generator, at: float, end: float, line: float, face: str) -> None:
    """Houses from `at` to `end`: along x at z = `line`, facing the camera (south), or along z at x = `line`."""
    while end - at > 4.5:
        families = place.town.families
        family = families[int(rng.choice(len(families), p=[f.share for f in families]))]
        width, floors = float(rng.uniform(*family.width)), int(rng.integers(family.floors[0], family.floors[1] + 1))
        width = min(width if end - at - width > 4.5 else end - at, family.width[1] * 1.25)
        back, deep = float(rng.choice([0.0, 0.0, 0.0, 0.8, 2.0])), float(rng.uniform(10, 15))
        fronts: tuple[str, ...] = (face,)
        if face == "south":
            box = (at, at + width, line + back, line + back + deep)
            if any(abs(at + width - a) < 1 or abs(at - b) < 1 for a, b in place.gaps):
                fronts = ("south", "east", "west")  # at a corner
        else:
            x0, x1 = sorted((line + back, line + back + deep) if face == "west" else (line - back, line - back - deep))
            box = (x0, x1, at, at + width)
        height = floors * family.storey + 0.9
        place.buildings.append(Building(*box, height, family, floors, int(rng.integers(1 << 31)), fronts))
        at += width + (float(rng.uniform(2.0, 5.0)) if not place.gaps and rng.random() < 0.13 else 0.0)


def _church(place: Place, rng: np.random.Generator, x: float, z: float) -> None:
    """A church with its tower, built of the town's most solemn family, in place of the houses there."""
    nave, width, high, eaves = rng.uniform((9, 4.5, 18, 8), (12, 6, 28, 11)).tolist()
    half, family, seed = nave / 2, place.town.families[2], int(rng.integers(1 << 31))
    reach = half + width + 1
    place.buildings = [b for b in place.buildings if b.x1 < x - reach or b.x0 > x + reach or b.z0 > z + 12 or b.z1 < z]
    left = x - half - width if rng.random() < 0.5 else x + half
    tower = (left, left + width, z - 0.5, z - 0.5 + width, high, family, 4, seed + 1, ("south", "west", "east"))
    church = Building(x - half, x + half, z, z + 16, eaves, family, 1, seed, ("south",), "church")
    place.buildings += [church, Building(*tower, "tower")]


def _furnish(place: Place, rng: np.random.Generator) -> None:
    """Trees of one species, lamps and small things on the pavements."""
    avenue, tree = place.kind == "avenue", str(rng.choice(place.town.trees))
    first, last = (10.0, 80.0 + place.length) if avenue else (-26.0, 26.0 + place.length)
    share = (last - first) / 52
    for side in (-1, 1) if avenue else (1,):
        lamps = np.arange(first + float(rng.uniform(0, 8)), last, 16.0)
        trees = rng.uniform(first, last, int(rng.integers(0, 6) * share))
        small = rng.uniform(first, last, int(rng.integers(2, 7) * share))
        found = [(tree, 2.4, at) for at in trees] + [("lamp", 3.4, at) for at in lamps]
        for kind, back, at in found + [(str(rng.choice(SMALL, p=SHARES)), rng.uniform(0.9, 3.2), at) for at in small]:
            x, z = place.spot(side * (place.front - float(back)), float(at))
            size, variant = float(rng.uniform(*HEIGHTS.get(kind, (4.5, 8.5)))), int(rng.integers(8))
            if not any(a < x < b for a, b in place.gaps):
                place.things.append(Thing(kind, x, z, size, variant))
