"""The ground of a place: pavement, road, markings, snow, and the shadows that the sun throws on it.

Invariant: the ground's plan belongs to the place, its colours and shadows to the photo.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np
from PIL import Image, ImageChops, ImageDraw

from shards.sources.miniature import objects
from shards.sources.miniature.camera import Array, Camera
from shards.sources.miniature.place import Place
from shards.sources.miniature.styles import RGB
from shards.sources.miniature.weather import Conditions

UP = np.array([0.0, 1.0, 0.0])


@lru_cache(maxsize=4)
def gravel(width: int, height: int) -> Image.Image:
    """RGB grain of the ground, finer towards the top (the horizon)."""
    rng = np.random.default_rng(5)
    out = Image.new("L", (width, height), 250)
    rows = max(height // 12, 1)
    for k in range(12):
        cells = (max(width // (1 + k // 2), 2), max(rows // (1 + k // 4), 1))
        tile = Image.fromarray(rng.normal(242, 7, (cells[1], cells[0])).clip(0, 255).astype(np.uint8))
        out.paste(tile.resize((width, rows + 1), Image.Resampling.BILINEAR), (0, k * rows))
    return Image.merge("RGB", (out, out, out))


def hull(points: list[tuple[float, float]]) -> Array:
    """[n, 3] convex hull of points (x, z) on the ground (Andrew's monotone chain)."""
    ordered = sorted(set(points))

    def half(path: list[tuple[float, float]]) -> list[tuple[float, float]]:
        kept: list[tuple[float, float]] = []
        for p in path:
            while len(kept) > 1 and (kept[-1][0] - kept[-2][0]) * (p[1] - kept[-2][1]) <= (
                kept[-1][1] - kept[-2][1]
            ) * (p[0] - kept[-2][0]):
                kept.pop()
            kept.append(p)
        return kept[:-1]

    return np.array([(x, 0.0, z) for x, z in half(ordered) + half(ordered[::-1])])


class Ground:
    """Draws on one canvas: `draw` before `shadows`, both before anything that stands on it."""

    def __init__(self, canvas: Image.Image, camera: Camera, place: Place, sky: Conditions) -> None:
        self.canvas, self.camera, self.place, self.conditions = canvas, camera, place, sky
        self.ink = ImageDraw.Draw(canvas)

    def _patch(self, points: Sequence[tuple[float, float]], colour: RGB, distance: float = 10.0) -> None:
        """A polygon (x, z) on the ground."""
        outline = self.camera.polygon(np.array([(x, 0.0, z) for x, z in points]))
        if outline:
            sky = self.conditions
            self.ink.polygon(outline, fill=sky.shade(colour, sky.light(UP), distance))

    def _strip(self, x0: float, x1: float, z0: float, z1: float, colour: RGB) -> None:
        """A rectangle on the ground, in slices with more air the farther they lie."""
        cuts = [z0, *[c for c in (6.0, 14.0, 26.0, 45.0, 80.0) if z0 < c < z1], z1]
        for a, b in pairwise(cuts):
            self._patch([(x0, a), (x1, a), (x1, b), (x0, b)], colour, max((a + b) / 2 - self.camera.z, 0))

    def draw(self) -> None:
        """Pavement, road, kerb, markings; snow and rain change them."""
        place, sky, town = self.place, self.conditions, self.place.town
        wet = 0.72 if sky.sky == "rain" else 1.0
        tone = lambda c: (int(c[0] * wet), int(c[1] * wet), int(c[2] * wet))  # noqa: E731
        paving, road = tone(town.paving), tone(town.road)
        marking = town.marking
        if sky.snow:
            paving, road, marking = (232, 236, 242), (176, 176, 178), (190, 190, 190)
        self._strip(-160, 160, -20, 240, paving)
        k = place.kerb
        stone = tone((176, 174, 168)) if not sky.snow else (214, 216, 220)
        if place.kind == "avenue":
            self._strip(-k, k, -20, 200, road)
            for x in (-k, k):
                self._strip(x - 0.15, x + 0.15, -20, 120, stone)
            for z in np.arange(2, 84, 6.0):
                self._patch([(-0.1, z), (0.1, z), (0.1, z + 3), (-0.1, z + 3)], marking, max(z, 0))
        else:
            self._patch([(-160, -k), (160, -k), (160, k), (-160, k)], road, 12)
            self._patch([(-160, k - 0.15), (160, k - 0.15), (160, k + 0.15), (-160, k + 0.15)], stone, k)
            for x in np.arange(-36, 36, 6.0):
                self._patch([(x, 3.9), (x + 3, 3.9), (x + 3, 4.1), (x, 4.1)], marking, 8)
            if place.gap:
                a, b = place.gap
                self._strip(a + 1.5, b - 1.5, k - 0.2, 200, road)
        if place.zebra is not None:
            for n in range(9):
                if place.kind == "avenue":
                    x = -k + 0.5 + n * (2 * k - 1) / 9
                    self._patch([(x, 14), (x + 0.5, 14), (x + 0.5, 17), (x, 17)], marking, 14)
                else:
                    z = 1.5 + n * (k - 2) / 9
                    x = place.zebra
                    self._patch([(x, z), (x + 3, z), (x + 3, z + 0.5), (x, z + 0.5)], marking, 9)
        top = max(int(self.camera.horizon) - 2, 0)
        box = (0, top, self.camera.width, self.camera.height)
        grain = gravel(self.camera.width, self.camera.height // 2).crop((0, 0, box[2], box[3] - top))
        self.canvas.paste(ImageChops.multiply(self.canvas.crop(box), grain), box)

    def shadows(self) -> None:
        """What the sun's rays do not reach on the ground."""
        sky, place = self.conditions, self.place
        sun = sky.to_sun
        if float(sky.colours[3].sum()) < 0.5 or sun[1] < 0.2:
            return
        mask = Image.new("L", self.canvas.size, 0)
        draw = ImageDraw.Draw(mask)
        dx, dz = -float(sun[0] / sun[1]), -float(sun[2] / sun[1])

        def cast(points: list[tuple[float, float]], high: float) -> None:
            outline = self.camera.polygon(hull([*points, *[(x + dx * high, z + dz * high) for x, z in points]]))
            if outline:
                draw.polygon(outline, fill=120)

        for b in place.buildings:
            if b.z0 < 60:
                cast([(b.x0, b.z0), (b.x1, b.z0), (b.x1, b.z1), (b.x0, b.z1)], b.height)
        for t in place.things:
            if t.kind in objects.SPECIES and t.z < 50:
                half, x, z = t.size * 0.22, t.x + dx * t.size * 0.35, t.z + dz * t.size * 0.35
                ring = [(x + half * math.cos(a), z + half * math.sin(a)) for a in np.linspace(0, 5.5, 8)]
                cast([(t.x - 0.1, t.z), (t.x + 0.1, t.z)], t.size * 0.4)
                cast(ring, t.size * 0.4)
            elif t.kind == "lamp" and t.z < 40:
                cast([(t.x - 0.08, t.z), (t.x + 0.08, t.z)], t.size)
        self.canvas.paste((24, 28, 44), mask=mask)
