"""A photo of a place: sky, skyline, ground, houses, things and passers-by, then the weather before the lens.

Invariant: what stays the same over the photos of a `Studio` is the place; everything else comes from the photo's seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from itertools import pairwise

import numpy as np
from PIL import Image, ImageChops, ImageDraw

from shards.sources.miniature import cutouts, facade
from shards.sources.miniature.camera import Camera, Point, faces, lay, normal, upright
from shards.sources.miniature.facade import Wall, masonry
from shards.sources.miniature.place import Building, Place, make_place
from shards.sources.miniature.plan import Photo
from shards.sources.miniature.towns import RGB, tone
from shards.sources.miniature.weather import Conditions, develop

SLIVER = 5  # pixels: a thinner wall shows no window
SNOW: RGB = (236, 240, 246)
UP = np.array([0.0, 1.0, 0.0])
Step = tuple[float, Callable[[], None]]  # distance in metres, drawing
Slopes = list[tuple[list[Point], RGB]]


class Studio:
    """One street with its facades drawn, ready to be photographed.

    Args:
        town: number of the town; seed: of the street's identity; length: of the street in metres.
    """

    def __init__(self, town: int, seed: tuple[int, ...], length: float = 0.0) -> None:
        self.place = make_place(town, seed, length)
        self._roofs = [roof(b) for b in self.place.buildings]
        self._walls: dict[tuple[int, str], Wall] = {}

    def photograph(self, photo: Photo, size: tuple[int, int]) -> bytes:
        """The photo as JPEG bytes, `size` = (width, height) pixels."""
        rng = np.random.default_rng([*photo.seed, 3])
        horizon, yaw = size[1] * float(rng.uniform(0.60, 0.70)), self.place.view + photo.yaw
        camera = Camera(photo.x, photo.y, photo.z, yaw, photo.zoom * size[0], horizon, *size)
        shot = Shot(camera, self.place, photo.conditions, rng)
        shot.sky()
        shot.skyline()
        shot.ground()
        steps = shot.things() + shot.traffic()
        for b, slopes in zip(self.place.buildings, self._roofs, strict=True):
            away = math.hypot(*(min(max(c, a), z) - c for c, a, z in ((camera.x, b.x0, b.x1), (camera.z, b.z0, b.z1))))
            steps.append((away + 0.5, partial(self._house, shot, photo, b, slopes, away)))
        for _, step in sorted(steps, key=lambda item: -item[0]):
            step()
        if photo.conditions.dark:
            shot.glow()
        shot.air()
        return develop(shot.canvas, photo.conditions, rng)

    def _house(self, shot: Shot, photo: Photo, b: Building, slopes: Slopes, distance: float) -> None:
        """Draws chimneys, roof and visible walls of a house."""
        for points, colour in slopes:
            if faces(points, shot.camera):
                shot.polygon(points, SNOW if photo.conditions.snow else colour, distance)
        plans = {"south": (b.x0, b.z0, b.x1, b.z0), "east": (b.x1, b.z0, b.x1, b.z1), "west": (b.x0, b.z1, b.x0, b.z0)}
        for name, foot in plans.items():
            plane = upright(*foot, 0, b.height)
            edge = [u for u, _ in shot.camera.polygon(plane)] if faces(plane, shot.camera) else []
            if not edge:
                continue
            if max(edge) - min(edge) < SLIVER:
                shot.polygon(plane, tone(b.family.walls[0], 0.85), distance)
                continue
            wall = self._walls.get((b.seed, name))
            if wall is None:
                draw = facade.front if name in b.fronts else facade.side
                wall = self._walls[b.seed, name] = draw(b, b.x1 - b.x0 if name == "south" else b.z1 - b.z0)
            picture = shot.lit(wall, normal(plane), distance, np.random.default_rng([*photo.seed, b.seed]))
            lay(shot.canvas, shot.camera, upright(*foot, 0, wall.height), picture, wall.alpha)


def roof(b: Building) -> Slopes:
    """Chimneys, then the slopes of a roof, as polygons clockwise from outside, with their colours."""
    rng, up, wide, deep = np.random.default_rng([b.seed, 23]), b.height, b.x1 - b.x0, b.z1 - b.z0
    middle, kind, found = (b.x0 + b.x1) / 2, "gable" if b.landmark else b.family.roof, []
    if b.landmark == "tower":
        z = (b.z0 + b.z1) / 2
        return [([(b.x0 - 0.2, up - 0.1, z), (middle, up + wide * 1.5, z), (b.x1 + 0.2, up - 0.1, z)], (92, 118, 112))]
    rise = {"flat": 0.0, "mansard": facade.MANSARD, "eaves": min(wide, deep) * 0.28}.get(kind, wide * 0.5)
    chimneys = int(rng.integers(3)) if "south" in b.fronts and not b.landmark else 0
    for x, far, shade in rng.uniform((b.x0 + 0.4, 2.5, 0.7), (b.x1 - 1.2, 5, 1.1), (chimneys, 3)).tolist():
        stack = upright(x, b.z0 + far, x + 0.8, b.z0 + far, up - 0.5, up + rise * 0.8 + 1.3)
        found.append((stack, tone((150, 96, 80), shade)))
    ridge, top = tone(b.family.tiles, 0.9), up + rise
    if kind == "eaves":  # a hip: three slopes towards the street
        run = min(wide, deep) / 2
        x0, x1, z0, z1 = b.x0 + run, b.x1 - run, b.z0 + run, b.z1 - run
        found.append(([(x0, top, z0), (x1, top, z0), (b.x1, up, b.z0), (b.x0, up, b.z0)], b.family.tiles))
    elif kind in ("gable", "stepped") and b.fronts[0] == "south":  # a ridge away from the street
        x0, x1, z0, z1 = middle, middle, b.z0, b.z1
    else:
        return found
    return [
        ([(x0, top, z1), (x0, top, z0), (b.x0, up, b.z0), (b.x0, up, b.z1)], ridge),
        ([(x1, top, z0), (x1, top, z1), (b.x1, up, b.z1), (b.x1, up, b.z0)], ridge),
        *found,
    ]


@lru_cache(maxsize=2)
def clouds(seed: int) -> Image.Image:
    """A 512 x 256 mask of broken cloud."""
    cover = facade.blotches(np.random.default_rng(seed), (256, 512), {6: 1.0, 14: 0.6, 40: 0.35, 110: 0.16})
    return Image.fromarray((np.clip(cover * 0.75 - 0.1, 0, 1) * 255).astype(np.uint8))


@lru_cache(maxsize=2)
def lamplight(power: float) -> Image.Image:
    """A 64 x 64 disc of warm light, fading outwards."""
    fall = np.clip(1 - np.hypot(*np.mgrid[-1:1:64j, -1:1:64j]), 0, 1)[..., None] ** 1.6
    return Image.fromarray((fall * 255 * power * np.array([1.0, 0.8, 0.5])).astype(np.uint8))


class Shot:
    """Draws one photo on its canvas, from the back to the front; `things` and `traffic` are sorted among the houses."""

    def __init__(self, camera: Camera, place: Place, conditions: Conditions, rng: np.random.Generator) -> None:
        self.camera, self.place, self.conditions, self.rng = camera, place, conditions, rng
        self.canvas = Image.new("RGB", (camera.width, camera.height))
        self.draw = ImageDraw.Draw(self.canvas)

    def polygon(self, points: Sequence[Point], colour: RGB, distance: float, round: bool = False) -> None:
        """A polygon in the world in one colour; a round thing's outline is lit from all sides."""
        outline = self.camera.polygon(points)
        if outline:
            light = self.conditions.light(None if round else normal(points))
            self.draw.polygon(outline, fill=self.conditions.shade(colour, light, distance))

    def sky(self) -> None:
        """Gradient and clouds."""
        sky, width, high = self.conditions, self.camera.width, int(self.camera.horizon) + 12
        zenith, low, _, _ = sky.colours
        t = (np.linspace(0, 1, high) ** 1.4)[:, None]
        column = Image.fromarray((zenith * (1 - t) + low * t).astype(np.uint8)[:, None, :])
        self.canvas.paste(column.resize((width, high), Image.Resampling.NEAREST), (0, 0))
        if sky.sky in ("clear", "overcast"):
            x, y, which = self.rng.integers((190, 76, 2)).tolist()
            part = clouds(which).crop((x, y, x + 320, y + 180)).resize((width, high), Image.Resampling.BILINEAR)
            amount = float(self.rng.uniform(0, 0.75)) if sky.sky == "clear" else 0.5
            r, g, b = (low * 0.8 if sky.dark else low * 0.5 + (127, 126, 123)).astype(int).tolist()
            self.canvas.paste((r, g, b), (0, 0), part.point([int(v * amount) for v in range(256)]))

    def skyline(self) -> None:
        """Far towers, spires and hills: part of the place, moved by the camera's heading alone."""

        def at(bearing: float, far: float, high: float) -> Point:
            return self.camera.x + far * math.sin(bearing), high, self.camera.z + far * math.cos(bearing)

        if self.place.hills:
            a, b, c = self.place.hills
            rise = lambda t: 46 + 26 * math.sin(3 * t + a) + 14 * math.sin(7 * t + b) + 5 * math.sin(17 * t + c)  # noqa: E731
            ridge = [at(t, 600, rise(t)) for t in np.linspace(-1.5, 1.5, 40).tolist()]
            colour = SNOW if self.conditions.snow else (104, 122, 100)
            self.polygon([*ridge, at(1.5, 600, 0), at(-1.5, 600, 0)], colour, 420, round=True)
        for bearing, wide, high, far in sorted(self.place.skyline, key=lambda s: -s[3]):
            half, eaves = wide / 2 / far, high * (0.7 if wide < 12 else 1.0)
            corners = [(-half, 0.0), (-half, eaves), (0.0, high), (half, eaves), (half, 0.0)]
            colour = ((112, 118, 130), (134, 126, 120), (92, 100, 112))[int(wide * 7) % 3]
            self.polygon([at(bearing + turn, far, up) for turn, up in corners], colour, far, round=True)

    def _strip(self, left: float, right: float, start: float, end: float, colour: RGB) -> None:
        """A rectangle on the ground across and along the street, in slices with more air the farther they lie."""
        (x0, z0), (x1, z1), near = self.place.spot(left, start), self.place.spot(right, end), self.camera.z
        for a, b in pairwise([z0, *[near + c for c in (6, 14, 26, 45, 80) if z0 < near + c < z1], z1]):
            self.polygon([(x0, 0, b), (x1, 0, b), (x1, 0, a), (x0, 0, a)], colour, max((a + b) / 2 - near, 0))

    def ground(self) -> None:
        """Pavement, road, kerb, markings; snow and rain change them."""
        place, town, k, avenue = self.place, self.place.town, self.place.kerb, self.place.kind == "avenue"
        wet = 0.72 if self.conditions.sky == "rain" else 1.0
        paving, road, stone, paint = (tone(c, wet) for c in (town.paving, town.road, (176, 174, 168), town.marking))
        if self.conditions.snow:
            paving, road, stone, paint = (232, 236, 242), (176, 176, 178), (214, 216, 220), (190, 190, 190)
        start, end, middle, low = (
            (-20, 240 + place.length, 0.0, 0.5 - k) if avenue else (-160, 160 + place.length, 4.0, 1.5)
        )
        self._strip(*((-160, 160) if avenue else (-20, 240)), start, end, paving)
        self._strip(-k - 0.3, k + 0.3, start, end, stone)
        self._strip(-k, k, start, end, road)
        for along in np.arange(max(start, -38), 84 + place.length, 6.0).tolist():
            self._strip(middle - 0.1, middle + 0.1, along, along + 3, paint)
        for along, n in [(along, n) for along in place.zebras for n in range(9)]:
            across = low + n * (k - 0.5 - low) / 9
            self._strip(across, across + 0.5, along, along + 3, paint)
        for left, right in place.gaps:
            self._strip(k - 0.2, 200, left + 1.5, right - 1.5, road)
        under = self.canvas.crop((0, int(self.camera.horizon), *self.canvas.size))
        self.canvas.paste(
            ImageChops.multiply(under, masonry("gravel").resize(under.size)), (0, int(self.camera.horizon))
        )

    def lit(self, wall: Wall, facing: np.ndarray, distance: float, rng: np.random.Generator) -> Image.Image:
        """A wall's picture in the photo's light, with snow and lit windows."""
        sky = self.conditions
        picture = sky.relight(wall.picture, sky.light(facing), distance)
        draw = ImageDraw.Draw(picture)
        if sky.snow:
            white = sky.shade(SNOW, sky.light(UP), distance)
            for x0, x1, y in wall.ledges:
                draw.rectangle(wall.box(x0, y, x1, y + 0.17), fill=white)
        if sky.dark:
            glows = rng.uniform((0, 165, 0.77, 0.43), (1, 255, 0.88, 0.7), (len(wall.panes), 4)).tolist()
            for (box, chance), (drawn, red, green, blue) in zip(wall.panes, glows, strict=True):
                if drawn < chance * (1.0 if sky.hour == "night" else 0.7):
                    draw.rectangle(box, fill=sky.shade((red, red * green, red * blue), np.ones(3), distance))
        return picture

    def _stand(self, cutout: cutouts.Cutout, x: float, z: float, high: float, way: float = 0.0) -> list[Step]:
        """A cut-out with its foot at (x, z): turned to the camera, or along x in the direction `way` (1 or -1)."""
        camera, half, sky = self.camera, high * cutout.ratio / 2, self.conditions
        depth = float(camera.project([(x, 0.0, z)])[0, 2])
        if depth < 2.0:
            return []
        right = (way, 0.0) if way else (math.cos(camera.yaw), -math.sin(camera.yaw))
        plane = upright(x - right[0] * half, z - right[1] * half, x + right[0] * half, z + right[1] * half, 0, high)

        def run() -> None:
            picture, alpha = cutout.layers
            picture = sky.relight(picture, sky.light(None), depth)
            for box in cutout.lights if sky.dark else ():
                ImageDraw.Draw(picture).rectangle(box, fill=(255, 226, 168))
            lay(self.canvas, camera, plane, picture, alpha)

        return [(math.hypot(x - camera.x, z - camera.z), run)] if camera.polygon(plane) else []

    def things(self) -> list[Step]:
        """What stands on the pavements for good."""
        steps, sky = [], self.conditions
        for t in self.place.things:
            tree = cutouts.tree(t.kind, sky.season, sky.snow, t.variant) if t.kind in cutouts.TREES else None
            steps += self._stand(tree or cutouts.thing(t.kind, t.variant), t.x, t.z, t.size)
        return steps

    def traffic(self) -> list[Step]:
        """Vehicles and people of the moment, around the photographer."""
        rng, place, camera, steps = self.rng, self.place, self.camera, []
        avenue = place.kind == "avenue"
        at, first, last = (camera.z, 9, 60) if avenue else (camera.x, -16, 16)
        for _ in range(int(rng.choice(5, p=[0.2, 0.3, 0.25, 0.15, 0.1]))):
            kind, paint = str(rng.choice(["car", "van", "bus"], p=[0.7, 0.2, 0.1])), int(rng.integers(8))
            way, along = float(rng.choice([-1, 1])), at + float(rng.uniform(first, last))
            lane = way * (1.8 + (place.kerb - 3.0) * rng.random()) if avenue else place.kerb - rng.choice([1.4, 4.2])
            x, z = place.spot(float(lane), along)
            car, high = cutouts.thing("rear" if avenue else kind, paint), cutouts.THINGS[kind][1] / 100
            steps += self._stand(car, x, z, high, 0.0 if avenue else way)
        for along, back, size in rng.uniform((first, 0.8, 1.6), (last, 3, 1.85), (int(rng.integers(6)), 3)).tolist():
            x, z = place.spot((place.front - back) * (float(rng.choice([-1, 1])) if avenue else 1), at + along)
            steps += self._stand(cutouts.thing("person", int(rng.integers(8))), x, z, size)
        return steps

    def glow(self) -> None:
        """Light about the street lamps after dark, and the halo of everything bright."""
        light = lamplight(1.0 if self.conditions.hour == "night" else 0.22)
        for t in self.place.things:
            u, v, depth = self.camera.project([(t.x, t.size - 0.4, t.z)])[0].tolist()
            if t.kind == "lamp" and 3 < depth < 40:
                r = round(5.5 * self.camera.focal / depth)
                warm = light.resize((2 * r, 2 * r))
                u, v = round(u / depth) - r, round(v / depth) - r
                under = self.canvas.crop((u, v, u + 2 * r, v + 2 * r))
                extra = ImageChops.multiply(under, warm)
                self.canvas.paste(ImageChops.add(ImageChops.add(under, extra), extra), (u, v))
        bright = self.canvas.reduce(8).point([max(int((v - 150) * 1.1), 0) for v in range(256)] * 3)
        self.canvas.paste(ImageChops.add(self.canvas, bright.resize(self.canvas.size, Image.Resampling.BICUBIC)))

    def air(self) -> None:
        """Rain streaks and snowflakes before the lens."""
        rain = self.conditions.sky == "rain"
        if not rain and self.conditions.sky != "snowfall":
            return
        mask = Image.new("L", self.canvas.size, 0)
        draw = ImageDraw.Draw(mask)
        for x, y, s in self.rng.uniform((0, 0, 0.5), (*self.canvas.size, 1.6), (170 if rain else 260, 3)).tolist():
            if rain:
                draw.line((x, y, x - 2.5 * s, y + 16 * s), fill=int(60 * s), width=1)
            else:
                draw.ellipse((x, y, x + 2.4 * s, y + 2.4 * s), fill=int(150 * min(s, 1.2)))
        self.canvas.paste((224, 228, 236), mask=mask)
