"""Season, hour and weather of a photo, the light they throw on a surface, and the lens that takes the picture.

Invariant: conditions and lens belong to a photo, never to the place in it.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from PIL import Image

from shards.sources.miniature.camera import Array
from shards.sources.miniature.towns import RGB

SEASON_MONTHS = {"spring": (3, 4, 5), "summer": (6, 7, 8), "autumn": (9, 10, 11), "winter": (12, 1, 2)}
Colour = tuple[float, float, float]
# sky at the zenith, sky at the horizon, ambient light, sunlight, height of the sun (degrees), its azimuth (degrees)
HOURS: dict[str, tuple[Colour, Colour, Colour, Colour, float, float]] = {
    "morning": ((112, 158, 214), (236, 222, 200), (0.60, 0.62, 0.68), (0.52, 0.44, 0.32), 24, 105),
    "noon": ((74, 132, 206), (196, 218, 236), (0.62, 0.64, 0.68), (0.50, 0.48, 0.43), 55, 180),
    "afternoon": ((92, 142, 204), (226, 220, 206), (0.60, 0.61, 0.65), (0.54, 0.46, 0.34), 32, 242),
    "dusk": ((72, 78, 128), (244, 164, 110), (0.52, 0.47, 0.53), (0.30, 0.16, 0.08), 6, 275),
    "night": ((14, 19, 42), (70, 60, 66), (0.29, 0.29, 0.37), (0.0, 0.0, 0.0), 30, 180),
}
# share of grey that each sky lays over its colours, and the air's extinction in 1/metre
SKIES = {"clear": (0.0, 0.0011), "overcast": (0.85, 0.002), "rain": (0.95, 0.006), "fog": (1.0, 0.026),
         "snowfall": (0.9, 0.009)}  # fmt: skip
# how often each of SEASON_MONTHS, HOURS and SKIES is met, by purpose of the photo
SHARES: dict[str, tuple[list[float], list[float], list[float]]] = {
    "train": ([0.25, 0.25, 0.25, 0.25], [0.2, 0.25, 0.23, 0.15, 0.17], [0.5, 0.24, 0.13, 0.07, 0.06]),
    "database": ([0.5, 0.5, 0.0, 0.0], [0.33, 0.34, 0.33, 0.0, 0.0], [0.7, 0.3, 0.0, 0.0, 0.0]),  # a fair survey
    "queries": ([0.15, 0.15, 0.35, 0.35], [0.17, 0.18, 0.18, 0.2, 0.27], [0.36, 0.26, 0.2, 0.1, 0.08]),
}


@dataclass(frozen=True)
class Conditions:
    """What the day was like.

    Args:
        season, hour, sky: keys of `SEASON_MONTHS`, `HOURS` and `SKIES`.
        snow: whether it lies on the ground and the roofs.
        heading: compass bearing of the place's +z axis in degrees, so that the sun stands where it should.
    """

    season: str
    hour: str
    sky: str
    snow: bool
    heading: float

    @cached_property
    def dark(self) -> bool:
        return self.hour in ("night", "dusk")

    @cached_property
    def colours(self) -> tuple[Array, Array, Array, Array]:
        """Zenith, horizon (0..255), ambient and sun (0..1) behind the weather's grey."""
        zenith, low, ambient, sun = (np.array(c, dtype=np.float64) for c in HOURS[self.hour][:4])
        if self.sky != "clear":
            veil, dim = SKIES[self.sky][0], 0.86 if self.sky == "rain" else 1.0
            grey = float(zenith.mean() * 0.45 + low.mean() * 0.55) * dim * np.array([0.97, 1.0, 1.05])
            zenith, low = zenith * (1 - veil) + grey * 0.92 * veil, low * (1 - veil) + grey * 1.04 * veil
            ambient = ambient * (1.04 * dim) + 0.3 * sun.mean()
            sun = sun * (0.15 if self.sky == "overcast" else 0.0)
        return zenith, low, ambient, sun

    @cached_property
    def to_sun(self) -> Array:
        """[3] unit vector towards the sun in the place's axes."""
        height, azimuth = (math.radians(d) for d in HOURS[self.hour][4:])
        turn, flat = azimuth - math.radians(self.heading), math.cos(height)
        return np.array([flat * math.sin(turn), math.sin(height), flat * math.cos(turn)])

    def light(self, normal: Array | None) -> Array:
        """[3] light on a surface with this normal; None: something round, lit from all sides."""
        _, _, ambient, sun = self.colours
        if normal is None:
            return np.asarray(ambient + 0.55 * sun)
        return np.asarray(ambient * (0.9 + 0.1 * float(normal[1])) + sun * max(0.0, float(normal @ self.to_sun)))

    def _air(self, light: Array, distance: float) -> tuple[Array, Array]:
        """[3] what a colour is multiplied with, then what is added, behind `distance` metres of air."""
        veil = 1.0 - math.exp(-SKIES[self.sky][1] * max(distance - 8.0, 0.0))
        return light * (1 - veil), self.colours[1] * 0.96 * veil

    def relight(self, picture: Image.Image, light: Array, distance: float) -> Image.Image:
        """An RGB picture in this light behind the air."""
        (r, g, b), (x, y, z) = (part.tolist() for part in self._air(light, distance))
        return picture.convert("RGB", (r, 0, 0, x, 0, g, 0, y, 0, 0, b, z))

    def shade(self, colour: Sequence[float], light: Array, distance: float) -> RGB:
        """One colour (0..255) in this light behind the air."""
        gain, haze = self._air(light, distance)
        r, g, b = np.clip(np.array(colour) * gain + haze, 0, 255).astype(int).tolist()
        return r, g, b


