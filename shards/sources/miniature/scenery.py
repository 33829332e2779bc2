"""What stands around the houses: sky, skyline, things on the pavement, traffic.

Invariant: sky and traffic come from the photo's random stream, the rest from the place.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw

from shards.sources.miniature import objects
from shards.sources.miniature.camera import Camera, Surface, lay
from shards.sources.miniature.objects import Cutout
from shards.sources.miniature.place import Place
from shards.sources.miniature.weather import Conditions

Step = tuple[float, Callable[[], None]]


@lru_cache(maxsize=2)
def clouds(seed: int) -> Image.Image:
    """A 1024 x 256 mask of broken cloud."""
    rng = np.random.default_rng(seed)
    total = np.zeros((256, 1024), dtype=np.float32)
    for cells, weight in ((6, 1.0), (14, 0.6), (40, 0.35), (110, 0.16)):
        coarse = rng.normal(0, weight, (cells, cells * 2)).astype(np.float32)
        total += np.asarray(Image.fromarray(coarse).resize((1024, 256), Image.Resampling.BICUBIC))
    return Image.fromarray((np.clip(total * 0.75 - 0.1, 0, 1) * 255).astype(np.uint8))


class Scenery:
    """Draws on one canvas: first sky and skyline; `things` and `traffic` are steps to be sorted among the houses."""

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
        self.canvas.paste(column.resize((camera.width, high), Image.Resampling.NEAREST), (0, 0))
        if sky.sky in ("clear", "overcast"):
            mask = clouds(int(self.rng.integers(2)))
            x, y = int(self.rng.integers(300)), int(self.rng.integers(60))
            part = mask.crop((x, y, x + 640, y + 180)).resize((camera.width, high), Image.Resampling.BILINEAR)
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
            outline = camera.polygon(
                np.array([*points, (points[-1][0], 0, points[-1][2]), (points[0][0], 0, points[0][2])])
            )
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

    def _stand(self, cutout: Cutout, x: float, z: float, size: float, lit: bool) -> Step:
        """A cut-out turned to the camera, so it is only scaled."""
        camera, sky = self.camera, self.conditions
        distance = math.hypot(x - camera.x, z - camera.z)

        def run() -> None:
            foot = camera.matrix @ (np.array([x, 0.0, z]) - camera.place)
            if foot[2] < 1.0:
                return
            u, v = float(foot[0] / foot[2]), float(foot[1] / foot[2])
            high = size * camera.focal / float(foot[2])
            wide = high * cutout.width
            if u + wide / 2 < 0 or u - wide / 2 > camera.width or v - high > camera.height or high < 2 or wide < 1:
                return
            shrink = min(max(int(cutout.picture.height / high), 1), 8)
            picture, alpha = cutout.level(shrink)
            picture = sky.relight(picture, sky.light(None), distance)
            if lit and sky.dark:
                draw = ImageDraw.Draw(picture)
                for box in cutout.lights:
                    draw.rectangle([b / shrink for b in box], fill=(255, 226, 168))
            target = (max(round(wide), 1), max(round(high), 1))
            smooth = Image.Resampling.BILINEAR
            corner = (round(u - wide / 2), round(v - high))
            self.canvas.paste(picture.resize(target, smooth), corner, alpha.resize(target, smooth))

        return distance, run

    def _step(self, cutout: Cutout, surface: Surface, x: float, z: float, lit: bool) -> Step:
        distance = math.hypot(x - self.camera.x, z - self.camera.z)

        def run() -> None:
            if not self.camera.polygon(surface.corners):
                return
            sky = self.conditions
            picture = sky.relight(cutout.picture, sky.light(None), distance)
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
            if t.kind in objects.SPECIES:
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
                x, z = float(rng.uniform(-16, 16)), place.kerb - (1.4 if rng.random() < 0.6 else 4.2)
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
