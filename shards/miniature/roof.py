"""Roofs: the slopes of a house and their covers of tiles, slates or snow.

Invariant: the slopes depend on the building alone; snow belongs to the photo.
"""

from __future__ import annotations

from functools import lru_cache

from PIL import Image, ImageDraw

from shards.miniature.camera import Surface
from shards.miniature.painter import PX, tone
from shards.miniature.place import Building
from shards.miniature.styles import RGB


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
