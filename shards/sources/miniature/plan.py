"""Which photos the miniature has, where they lie and what they are called.

Training photos are named as in GSV-Cities, evaluation photos as in the field's `@utm` folders.
Invariant: a pure function of the settings; a photo's file name never changes with the processes that draw it.
Evaluation places share towns, not streets, with the training places.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from shards.sources.miniature.place import kind_of
from shards.sources.miniature.towns import TOWNS
from shards.sources.miniature.weather import SEASON_MONTHS, Conditions, draw_conditions

ZONE = 27  # open ocean: the towns are nobody's
STEP = (10.0, 20.0)  # metres between the places of one street
SPACING = 70.0  # metres between streets of a single place; photos lie within 10 m of their place
SPLITS = {"train": 0, "val": 1, "test": 2}
ALPHABET = np.array(list("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_"))
COLUMNS = 30  # streets of several places beside each other on the map of a town
# how many training places have this many photos; a few have under four, as in GSV-Cities
PHOTOS = {2: 0.015, 3: 0.015, 4: 0.17, 5: 0.18, 6: 0.18, 7: 0.17, 8: 0.11, 9: 0.08, 10: 0.05, 12: 0.03}
# by purpose: metres a camera may stand off along the street, radians it may turn, years from and before
POSES = {"train": (4.5, 0.14, (2008, 2024)), "database": (5.0, 0.1, (2012, 2015)), "queries": (5.0, 0.1, (2016, 2023))}


@dataclass(frozen=True)
class Photo:
    """One picture to draw.

    Args:
        file: path under the output folder; row: its line of the data frame ("" in evaluation folders).
        seed: of everything that is not the place; conditions: season, hour, weather.
        x, z, y: the camera's metres to the right of, ahead of and above the street's origin.
        yaw: radians from the street's own view; zoom: focal length in picture widths.
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
    """A place on a street (town, seed of the street's identity, its length in metres), and photos of it."""

    town: int
    seed: tuple[int, ...]
    length: float
    photos: tuple[Photo, ...]


def plan_photos(seed: int, counts: tuple[int, int, int], a_street: int = 1) -> list[PlacePhotos]:
    """Every place and photo of the miniature by the number of training, validation and test places, in this order;
    `a_street` places share a street."""
    splits = zip(SPLITS, counts, strict=True)
    return [_place(seed, split, index, a_street) for split, count in splits for index in range(count)]


