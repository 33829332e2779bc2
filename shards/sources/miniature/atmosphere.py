"""What lies between the lens and the scene: pools of lamplight, halos, rain and snowflakes.

Invariant: drawn last, over everything; lamps stand where the place has them.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from PIL import Image, ImageChops, ImageDraw, ImageFilter

from shards.sources.miniature.camera import Camera
from shards.sources.miniature.place import Place
from shards.sources.miniature.weather import Conditions


@lru_cache(maxsize=8)
def _lamplight(power: float) -> Image.Image:
    """A 64 x 64 disc of warm light, fading outwards."""
    y, x = np.mgrid[-1:1:64j, -1:1:64j]
    fall = np.clip(1 - np.hypot(x, y), 0, 1)[..., None] ** 1.6
    return Image.fromarray((fall * 255 * power * np.array([1.0, 0.8, 0.5])).astype(np.uint8))


class Atmosphere:
    """Draws on one canvas: `glow`, then `air`."""

    def __init__(self, canvas: Image.Image, camera: Camera, place: Place, sky: Conditions) -> None:
        self.canvas, self.camera, self.place, self.conditions = canvas, camera, place, sky

    def glow(self) -> None:
        """After dark: pools of light about the street lamps, and the halo of everything bright."""
        sky, camera = self.conditions, self.camera
        if not sky.dark:
            return
        power = 1.0 if sky.hour == "night" else 0.22
        for t in self.place.things:
            depth = camera.depth(t.x, t.z)
            if t.kind == "lamp" and 3 < depth < 60:
                for high, metres, strength in ((t.size - 0.4, 5.5, 1.0), (0.05, 4.0, 0.8)):
                    head = camera.matrix @ (np.array([t.x, high, t.z]) - camera.place)
                    u, v, r = float(head[0] / head[2]), float(head[1] / head[2]), metres * camera.focal / depth
                    flat = r if high > 1 else r * 0.3
                    self._pool(u, v, r, flat, power * strength)
        small = self.canvas.reduce(4)
        bright = small.point([max(int((v - 150) * 1.1), 0) for v in range(256)] * 3).filter(ImageFilter.BoxBlur(3))
        halo = bright.resize(self.canvas.size, Image.Resampling.BILINEAR)
        self.canvas.paste(ImageChops.add(self.canvas, halo))

    def _pool(self, u: float, v: float, r: float, flat: float, power: float) -> None:
        """Multiplies the light in an ellipse of radii r, flat around the pixel (u, v)."""
        whole = (int(u - r), int(v - flat), int(u + r), int(v + flat))
        box = (max(whole[0], 0), max(whole[1], 0), min(whole[2], self.camera.width), min(whole[3], self.camera.height))
        if box[2] - box[0] < 3 or box[3] - box[1] < 3:
            return
        sx, sy = 64 / max(whole[2] - whole[0], 1), 64 / max(whole[3] - whole[1], 1)
        part = (
            (box[0] - whole[0]) * sx, (box[1] - whole[1]) * sy, (box[2] - whole[0]) * sx, (box[3] - whole[1]) * sy,
        )  # fmt: skip
        target = (box[2] - box[0], box[3] - box[1])
        warm = _lamplight(power).resize(target, Image.Resampling.BILINEAR, box=part)
        under = self.canvas.crop(box)
        extra = ImageChops.multiply(under, warm)
        self.canvas.paste(ImageChops.add(ImageChops.add(under, extra), extra), box)

    def air(self, rng: np.random.Generator) -> None:
        """Rain streaks and snowflakes before the lens."""
        kind, camera = self.conditions.sky, self.camera
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
