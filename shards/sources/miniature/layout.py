"""Which photos the miniature has, where they lie and what they are called.

Training photos are named as in GSV-Cities, evaluation photos as in the field's `@utm` folders.
Invariant: a pure function of (places, seed) and the counts; a photo's file name never changes with the processes
that draw it. Evaluation places share towns, not houses, with the training places.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shards.sources.miniature.geodesy import band, to_degrees
from shards.sources.miniature.styles import TOWNS
from shards.sources.miniature.weather import SEASON_MONTHS, Conditions

ZONE = 27  # open ocean: the towns are nobody's
SPACING = 70.0  # metres between neighbouring places; photos lie within 10 m of theirs
SPLITS = {"train": 0, "val": 1, "test": 2}
ALPHABET = np.array(list("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_"))


@dataclass(frozen=True)
class Photo:
    """One picture to draw.

    Args:
        file: path under the output folder; row: its line of the data frame ("" in evaluation folders).
        seed: of everything that is not the place; conditions: season, hour, weather.
        x, z, y: the camera's metres to the right of, ahead of and above the place's origin.
        yaw: radians from the place's own view; zoom: focal length in picture widths.
    """

    file: str
    row: str
    seed: tuple[int, ...]
    conditions: Conditions
    x: float
    z: float
    y: float
    yaw: float
    zoom: float


@dataclass(frozen=True)
class PlacePhotos:
    """A place (town, seed of its identity) and its photos."""

    town: int
    seed: tuple[int, ...]
    photos: tuple[Photo, ...]


def plan_photos(places: int, seed: int, val_places: int, test_places: int) -> list[PlacePhotos]:
    """Every place and photo of the miniature, training places first."""
    planned = [_training_place(seed, index) for index in range(places)]
    for split, count in (("val", val_places), ("test", test_places)):
        planned += [_evaluation_place(seed, split, index) for index in range(count)]
    return planned


def _centre(split: str, town: int, index: int, rng: np.random.Generator) -> tuple[float, float]:
    """UTM metres of a place: along its town's winding main street, one direction of travel, so that the order of
    file names (by easting) keeps a place's photos together."""
    east = 330000.0 + 60000.0 * town + 20000.0 * SPLITS[split] + SPACING * index + float(rng.uniform(-6, 6))
    north = 4203000.0 + 900.0 * math.sin(index / 9.0 + town) + float(rng.uniform(-6, 6))
    return east, north


def _weather(rng: np.random.Generator, heading: float, only: str | None = None) -> Conditions:
    """Conditions of a photo; `only` narrows them: "survey" (fair days) or "query" (other days and nights)."""
    if only == "survey":
        season = str(rng.choice(["spring", "summer"]))
        return Conditions(
            season,
            str(rng.choice(["morning", "noon", "afternoon"])),
            str(rng.choice(["clear", "overcast"], p=[0.7, 0.3])),
            False,
            heading,
        )
    season = str(rng.choice(list(SEASON_MONTHS)))
    hours = ["morning", "noon", "afternoon", "dusk", "night"]
    skies = ["clear", "overcast", "rain", "fog", "snowfall"]
    if only == "query":
        season = str(rng.choice(list(SEASON_MONTHS), p=[0.15, 0.15, 0.35, 0.35]))
        hour = str(rng.choice(hours, p=[0.17, 0.18, 0.18, 0.2, 0.27]))
        sky = str(rng.choice(skies, p=[0.36, 0.26, 0.2, 0.1, 0.08]))
    else:
        hour = str(rng.choice(hours, p=[0.2, 0.25, 0.23, 0.15, 0.17]))
        sky = str(rng.choice(skies, p=[0.5, 0.24, 0.13, 0.07, 0.06]))
    if sky == "snowfall" and season != "winter":
        sky = "overcast"
    snow = sky == "snowfall" or (season == "winter" and rng.random() < 0.6)
    return Conditions(season, hour, sky, snow, heading)


def _pose(rng: np.random.Generator, reach: float, turn: float) -> tuple[float, float, float, float, float]:
    """x, z, y, yaw, zoom of a camera up to `reach` metres along the street and `turn` radians off the view."""
    x, z = float(rng.uniform(-reach, reach)), float(rng.uniform(-2.2, 2.2))
    return (
        x,
        z,
        float(rng.uniform(1.6, 2.6)),
        float(rng.uniform(-turn, turn)) - 0.025 * x,
        float(rng.uniform(0.66, 0.84)),
    )


def _standing(east: float, north: float, heading: float, x: float, z: float) -> tuple[float, float]:
    """UTM of a camera x metres to the right and z metres ahead of a place that looks towards `heading`."""
    c, s = math.cos(math.radians(heading)), math.sin(math.radians(heading))
    return east + x * c + z * s, north - x * s + z * c


