"""Everything of a photo but the houses: sky, skyline, ground, things on the pavement, traffic, rain and snow.

Invariant: sky, traffic and weather come from the photo's random stream, the rest from the place.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
from PIL import Image, ImageChops, ImageDraw

from shards.miniature import objects
from shards.miniature.camera import Camera, Surface, lay
from shards.miniature.objects import Cutout
from shards.miniature.place import Place
from shards.miniature.styles import RGB
from shards.miniature.weather import Conditions

Step = tuple[float, Callable[[], None]]
UP = np.array([0.0, 1.0, 0.0])


@lru_cache(maxsize=2)
def clouds(seed: int) -> Image.Image:
    """A 1024 x 256 mask of broken cloud."""
    rng = np.random.default_rng(seed)
    total = np.zeros((256, 1024), dtype=np.float32)
    for cells, weight in ((6, 1.0), (14, 0.6), (40, 0.35), (110, 0.16)):
        coarse = rng.normal(0, weight, (cells, cells * 2)).astype(np.float32)
        total += np.asarray(Image.fromarray(coarse).resize((1024, 256), Image.Resampling.BICUBIC))
    return Image.fromarray((np.clip(total * 0.75 - 0.1, 0, 1) * 255).astype(np.uint8))


@lru_cache(maxsize=4)
def gravel(width: int, height: int) -> Image.Image:
    """Grain of the ground, finer towards the top (the horizon)."""
    rng = np.random.default_rng(5)
    out = Image.new("L", (width, height), 250)
    rows = max(height // 12, 1)
    for k in range(12):
        cells = (max(width // (1 + k // 2), 2), max(rows // (1 + k // 4), 1))
        tile = Image.fromarray(rng.normal(242, 7, (cells[1], cells[0])).clip(0, 255).astype(np.uint8))
        out.paste(tile.resize((width, rows + 1), Image.Resampling.BILINEAR), (0, k * rows))
    return out


class Scenery:
    """Draws on one canvas, in the order sky, skyline, ground, (houses, things, traffic), air."""

    def __init__(
        self, canvas: Image.Image, camera: Camera, place: Place, sky: Conditions, rng: np.random.Generator
    ) -> None:
        self.canvas, self.camera, self.place, self.conditions, self.rng = canvas, camera, place, sky, rng
        self.draw = ImageDraw.Draw(canvas)

    def sky(self) -> None:
        """Gradient, clouds, and a low sun's glow."""
        sky, camera = self.conditions, self.camera
        zenith, low, _, _ = sky.colours
        high = int(camera.horizon) + 12
        t = (np.linspace(0, 1, high) ** 1.4)[:, None]
        column = Image.fromarray((zenith * (1 - t) + low * t).astype(np.uint8)[:, None, :])
        self.canvas.paste(column.resize((camera.width, high)), (0, 0))
        if sky.sky in ("clear", "overcast"):
            mask = clouds(int(self.rng.integers(2)))
            x, y = int(self.rng.integers(300)), int(self.rng.integers(60))
            part = mask.crop((x, y, x + 640, y + 180)).resize((camera.width, high))
            amount = float(self.rng.uniform(0, 0.75)) if sky.sky == "clear" else 0.5
            part = part.point([int(v * amount) for v in range(256)])
            bright = low * 0.5 + np.array([255, 252, 246]) * 0.5 if not sky.dark else low * 0.8
            r, g, b = bright.astype(int).tolist()
            self.canvas.paste((r, g, b), (0, 0), part)

    def skyline(self) -> None:
        """Distant towers, spires and hills: part of the place, shifted only by the camera's heading."""
        place, sky, camera = self.place, self.conditions, self.camera
        flat = sky.light(None)
        if place.hills:
            a, b, c, d = place.hills
            points = []
            for bearing in np.linspace(-1.5, 1.5, 40):
                rise = (
                    46
                    + 26 * math.sin(bearing * 3 + a)
                    + 14 * math.sin(bearing * 7 + b)
                    + 5 * math.sin(bearing * 17 + c + d)
                )
                points.append((600 * math.sin(bearing), max(rise, 4.0), 600 * math.cos(bearing)))
            colour = sky.shade((238, 242, 248) if sky.snow else (104, 122, 100), flat, 420)
            for p, q in itertools.pairwise(points):
                outline = camera.polygon(np.array([p, q, (q[0], 0, q[2]), (p[0], 0, p[2])]))
                if outline:
                    self.draw.polygon(outline, fill=colour)
        for bearing, wide, high, distance in sorted(place.skyline, key=lambda s: -s[3]):
            x, z = distance * math.sin(bearing), distance * math.cos(bearing)
            dx, dz = wide / 2 * math.cos(bearing), -wide / 2 * math.sin(bearing)
            base = ((112, 118, 130), (134, 126, 120), (92, 100, 112))[int(wide * 7) % 3]
            colour = sky.shade(base, flat, distance)
            top = high if place.town.skyline != "spires" or wide > 12 else high * 0.7
            shape = [(x - dx, top, z - dz), (x + dx, top, z + dz), (x + dx, 0, z + dz), (x - dx, 0, z - dz)]
            if top < high:
                shape.insert(1, (x, high, z))
            outline = camera.polygon(np.array(shape))
            if outline:
                self.draw.polygon(outline, fill=colour)
                if place.town.skyline == "towers":
                    lit = (
                        sky.shade((214, 196, 150), np.ones(3), distance)
                        if sky.dark
                        else sky.shade((150, 160, 172), flat, distance)
                    )
                    xs, ys = [p[0] for p in outline], [p[1] for p in outline]
                    pick = np.random.default_rng(int(wide * 1000))
                    for u, v in zip(
                        pick.uniform(min(xs) + 1, max(xs), 24), pick.uniform(min(ys) + 2, max(ys), 24), strict=True
                    ):
                        self.draw.rectangle((u, v, u + 1, v + 1), fill=lit)

    def _patch(self, points: Sequence[tuple[float, float]], colour: RGB, distance: float = 10.0) -> None:
        """A polygon (x, z) on the ground."""
        outline = self.camera.polygon(np.array([(x, 0.0, z) for x, z in points]))
        if outline:
            sky = self.conditions
            self.draw.polygon(outline, fill=sky.shade(colour, sky.light(UP), distance))

    def _strip(self, x0: float, x1: float, z0: float, z1: float, colour: RGB) -> None:
        """A rectangle on the ground, in slices with more air the farther they lie."""
        cuts = [z0, *[c for c in (6.0, 14.0, 26.0, 45.0, 80.0) if z0 < c < z1], z1]
        for a, b in itertools.pairwise(cuts):
            self._patch([(x0, a), (x1, a), (x1, b), (x0, b)], colour, max((a + b) / 2 - self.camera.z, 0))

    def ground(self) -> None:
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
            for z in np.arange(-10, 110, 6.0):
                self._patch([(-0.1, z), (0.1, z), (0.1, z + 3), (-0.1, z + 3)], marking, max(z, 0))
        else:
            self._patch([(-160, -k), (160, -k), (160, k), (-160, k)], road, 12)
            self._patch([(-160, k - 0.15), (160, k - 0.15), (160, k + 0.15), (-160, k + 0.15)], stone, k)
            for x in np.arange(-60, 60, 6.0):
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
        grain = gravel(self.camera.width, self.camera.height - top)
        self.canvas.paste(ImageChops.multiply(self.canvas.crop(box), Image.merge("RGB", (grain, grain, grain))), box)

    def _stand(self, cutout: Cutout, x: float, z: float, size: float, lit: bool) -> Step:
        """A cut-out turned to the camera."""
        wide = size * cutout.width / 2
        c, s = math.cos(self.camera.yaw), math.sin(self.camera.yaw)
        surface = Surface((x - wide * c, size, z + wide * s), (2 * wide * c, 0, -2 * wide * s), (0, -size, 0))
        return self._step(cutout, surface, x, z, lit)

    def _step(self, cutout: Cutout, surface: Surface, x: float, z: float, lit: bool) -> Step:
        distance = math.hypot(x - self.camera.x, z - self.camera.z)

        def run() -> None:
            if not self.camera.polygon(surface.corners):
                return
            sky = self.conditions
            picture = cutout.picture.point(sky.table(sky.light(None), distance))
            if lit and sky.dark:
                draw = ImageDraw.Draw(picture)
                for box in cutout.lights:
                    draw.rectangle(box, fill=(255, 226, 168))
            lay(self.canvas, self.camera, surface, picture, cutout.alpha)

        return distance, run

    def things(self) -> list[Step]:
        """What stands on the pavements for good."""
        steps = []
        for t in self.place.things:
            if self.camera.depth(t.x, t.z) < 2.0:
                continue
            if t.kind in ("round", "poplar", "plane", "palm", "conifer", "cypress"):
                cutout = objects.tree(t.kind, self.conditions.season, self.conditions.snow, t.variant)
            else:
                cutout = objects.furniture(t.kind, t.variant, self.place.town.lamp)
            size = {"bench": 0.9, "roadsign": 2.6, "postbox": 1.3, "bollards": 0.8, "kiosk": 2.7}.get(t.kind, t.size)
            steps.append(self._stand(cutout, t.x, t.z, size, True))
        return steps

    def traffic(self) -> list[Step]:
        """Vehicles and people of the moment."""
        rng, place, steps = self.rng, self.place, []
        kinds, shares = ["car", "van", "bus", "truck", "bike"], [0.62, 0.14, 0.08, 0.06, 0.1]
        avenue = place.kind == "avenue"
        for _ in range(int(rng.choice(5, p=[0.2, 0.3, 0.25, 0.15, 0.1]))):
            kind, paint = str(rng.choice(kinds, p=shares)), int(rng.integers(24))
            length, high = objects.CAR_SIZES[kind]
            if avenue:
                x, z = (
                    float(rng.choice([-1, 1])) * float(rng.uniform(1.8, place.kerb - 1.2)),
                    float(rng.uniform(12, 70)),
                )
                steps.append(self._stand(objects.vehicle(kind, paint, True), x, z, high, True))
            else:
                x, z = float(rng.uniform(-16, 16)), float(rng.choice([6.0, place.kerb - 1.2]))
                way = 1 if rng.random() < 0.5 else -1
                surface = Surface((x - way * length / 2, high, z), (way * length, 0, 0), (0, -high, 0))
                steps.append(self._step(objects.vehicle(kind, paint, False), surface, x, z, True))
        rain = self.conditions.sky in ("rain", "snowfall")
        for _ in range(int(rng.integers(0, 6))):
            x, z = float(rng.uniform(-14, 14)), place.front - float(rng.uniform(0.8, 3.5))
            if avenue:
                x, z = (
                    float(rng.choice([-1, 1])) * (place.front - float(rng.uniform(0.8, 2.0))),
                    float(rng.uniform(9, 50)),
                )
            steps.append(
                self._stand(
                    objects.person(int(rng.integers(40)), rain and rng.random() < 0.7),
                    x,
                    z,
                    float(rng.uniform(1.6, 1.85)),
                    False,
                )
            )
        return steps

    def air(self) -> None:
        """Rain streaks and snowflakes before the lens."""
        kind, rng, camera = self.conditions.sky, self.rng, self.camera
        if kind not in ("rain", "snowfall"):
            return
        mask = Image.new("L", self.canvas.size, 0)
        draw = ImageDraw.Draw(mask)
        n = 170 if kind == "rain" else 260
        for x, y, s in zip(
            rng.uniform(0, camera.width, n), rng.uniform(0, camera.height, n), rng.uniform(0.5, 1.6, n), strict=True
        ):
            if kind == "rain":
                draw.line((x, y, x - 2.5 * s, y + 16 * s), fill=int(60 * s), width=1)
            else:
                draw.ellipse((x, y, x + 2.4 * s, y + 2.4 * s), fill=int(150 * min(s, 1.2)))
        self.canvas.paste((224, 228, 236), mask=mask)
