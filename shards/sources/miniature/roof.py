"""Roofs: the slopes of a house and their covers of tiles, slates or snow.

Invariant: the slopes depend on the building alone; snow belongs to the photo.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw

from shards.sources.miniature.camera import Array, Surface
from shards.sources.miniature.painter import PX, tone
from shards.sources.miniature.place import Building
from shards.sources.miniature.styles import RGB


def slopes(b: Building) -> list[Surface]:
    """The slopes of a house's roof that can be seen from a street in front of it."""
    wide, deep, up = b.x1 - b.x0, b.z1 - b.z0, b.height
    roof = b.family.roof
    if b.landmark == "tower":
        return []
    if roof in ("eaves", "mansard"):
        rise, run = (3.0, 1.4) if roof == "mansard" else (min(wide, deep) * 0.28, min(wide, deep) / 2)
        return [
            Surface((b.x0 + run, up + rise, b.z0 + run), (wide - 2 * run, 0, 0), (0, -rise, -run)) if roof == "hip"
            else Surface((b.x0, up + rise, b.z0 + run), (wide, 0, 0), (0, -rise, -run)),
            Surface((b.x1 - run, up + rise, b.z0), (0, 0, deep), (run, -rise, 0)),
            Surface((b.x0 + run, up + rise, b.z1), (0, 0, -deep), (-run, -rise, 0)),
        ][: 1 if "south" in b.fronts and len(b.fronts) == 1 else 3]  # fmt: skip
    if roof == "gable" and b.fronts[0] == "south":
        rise = wide * 0.5
        return [
            Surface((b.x0 + wide / 2, up + rise, b.z0), (0, 0, deep), (wide / 2, -rise, 0)),
            Surface((b.x0 + wide / 2, up + rise, b.z1), (0, 0, -deep), (-wide / 2, -rise, 0)),
        ]
    return []


@lru_cache(maxsize=64)
def _cover(colour: RGB, wide: int, deep: int, snow: bool, dormers: int, seed: int) -> Image.Image:
    image = Image.new("RGB", (wide, deep), colour)
    draw = ImageDraw.Draw(image)
    if not snow:
        for y in range(0, deep, 5):
            draw.line((0, y, wide, y), fill=tone(colour, 0.82), width=1)
    for k in range(dormers):
        x = (k + 0.5) * wide / dormers
        draw.rectangle((x - 11, deep * 0.25, x + 11, deep * 0.85), fill=(226, 218, 202))
        draw.rectangle((x - 7, deep * 0.35, x + 7, deep * 0.82), fill=(72, 84, 98))
        draw.line((x, deep * 0.35, x, deep * 0.82), fill=(226, 218, 202), width=2)
    return image


def cover(b: Building, colour: RGB, wide: float, deep: float, snow: bool) -> Image.Image:
    """The tiles (or the snow) of a roof's slope, `wide` x `deep` metres, with a mansard's dormers."""
    dormers = max(int(wide / b.family.bay / 1.3), 1) if b.family.roof == "mansard" else 0
    return _cover(colour, max(int(wide * PX), 8), max(int(deep * PX), 8), snow, dormers, 0)


def stacks(b: Building) -> list[tuple[Array, RGB]]:
    """Chimneys, aerials and water tanks: upright polygons [n, 3] with their colours, to be drawn before the roof."""
    rng = np.random.default_rng([b.seed, 23])
    wide, up, found = b.x1 - b.x0, b.height, []
    if b.landmark == "tower":
        mid, half, z = (b.x0 + b.x1) / 2, wide / 2 + 0.2, (b.z0 + b.z1) / 2
        spire = [(mid - half, up - 0.1, z), (mid, up + wide * 1.5, z), (mid + half, up - 0.1, z)]
        return [(np.array(spire), (92, 118, 112))]
    if "south" not in b.fronts or b.landmark:
        return []
    for _ in range(int(rng.integers(0, 3))):
        x, z = b.x0 + 0.4 + float(rng.random()) * max(wide - 1.6, 0), b.z0 + float(rng.uniform(2.5, 5))
        rise = {"flat": 1.3, "mansard": 4.6}.get(b.family.roof, min(wide, 9) * 0.28 + 1.4)
        box = [(x, up - 0.5, z), (x, up + rise, z), (x + 0.8, up + rise, z), (x + 0.8, up - 0.5, z)]
        found.append((np.array(box), tone((150, 96, 80), float(rng.uniform(0.7, 1.1)))))
    if b.family.roof == "flat" and b.floors > 2 and wide > 6 and rng.random() < 0.4:
        x, z, r = b.x0 + 1 + float(rng.random()) * (wide - 5), b.z0 + 4.0, 1.4
        legs = [(x + 0.3, up, z), (x + 0.3, up + 1.6, z), (x + 2 * r - 0.3, up + 1.6, z), (x + 2 * r - 0.3, up, z)]
        tank = [(x, up + 1.5, z), (x, up + 4, z), (x + r, up + 5, z), (x + 2 * r, up + 4, z), (x + 2 * r, up + 1.5, z)]
        found += [(np.array(legs), (70, 64, 60)), (np.array(tank), (124, 94, 72))]
    return found