def draw_conditions(rng: np.random.Generator, heading: float, purpose: str) -> Conditions:
    """Conditions of a photo taken for `purpose`, a key of `SHARES`."""
    names = list(SEASON_MONTHS), list(HOURS), list(SKIES)
    season, hour, sky = (str(rng.choice(n, p=p)) for n, p in zip(names, SHARES[purpose], strict=True))
    if sky == "snowfall" and season != "winter":
        sky = "overcast"
    return Conditions(season, hour, sky, sky == "snowfall" or (season == "winter" and rng.random() < 0.6), heading)


def develop(image: Image.Image, sky: Conditions, rng: np.random.Generator) -> bytes:
    """The drawing as the JPEG bytes of a photo: sharpness, exposure, colour, noise."""
    size, night = image.size, sky.hour == "night"
    sharp = 1.1 - 0.5 * float(rng.uniform(0.0, 1.0)) ** 3 - (0.1 if sky.dark else 0.0)
    if sharp < 0.9:
        image = image.resize((int(size[0] * sharp), int(size[1] * sharp))).resize(size, Image.Resampling.BICUBIC)
    exposure = float(rng.normal(1.06, 0.10)) * (1.15 if night else 1.0)
    levels = np.linspace(0, 1, 256) ** float(rng.uniform(0.9, 1.12)) * 255 * exposure
    levels = np.where(levels > 205, 205 + (levels - 205) * 0.55, levels)  # a soft shoulder, as cameras have
    balance = np.array([[1.0 + rng.normal(0, 0.045)], [1.0], [1.0 + rng.normal(0, 0.05)]])
    image = image.point(np.clip(levels * balance, 0, 255).astype(int).ravel().tolist())
    grain = rng.standard_normal((size[1], size[0], 3), np.float32) * rng.uniform(1.0, 3.5) * (2.2 if night else 1.0)
    store = io.BytesIO()
    image = Image.fromarray((np.asarray(image) + grain).clip(0, 255).astype(np.uint8))
    image.save(store, "JPEG", quality=int(rng.integers(72, 93)))
    return store.getvalue()