def _place(seed: int, split: str, index: int, a_street: int) -> PlacePhotos:
    """A training place has 2 to 12 photos of any day; the others four of a fair survey and two queries of any day."""
    street, at = divmod(index, a_street)
    number, town = divmod(street, len(TOWNS))
    identity, length = (seed, 19, SPLITS[split], street), STEP[1] * (a_street - 1)
    rng = np.random.default_rng([seed, 17, SPLITS[split], street])
    # streets of one place lie along a winding road, so that sorted file names keep a place together, as in Pitts30k
    row, column = divmod(number, COLUMNS) if length else (0, number)
    apart = 2 * length + 100.0 if length else SPACING
    east = 220000.0 + 150000.0 * town + 50000.0 * SPLITS[split] + apart * column + float(rng.uniform(-6, 6))
    north = 4203000.0 + apart * row + 900.0 * math.sin(column / 9.0 + town) + float(rng.uniform(-6, 6))
    heading = float(rng.uniform(0, 360))
    along = float(np.cumsum([0.0, *rng.uniform(*STEP, a_street - 1)])[at])
    avenue = kind_of(identity, length) == "avenue"
    rng = np.random.default_rng([seed, 20, SPLITS[split], index])
    # ids have gaps; those of two towns pass 100,000, of which the file name keeps the last five digits
    place_id = (100000 if town % 2 else 0) + 3 * (number * a_street + at) + int(rng.integers(3))
    views = int(rng.choice(list(PHOTOS), p=list(PHOTOS.values()))) if split == "train" else 6
    suffix = ".JPG" if rng.random() < 0.4 else ".jpg"
    photos = []
    for view in range(views):
        key = (seed, 18, SPLITS[split], index, view)
        rng = np.random.default_rng(key)
        purpose = split if split == "train" else "database" if view < 4 else "queries"
        reach, turn, years = POSES[purpose]
        conditions = draw_conditions(rng, heading, purpose)
        x, z, y, yaw, zoom = rng.uniform((-reach, -2.2, 1.6, -turn, 0.66), (reach, 2.2, 2.6, turn, 0.84)).tolist()
        yaw += ((-0.24, -0.08, 0.08, 0.24)[view] if purpose == "database" else 0.0) - 0.025 * x  # a survey turns
        x, z = (x, z + along) if avenue else (x + along, z)
        c, s = math.cos(math.radians(heading)), math.sin(math.radians(heading))
        utm, bearing = (east + x * c + z * s, north - x * s + z * c), int(heading + math.degrees(yaw))
        date, pano = (
            (int(rng.integers(*years)), int(rng.choice(SEASON_MONTHS[conditions.season]))),
            "".join(rng.choice(ALPHABET, 22)),
        )
        if split == "train":
            bearing += 360 if rng.random() < 0.1 else 0  # raw, as in the original
            file, line = _gsv_name(TOWNS[town].town, place_id, date, bearing, utm, pano)
            file += suffix
        else:
            file, line = f"eval/miniature/images/{split}/{purpose}/{utm_name(*utm, bearing, date, pano, view % 4)}", ""
        photos.append(Photo(file, line, key, conditions, x, z, y, yaw, zoom))
    return PlacePhotos(town, identity, length, tuple(photos))


@cache
def _to_degrees() -> Any:
    from pyproj import Transformer

    return Transformer.from_crs(32600 + ZONE, 4326, always_xy=True).transform


def degrees(east: float, north: float) -> tuple[float, float]:
    """Latitude and longitude (WGS 84) of UTM metres in the miniature's zone, to about a centimetre."""
    longitude, latitude = _to_degrees()(east, north)
    return round(latitude, 7), round(longitude, 7)


def _gsv_name(
    code: str, place_id: int, date: tuple[int, int], bearing: int, utm: tuple[float, float], pano: str
) -> tuple[str, str]:
    """A photo's file without its suffix, and its row, as GSV-Cities writes them."""
    (year, month), (lat, lon) = date, degrees(*utm)
    name = f"{code}_{place_id % 100000:07d}_{year:04d}_{month:02d}_{bearing:03d}_{lat}_{lon}_{pano}"
    return f"gsv/Images/{code}/{name}", f"{place_id},{year},{month},{bearing},{code},{lat},{lon},{pano}"


def utm_name(east: float, north: float, heading: int, date: tuple[int, int], pano: str, tile: int) -> str:
    """A file name in the field's format, `@utm_east@utm_north@zone@letter@lat@lon@pano@tile@heading@...@.jpg`."""
    latitude, longitude = degrees(east, north)
    letter = "CDEFGHJKLMNPQRSTUVWX"[int((latitude + 80) // 8)]  # of the band of 8 degrees
    where = f"@{east:010.2f}@{north:010.2f}@{ZONE:02d}@{letter}@{latitude:09.5f}@{longitude:010.5f}"
    return f"{where}@{pano}@{tile:02d}@{heading % 360:03d}@@@@{date[0]:04d}{date[1]:02d}@@.jpg"


def data_frames(planned: list[PlacePhotos]) -> dict[Path, str]:
    """Path under the output folder to the text of each town's CSV."""
    rows: dict[str, list[str]] = {}
    for place in planned:
        rows.setdefault(TOWNS[place.town].name, []).extend(photo.row for photo in place.photos if photo.row)
    head = "place_id,year,month,northdeg,city_id,lat,lon,panoid"
    return {
        Path("gsv/Dataframes") / f"{name}.csv": "\n".join([head, *lines]) + "\n"
        for name, lines in rows.items()
        if lines
    }
