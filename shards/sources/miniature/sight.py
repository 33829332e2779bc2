"""Which houses a camera can see: the rest are not painted.

Invariant: errs on the side of drawing; leaving a house out never changes a photo.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from shards.sources.miniature.camera import NEAR, Camera
from shards.sources.miniature.place import Building

COLUMNS = 48
MARGIN = 5.0  # pixels, more than the roll of a camera moves a roof


def in_sight(camera: Camera, buildings: Sequence[Building]) -> list[tuple[float, Building]]:
    """Distance (metres, nearest first) and house for those not off the picture or wholly behind nearer ones."""
    near_first = sorted(((_distance(camera, b), b) for b in buildings), key=lambda item: item[0])
    skyline = np.full(COLUMNS, np.inf)  # row of the nearest houses' eaves in every column of the picture
    step = camera.width / COLUMNS
    c, s = math.cos(camera.yaw), math.sin(camera.yaw)
    kept = []
    for distance, b in near_first:
        feet = [(x - camera.x, z - camera.z) for x in (b.x0, b.x1) for z in (b.z0, b.z1)]
        depths = [s * x + c * z for x, z in feet]
        if max(depths) < 1.0:
            continue
        if min(depths) < NEAR:
            kept.append((distance, b))
            continue
        us = [camera.width / 2 + camera.focal * (c * x - s * z) / d for (x, z), d in zip(feet, depths, strict=True)]
        left, right = (min(us) - MARGIN) / step, (max(us) + MARGIN) / step
        if right <= 0 or left >= COLUMNS:
            continue
        wide = b.x1 - b.x0
        crown = b.height + (wide * 1.5 if b.landmark == "tower" else max(wide * 0.6, 6.0)) - camera.y
        top = camera.horizon - camera.focal * crown / min(depths) - MARGIN
        first, last = max(math.floor(left), 0), min(math.ceil(right), COLUMNS)
        if bool((skyline[first:last] <= top).all()):
            continue
        kept.append((distance, b))
        eaves = camera.horizon - camera.focal * (b.height - camera.y) / max(depths) + MARGIN
        inner = slice(max(math.ceil((min(us) + MARGIN) / step), 0), max(math.floor((max(us) - MARGIN) / step), 0))
        skyline[inner] = np.minimum(skyline[inner], eaves)
    return kept


def _distance(camera: Camera, b: Building) -> float:
    return math.hypot(min(max(camera.x, b.x0), b.x1) - camera.x, min(max(camera.z, b.z0), b.z1) - camera.z)