def _pano(rng: np.random.Generator) -> str:
    return "".join(rng.choice(ALPHABET, 22))


def _training_place(seed: int, index: int) -> PlacePhotos:
    town, number = index % len(TOWNS), index // len(TOWNS)
    rng = np.random.default_rng([seed, 17, SPLITS["train"], index])
    east, north = _centre("train", town, number, rng)
    # ids have gaps; those of two towns pass 100,000, of which the file name keeps the last five digits
    place_id = (100000 if town % 2 else 0) + 3 * number + int(rng.integers(3))
    heading = float(rng.uniform(0, 360))
    count = (
        int(rng.integers(2, 4))
        if rng.random() < 0.03
        else int(rng.choice([4, 5, 6, 7, 8, 9, 10, 12], p=[0.17, 0.19, 0.19, 0.17, 0.12, 0.08, 0.05, 0.03]))
    )
    suffix = ".JPG" if rng.random() < 0.4 else ".jpg"
    code = TOWNS[town].code
    photos = []
    for view in range(count):
        key = (seed, 18, SPLITS["train"], index, view)
        rng = np.random.default_rng(key)
        conditions = _weather(rng, heading)
        x, z, y, yaw, zoom = _pose(rng, 4.5, 0.14)
        latitude, longitude = to_degrees(*_standing(east, north, heading, x, z), ZONE)
        year, month = int(rng.integers(2008, 2024)), int(rng.choice(SEASON_MONTHS[conditions.season]))
        bearing = int(heading + math.degrees(yaw)) + (360 if rng.random() < 0.1 else 0)  # raw, as in the original
        lat, lon, pano = str(latitude), str(longitude), _pano(rng)
        name = f"{code}_{place_id % 100000:07d}_{year:04d}_{month:02d}_{bearing:03d}_{lat}_{lon}_{pano}{suffix}"
        row = f"{place_id},{year},{month},{bearing},{code},{lat},{lon},{pano}"
        photos.append(Photo(f"gsv/Images/{code}/{name}", row, key, conditions, x, z, y, yaw, zoom))
    return PlacePhotos(town, (seed, 19, SPLITS["train"], index), tuple(photos))


def _evaluation_place(seed: int, split: str, index: int) -> PlacePhotos:
    """Four survey photos of one fair season for the database, two of other days for the queries."""
    town, number = index % len(TOWNS), index // len(TOWNS)
    rng = np.random.default_rng([seed, 17, SPLITS[split], index])
    east, north = _centre(split, town, number, rng)
    heading = float(rng.uniform(0, 360))
    photos = []
    for view in range(6):
        key = (seed, 18, SPLITS[split], index, view)
        rng = np.random.default_rng(key)
        folder = "database" if view < 4 else "queries"
        conditions = _weather(rng, heading, "survey" if view < 4 else "query")
        x, z, y, yaw, zoom = _pose(rng, 5.0, 0.1)
        if view < 4:  # a survey turns its camera step by step
            yaw += (-0.24, -0.08, 0.08, 0.24)[view]
        utm = _standing(east, north, heading, x, z)
        year = int(rng.integers(2012, 2015)) if view < 4 else int(rng.integers(2016, 2023))
        month = int(rng.choice(SEASON_MONTHS[conditions.season]))
        name = utm_name(
            *utm, heading + math.degrees(yaw), f"{year:04d}{month:02d}", _pano(rng), view if view < 4 else 0
        )
        photos.append(Photo(f"eval/miniature/images/{split}/{folder}/{name}", "", key, conditions, x, z, y, yaw, zoom))
    return PlacePhotos(town, (seed, 19, SPLITS[split], index), tuple(photos))


def utm_name(east: float, north: float, heading: float, timestamp: str, pano: str, tile: int) -> str:
    """A file name in the field's format, `@utm_east@utm_north@zone@letter@lat@lon@pano@tile@heading@...@.jpg`."""
    latitude, longitude = to_degrees(east, north, ZONE)
    where = f"@{east:010.2f}@{north:010.2f}@{ZONE:02d}@{band(latitude)}@{latitude:09.5f}@{longitude:010.5f}"
    return f"{where}@{pano}@{tile:02d}@{int(heading) % 360:03d}@@@@{timestamp}@@.jpg"


def data_frames(planned: list[PlacePhotos]) -> dict[Path, str]:
    """Path under the output folder to the text of each town's CSV."""
    rows: dict[str, list[str]] = {}
    for place in planned:
        for photo in place.photos:
            if photo.row:
                rows.setdefault(TOWNS[place.town].name, []).append(photo.row)
    head = "place_id,year,month,northdeg,city_id,lat,lon,panoid"
    return {Path("gsv/Dataframes") / f"{name}.csv": "\n".join([head, *lines]) + "\n" for name, lines in rows.items()}
