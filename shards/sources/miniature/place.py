"""A place of the miniature: its houses, trees and furniture, made from its seed alone.

Invariant: everything here is the place's identity; hours, seasons, traffic and cameras are added by the photo.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shards.sources.miniature.styles import TOWNS, Family, Town


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
    """A tree, lamp, sign, bench, hedge or statue standing at (x, z), `size` metres high."""

    kind: str
    x: float
    z: float
    size: float
    variant: int


@dataclass(frozen=True)
class Place:
    """Everything that stays: `kind` is row, crossing, avenue or square; `view` the heading photographers choose."""

    town: Town
    kind: str
    buildings: tuple[Building, ...]
    things: tuple[Thing, ...]
    skyline: tuple[tuple[float, float, float, float], ...]  # bearing (rad), width (m), height (m), distance (m)
    hills: tuple[float, ...]  # phases of the far ridge; empty without hills
    kerb: float  # distance of the road's edge from the axis, metres
    front: float  # distance of the houses' line from the axis, metres
    gap: tuple[float, float] | None  # a side street's edges along the row, metres
    zebra: float | None  # where a crossing lies along the street
    view: float  # radians
    heading: float  # compass bearing of +z, degrees


def make_place(town: int, seed: tuple[int, ...]) -> Place:
    """The place with this seed in this town."""
    rng = np.random.default_rng(seed)
    style = TOWNS[town]
    kind = str(rng.choice(["row", "crossing", "avenue", "square"], p=[0.36, 0.26, 0.24, 0.14]))
    heading = float(rng.uniform(0, 360))
    front = {"row": rng.uniform(17, 22), "crossing": rng.uniform(17, 21), "avenue": rng.uniform(8, 11)}.get(
        kind, rng.uniform(26, 34)
    )
    buildings: list[Building] = []
    gap = None
    if kind == "avenue":
        for side in (-1, 1):
            _line(buildings, rng, style, -14.0, 100.0, float(front), side)
        if rng.random() < 0.55:
            _landmark(buildings, rng, style, 0.0, 104.0)
    else:
        if kind == "crossing":
            middle, wide = float(rng.uniform(-8, 8)), float(rng.uniform(8, 12))
            gap = (middle - wide / 2, middle + wide / 2)
        _row(buildings, rng, style, float(front), gap)
        if gap:
            for side, edge in ((-1, gap[0]), (1, gap[1])):
                _line(buildings, rng, style, float(front) + 16.0, 100.0, abs(edge), side, shift=edge)
        if kind == "square":
            _landmark(buildings, rng, style, float(rng.uniform(-7, 7)), float(front) - float(rng.uniform(0, 4)))
    things = _furnish(rng, style, kind, float(front), gap)
    skyline = tuple(
        (float(rng.uniform(-1.6, 1.6)), float(w), float(h), float(rng.uniform(180, 420)))
        for w, h in _silhouettes(rng, style.skyline)
    )
    hills = tuple(rng.uniform(0, 6.28, 4).tolist()) if style.skyline == "hills" or rng.random() < 0.25 else ()
    view = float(rng.uniform(-0.45, 0.45)) if kind != "avenue" else float(rng.uniform(-0.22, 0.22))
    if gap:
        view = float(np.arctan2((gap[0] + gap[1]) / 2 * 0.6, front)) + float(rng.uniform(-0.2, 0.2))
    kerb = float(front) - float(rng.uniform(2.8, 4.5)) if kind != "square" else 11.0
    zebra = float(rng.uniform(-9, 9)) if rng.random() < 0.35 else None
    return Place(
        style, kind, tuple(buildings), tuple(things), skyline, hills, kerb, float(front), gap, zebra, view, heading
    )


def _house(rng: np.random.Generator, style: Town) -> tuple[Family, float, int, float]:
    family = style.families[int(rng.choice(len(style.families), p=style.shares))]
    floors = int(rng.integers(family.floors[0], family.floors[1] + 1))
    return family, float(rng.uniform(*family.width)), floors, floors * family.storey + 0.9


def _row(
    out: list[Building], rng: np.random.Generator, style: Town, front: float, gap: tuple[float, float] | None
) -> None:
    """Houses side by side along x, facing the camera (south)."""
    spans = [(-62.0, gap[0]), (gap[1], 62.0)] if gap else [(-62.0, 62.0)]
    for start, end in spans:
        x = start
        while end - x > 4.5:
            family, width, floors, height = _house(rng, style)
            width = min(width, end - x) if end - x - width > 4.5 else end - x
            width = min(width, family.width[1] * 1.25)
            setback = float(rng.choice([0.0, 0.0, 0.0, 0.6, 1.5, 3.0]))
            if gap:  # corner houses show both faces to the streets
                fronts: tuple[str, ...] = (
                    ("south", "east", "west") if abs(x + width - gap[0]) < 1 or abs(x - gap[1]) < 1 else ("south",)
                )
            else:
                fronts = ("south",)
            depth = float(rng.uniform(10, 15))
            out.append(
                Building(x, x + width, front + setback, front + setback + depth, height, family, floors,
                         int(rng.integers(1 << 31)), fronts, mural=bool(rng.random() < 0.08))
            )  # fmt: skip
            x += width
            if not gap and rng.random() < 0.14:
                x += float(rng.uniform(2.0, 5.0))


def _line(
    out: list[Building], rng: np.random.Generator, style: Town, z: float, end: float, edge: float, side: int,
    shift: float | None = None,
) -> None:  # fmt: skip
    """Houses along z on one side of a street that runs away from the camera."""
    face = "east" if side < 0 else "west"
    while z < end:
        family, width, floors, height = _house(rng, style)
        setback = float(rng.choice([0.0, 0.0, 0.0, 0.8, 2.0]))
        at = shift if shift is not None else side * edge
        near, far = at + side * setback, at + side * (setback + 12.0)
        out.append(
            Building(min(near, far), max(near, far), z, z + width, height, family, floors,
                     int(rng.integers(1 << 31)), (face,), mural=bool(rng.random() < 0.05))
        )  # fmt: skip
        z += width + (float(rng.uniform(2, 6)) if rng.random() < 0.12 else 0.0)


def _landmark(out: list[Building], rng: np.random.Generator, style: Town, x: float, z: float) -> None:
    """A church or a town hall's tower, built of the town's most solemn family."""
    family = style.families[2]
    seed = int(rng.integers(1 << 31))
    nave, high, width = float(rng.uniform(9, 12)), float(rng.uniform(18, 28)), float(rng.uniform(4.5, 6))
    kept = [
        b
        for b in out
        if b.x1 < x - nave / 2 - width - 1 or b.x0 > x + nave / 2 + width + 1 or b.z0 > z + 12 or b.z1 < z - 2
    ]
    out[:] = kept
    out.append(
        Building(
            x - nave / 2, x + nave / 2, z, z + 16, float(rng.uniform(8, 11)), family, 1, seed, ("south",), "church"
        )
    )
    left = x - nave / 2 - width if rng.random() < 0.5 else x + nave / 2
    out.append(
        Building(
            left, left + width, z - 0.5, z - 0.5 + width, high, family, 4, seed + 1, ("south", "west", "east"), "tower"
        )
    )


def _silhouettes(rng: np.random.Generator, kind: str) -> list[tuple[float, float]]:
    if kind == "towers":
        return [(rng.uniform(14, 34), rng.uniform(30, 120)) for _ in range(int(rng.integers(8, 16)))]
    if kind == "spires":
        return [(rng.uniform(5, 30), rng.uniform(18, 55)) for _ in range(int(rng.integers(3, 9)))]
    return [(rng.uniform(10, 26), rng.uniform(14, 30)) for _ in range(int(rng.integers(3, 8)))]


def _furnish(
    rng: np.random.Generator, style: Town, kind: str, front: float, gap: tuple[float, float] | None
) -> list[Thing]:
    """Trees, lamps and small things on the pavements."""
    things: list[Thing] = []
    pick = lambda: style.trees[int(rng.integers(len(style.trees)))]  # noqa: E731
    if kind == "avenue":
        for side in (-1, 1):
            if rng.random() < 0.6:
                species, step = pick(), float(rng.uniform(8, 13))
                for z in np.arange(float(rng.uniform(13, 18)), 90, step):
                    if rng.random() < 0.85:
                        things.append(
                            Thing(
                                species,
                                side * (front - 2.4),
                                float(z + rng.uniform(-1, 1)),
                                float(rng.uniform(5, 8.5)),
                                int(rng.integers(4)),
                            )
                        )
            for z in np.arange(float(rng.uniform(10, 16)), 90, 22.0):
                things.append(Thing("lamp", side * (front - 3.2), float(z), 5.5, 0))
    else:
        if rng.random() < 0.75:
            species, line = pick(), front - float(rng.uniform(1.8, 3.2))
            for x in rng.uniform(-26, 26, int(rng.integers(2, 6))):
                if gap is None or not gap[0] < x < gap[1]:
                    things.append(Thing(species, float(x), line, float(rng.uniform(4.5, 8.5)), int(rng.integers(4))))
        for x in np.arange(float(rng.uniform(-24, -14)), 26, 15.0):
            things.append(Thing("lamp", float(x), front - 3.4, 5.2, 0))
        if rng.random() < 0.4:
            things.append(Thing("hedge", float(rng.uniform(-14, 10)), front - 0.9, 1.1, int(rng.integers(4, 10))))
        for _ in range(int(rng.integers(1, 4))):
            what = str(rng.choice(["bench", "roadsign", "postbox", "bollards", "kiosk"], p=[0.3, 0.25, 0.15, 0.2, 0.1]))
            things.append(
                Thing(
                    what, float(rng.uniform(-14, 14)), front - float(rng.uniform(1.2, 3.2)), 1.0, int(rng.integers(8))
                )
            )
        if kind == "square":
            things.append(
                Thing(
                    "statue",
                    float(rng.uniform(-8, 8)),
                    front - float(rng.uniform(7, 13)),
                    float(rng.uniform(4, 6)),
                    int(rng.integers(4)),
                )
            )
    return things
