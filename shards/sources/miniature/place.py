"""A street of the miniature: its houses, trees and furniture, made from its seed alone.

Invariant: everything here is the identity of the street's places; hours, seasons, traffic and cameras belong to photos.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from shards.sources.miniature.towns import TOWNS, Family, Town

REACH = 62.0  # metres of houses built to either side of where photographers stand
FRONTS = {"row": (17, 22), "crossing": (17, 21), "avenue": (8, 11), "square": (26, 34)}  # metres, axis to houses
HEIGHTS = {"lamp": (5.2, 5.5), "bench": (0.9, 0.9), "roadsign": (2.6, 2.6), "kiosk": (2.7, 2.7), "hedge": (1.1, 1.1)}


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
    mural: bool = False


@dataclass(frozen=True)
class Thing:
    """A tree, lamp, sign, bench, kiosk or hedge standing at (x, z), `size` metres high."""

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


def kind_of(seed: tuple[int, ...], length: float) -> str:
    """row, crossing, avenue or square; a street of several places is no square."""
    shares = [0.4, 0.35, 0.25, 0.0] if length else [0.36, 0.26, 0.24, 0.14]
    return str(np.random.default_rng(seed).choice(list(FRONTS), p=shares))


def make_place(town: int, seed: tuple[int, ...], length: float = 0.0) -> Place:
    """The street with this seed in this town; with a length of 0 it is a single place."""
    rng, style, kind = np.random.default_rng([*seed, 1]), TOWNS[town], kind_of(seed, length)
    front, kerb, view, zebra = rng.uniform(
        (FRONTS[kind][0], 2.8, -1, -9), (FRONTS[kind][1], 4.5, 1, 9 + length)
    ).tolist()
    kerb = 11.0 if kind == "square" else front - kerb
    view *= 0.22 if kind == "avenue" else 0.45
    place = Place(style, kind, length, front, kerb, view, zebras=[zebra] if rng.random() < 0.35 else [])
    if kind == "avenue":
        for side, face in ((-1, "east"), (1, "west")):
            _houses(place, rng, -14.0, 100.0 + length, side * front, face)
        if rng.random() < 0.55:
            _landmark(place, rng, 0.0, 104.0 + length)
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
                place.view = float(np.arctan2((left + right) * 0.3, front)) + view * 0.45
        if kind == "square":
            _landmark(place, rng, float(rng.uniform(-7, 7)), front - float(rng.uniform(0, 4)))
    _furnish(place, rng)
    most, widest, lowest, highest = style.skyline
    low, high = (-1.6, widest / 3, lowest, 180), (1.6, widest, highest, 420)
    place.skyline = rng.uniform(low, high, (int(rng.integers(most // 2, most)), 4)).tolist()
    if rng.random() < style.hills:
        place.hills = rng.uniform(0, 6.28, 3).tolist()
    return place


def _houses(place: Place, rng: np.random.Generator, at: float, end: float, line: float, face: str) -> None:
    """Houses from `at` to `end`: along x at z = `line`, facing the camera (south), or along z at x = `line`."""
    while end - at > 4.5:
        family = place.town.families[int(rng.choice(len(place.town.families), p=place.town.shares))]
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
        seed, mural = int(rng.integers(1 << 31)), bool(rng.random() < 0.07)
        height = floors * family.storey + 0.9
        place.buildings.append(Building(*box, height, family, floors, seed, fronts, mural=mural))
        at += width + (float(rng.uniform(2.0, 5.0)) if not place.gaps and rng.random() < 0.13 else 0.0)


def _landmark(place: Place, rng: np.random.Generator, x: float, z: float) -> None:
    """A church with its tower, built of the town's most solemn family, in place of the houses there."""
    nave, width, high, eaves = rng.uniform((9, 4.5, 18, 8), (12, 6, 28, 11)).tolist()
    half = nave / 2 + width + 1
    place.buildings = [
        b for b in place.buildings if b.x1 < x - half or b.x0 > x + half or b.z0 > z + 12 or b.z1 < z - 2
    ]
    left = x - nave / 2 - width if rng.random() < 0.5 else x + nave / 2
    family, seed = place.town.families[2], int(rng.integers(1 << 31))
    church = Building(x - nave / 2, x + nave / 2, z, z + 16, eaves, family, 1, seed, ("south",), "church")
    z, faces = z - 0.5, ("south", "west", "east")
    place.buildings += [church, Building(left, left + width, z, z + width, high, family, 4, seed + 1, faces, "tower")]


def _furnish(place: Place, rng: np.random.Generator) -> None:
    """Trees, lamps and small things on the pavements."""
    front, end, trees = place.front, place.length, place.town.trees

    def put(kind: str, x: float, z: float) -> None:
        size = float(rng.uniform(*HEIGHTS.get(kind, (4.5, 8.5))))
        place.things.append(Thing(kind, float(x), float(z), size, int(rng.integers(8))))

    tree = trees[int(rng.integers(len(trees)))]
    if place.kind == "avenue":
        for side in (-1, 1):
            for z in np.arange(float(rng.uniform(13, 18)), 90 + end, float(rng.uniform(8, 13))):
                if rng.random() < 0.5:
                    put(tree, side * (front - 2.4), z)
            for z in np.arange(float(rng.uniform(10, 16)), 70 + end, 22.0):
                put("lamp", side * (front - 3.2), z)
        return
    for x in rng.uniform(-26, 26 + end, int(rng.integers(0, 6) * (1 + end / 52))):
        if not any(a < x < b for a, b in place.gaps):
            put(tree, x, front - 2.4)
    for x in np.arange(float(rng.uniform(-24, -14)), 26 + end, 15.0):
        put("lamp", x, front - 3.4)
    for x in rng.uniform(-14, 14 + end, int(rng.integers(1, 5) * (1 + end / 28))):
        put(str(rng.choice(list(HEIGHTS)[1:], p=[0.32, 0.32, 0.12, 0.24])), x, front - float(rng.uniform(0.9, 3.2)))
