"""Seasons, hours and weather of a photo, and the light they throw on a surface.

Invariant: conditions belong to a photo, never to the place in it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from PIL import Image

from shards.sources.miniature.camera import Array

Colour = tuple[float, float, float]
SEASON_MONTHS = {"spring": (3, 4, 5), "summer": (6, 7, 8), "autumn": (9, 10, 11), "winter": (12, 1, 2)}
# sky at the zenith, sky at the horizon, ambient light, sunlight, height of the sun (degrees), its azimuth (degrees)
HOURS: dict[str, tuple[Colour, Colour, Colour, Colour, float, float]] = {
    "morning": ((112, 158, 214), (236, 222, 200), (0.60, 0.62, 0.68), (0.52, 0.44, 0.32), 24, 105),
    "noon": ((74, 132, 206), (196, 218, 236), (0.62, 0.64, 0.68), (0.50, 0.48, 0.43), 55, 180),
    "afternoon": ((92, 142, 204), (226, 220, 206), (0.60, 0.61, 0.65), (0.54, 0.46, 0.34), 32, 242),
    "dusk": ((72, 78, 128), (244, 164, 110), (0.52, 0.47, 0.53), (0.30, 0.16, 0.08), 6, 275),
    "night": ((14, 19, 42), (70, 60, 66), (0.29, 0.29, 0.37), (0.0, 0.0, 0.0), 30, 180),
}


@dataclass(frozen=True)
class Conditions:
    """What the day was like.

    Args:
        season: a key of `SEASON_MONTHS`; hour: a key of `HOURS`.
        sky: clear, overcast, rain, fog or snowfall; snow: whether it lies on the ground and the roofs.
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
        """Zenith, horizon (0..255), ambient and sun (0..1) after the weather's veil."""
        zenith, low, ambient, sun = (np.array(c, dtype=np.float64) for c in HOURS[self.hour][:4])
        if self.sky != "clear":
            veil = {"overcast": 0.85, "rain": 0.95, "fog": 1.0, "snowfall": 0.9}[self.sky]
            grey = float(zenith.mean() * 0.45 + low.mean() * 0.55) * (0.86 if self.sky == "rain" else 1.0)
            tint = np.array([0.97, 1.0, 1.05])
            zenith, low = zenith * (1 - veil) + grey * 0.92 * tint * veil, low * (1 - veil) + grey * 1.04 * tint * veil
            extra = 0.30 * sun.mean()
            ambient = ambient * (0.90 if self.sky == "rain" else 1.04) + extra * tint
            sun = sun * (0.15 if self.sky == "overcast" else 0.0)
        if self.snow and self.hour != "night":
            ambient = ambient * 1.05
        return zenith, low, ambient, sun

    @cached_property
    def to_sun(self) -> Array:
        """[3] unit vector towards the sun in the place's axes."""
        height, azimuth = (math.radians(d) for d in HOURS[self.hour][4:])
        turn = azimuth - math.radians(self.heading)
        flat = math.cos(height)
        return np.array([flat * math.sin(turn), math.sin(height), flat * math.cos(turn)])

    @cached_property
    def haze(self) -> float:
        """Extinction in 1/metre."""
        return {"clear": 0.0011, "overcast": 0.002, "rain": 0.006, "fog": 0.026, "snowfall": 0.009}[self.sky]

    def light(self, normal: Array | None) -> Array:
        """[3] light on a surface with this normal; None: something round, lit from all sides."""
        _, _, ambient, sun = self.colours
        if normal is None:
            return np.asarray(ambient + 0.55 * sun)
        up = 0.9 + 0.1 * float(normal[1])
        return np.asarray(ambient * up + sun * max(0.0, float(normal @ self.to_sun)))

    def relight(self, picture: Image.Image, light: Array, distance: float) -> Image.Image:
        """An RGB picture in this light behind `distance` metres of air."""
        veil = self.veil(distance)
        (r, g, b), (x, y, z) = (light * (1 - veil)).tolist(), (self.colours[1] * 0.96 * veil).tolist()
        return picture.convert("RGB", (r, 0, 0, x, 0, g, 0, y, 0, 0, b, z))

    def veil(self, distance: float) -> float:
        """Share of the air's own colour at this distance."""
        return 1.0 - math.exp(-self.haze * max(distance - 8.0, 0.0))

    def shade(self, colour: Sequence[float], light: Array, distance: float) -> tuple[int, int, int]:
        """One colour (0..255) in this light behind `distance` metres of air."""
        veil = self.veil(distance)
        mixed = np.clip(np.array(colour) * light * (1 - veil) + self.colours[1] * 0.96 * veil, 0, 255)
        r, g, b = mixed.astype(int).tolist()
        return r, g, b
