"""A photo of a place: sky, skyline, ground, houses, things and passers-by, then the camera's own faults.

Invariant: what stays the same over the photos of a `Studio` is the place; everything else comes from the photo's seed.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from PIL import Image, ImageDraw

from shards.sources.miniature import facade
from shards.sources.miniature.atmosphere import Atmosphere
from shards.sources.miniature.camera import Array, Camera, Surface, lay
from shards.sources.miniature.ground import Ground
from shards.sources.miniature.layout import Photo
from shards.sources.miniature.lens import develop
from shards.sources.miniature.painter import PX, Wall
from shards.sources.miniature.place import Building, make_place
from shards.sources.miniature.roof import cover, slopes, stacks
from shards.sources.miniature.scenery import Scenery
from shards.sources.miniature.sight import in_sight
from shards.sources.miniature.weather import Conditions

OVERSAMPLE = 1.25
SLIVER = 6  # pixels of the canvas
Step = tuple[float, Callable[[], None]]


class Studio:
    """One place with its facades drawn, ready to be photographed.

    Args:
        town: number of the town; seed: of the place's identity.
    """

    def __init__(self, town: int, seed: tuple[int, ...]) -> None:
        self.place = make_place(town, seed)
        self._walls: dict[tuple[int, bool], Wall] = {}

    def photograph(self, photo: Photo, size: tuple[int, int]) -> bytes:
        """The photo as JPEG bytes, `size` = (width, height) pixels."""
        rng = np.random.default_rng([*photo.seed, 3])
        width, height = int(size[0] * OVERSAMPLE), int(size[1] * OVERSAMPLE)
        horizon = height * float(rng.uniform(0.60, 0.70))
        camera = Camera(
            photo.x, photo.y, photo.z, self.place.view + photo.yaw, photo.zoom * width, horizon,
            float(rng.normal(0, 0.008)), width, height,
        )  # fmt: skip
        canvas = Image.new("RGB", (width, height))
        scene = Scenery(canvas, camera, self.place, photo.conditions, rng)
        scene.sky()
        scene.skyline()
        ground = Ground(canvas, camera, self.place, photo.conditions)
        ground.draw()
        ground.shadows()
        steps: list[Step] = scene.things() + scene.traffic()
        for distance, house in in_sight(camera, self.place.buildings):
            steps.append((distance + 0.5, partial(self._build, canvas, camera, photo, house, distance)))
        for _, step in sorted(steps, key=lambda item: -item[0]):
            step()
        above = Atmosphere(canvas, camera, self.place, photo.conditions)
        above.glow()
        above.air(rng)
        return develop(canvas, size, photo.conditions, rng)

    def _wall(self, number: int, building: Building, full: bool, width: float) -> Wall:
        key = (building.seed * 4 + number, full)
        if key not in self._walls:
            self._walls[key] = facade.front(building) if full else facade.side(building, width)
        return self._walls[key]

    def _build(self, canvas: Image.Image, camera: Camera, photo: Photo, b: Building, distance: float) -> None:
        """Draws the visible faces and the roof of a house."""
        wide, deep, up = b.x1 - b.x0, b.z1 - b.z0, b.height
        faces = {
            "south": Surface((b.x0, up, b.z0), (wide, 0, 0), (0, -up, 0)),
            "east": Surface((b.x1, up, b.z0), (0, 0, deep), (0, -up, 0)),
            "west": Surface((b.x0, up, b.z1), (0, 0, -deep), (0, -up, 0)),
        }
        for outline, colour in stacks(b):
            polygon = camera.polygon(outline)
            if polygon:
                light = photo.conditions.light(np.array([0.0, 0.0, -1.0]))
                ImageDraw.Draw(canvas).polygon(polygon, fill=photo.conditions.shade(colour, light, distance))
        for surface in slopes(b):
            if surface.faces(camera):
                self._roof(canvas, camera, photo.conditions, b, surface, distance)
        for number, (name, plane) in enumerate(faces.items()):
            edge = camera.polygon(plane.corners) if plane.faces(camera) else []
            if not edge:
                continue
            full = name in b.fronts
            us = [u for u, _ in edge]
            if max(us) - min(us) < SLIVER:  # too thin to show a window
                paint = [int(v) for v in np.mean(b.family.walls, axis=0) * 0.85]
                fill = photo.conditions.shade(paint, photo.conditions.light(plane.normal), distance)
                ImageDraw.Draw(canvas).polygon(edge, fill=fill)
                continue
            wall = self._wall(number, b, full, wide if name == "south" else deep)
            if wall.height > up:  # the gable rises above the eaves
                extra = wall.height - up
                x, y, z = plane.corner
                plane = Surface((x, y + extra, z), plane.right, (0, -up - extra, 0))
            nearest = max(distance, 1.0)
            ratio = PX * nearest / camera.focal  # pixels of the wall for one of the canvas
            shrink = 4 if ratio >= 4 else 2 if ratio >= 2 else 1
            lay(canvas, camera, plane, self._lit(wall, plane.normal, photo, distance, b, shrink), wall.level(shrink)[1])

    def _lit(self, wall: Wall, normal: Array, photo: Photo, distance: float, b: Building, shrink: int) -> Image.Image:
        """The wall's picture at 1 / shrink of its size in the photo's light, with snow and lit windows."""
        sky = photo.conditions
        picture = sky.relight(wall.level(shrink)[0], sky.light(normal), distance)
        draw = ImageDraw.Draw(picture)
        rng = np.random.default_rng([*photo.seed, b.seed])
        if sky.snow:
            white = sky.shade((238, 242, 248), sky.light(np.array([0.0, 1.0, 0.0])), distance)
            for x0, x1, y in wall.ledges:
                draw.rectangle((x0 / shrink, (y - 2.5) / shrink, x1 / shrink, y / shrink), fill=white)
        if sky.dark:
            share = 0.36 if sky.hour == "night" else 0.25
            air = sky.veil(distance)
            panes = [(w, share) for w in wall.lights] + [(s, 0.85) for s in wall.shops]
            chances, tints = rng.random(len(panes)), rng.uniform((0.65, 0.92, 0.75), (1.0, 1.05, 1.25), (len(panes), 3))
            for (box, chance), drawn, (power, green, blue) in zip(panes, chances, tints, strict=True):
                x0, y0, x1, y1 = (v / shrink for v in box)
                if drawn < chance and x1 > x0 and y1 > y0:
                    glow = np.array([255, 214 * green, 146 * blue]) * power
                    r, g, k = np.clip(glow * (1 - air) + sky.colours[1] * air, 0, 255).astype(int).tolist()
                    draw.rectangle((x0, y0, x1, y1), fill=(r, g, k))
                    if shrink == 1:
                        mid = (x0 + x1) / 2
                        draw.line((mid, y0, mid, y1), fill=(int(r * 0.4), int(g * 0.35), int(k * 0.3)), width=1)
        return picture

    def _roof(self, canvas: Image.Image, camera: Camera, sky: Conditions, b: Building, s: Surface, d: float) -> None:
        colour = (236, 240, 246) if sky.snow else b.family.roof_colour
        outline = camera.polygon(s.corners)
        if not outline:
            return
        us, vs = [u for u, _ in outline], [v for _, v in outline]
        if (b.family.roof != "mansard" and d > 14) or min(max(us) - min(us), max(vs) - min(vs)) < SLIVER:
            # tiles do not show at this distance
            ImageDraw.Draw(canvas).polygon(outline, fill=sky.shade([c * 0.94 for c in colour], sky.light(s.normal), d))
            return
        wide, deep = float(np.linalg.norm(np.array(s.right))), float(np.linalg.norm(np.array(s.down)))
        base = cover(b, colour, wide, deep, sky.snow)
        lay(canvas, camera, s, sky.relight(base, sky.light(s.normal), d), None)
