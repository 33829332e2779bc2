"""Reads GSV-Cities' layout: `Dataframes/<City>.csv` (or .csv.gz) and `Images/<city_id>/*.jpg`.

A photo's file name is made of its row (Ali-bey et al., GSV-Cities, 2022):
`{city_id}_{place_id % 100000:07d}_{year:04d}_{month:02d}_{northdeg:03d}_{lat}_{lon}_{panoid}.jpg`, so columns are read
as text, and latitude and longitude are never rounded. Invariant: a place is keyed by (city_id, place_id), never by the
order of files; a row whose file is not there is named, not skipped; no row leads out of the folder.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.common.errors import DataError, UsageError
from pipeline.common.text import shown
from shards.catalogue import Catalogue, build
from shards.sources.frames import numbers, read_frame, whole_numbers
from shards.sources.listing import MISSING, UNREADABLE, is_debris, names_in

COLUMNS = ("place_id", "year", "month", "northdeg", "city_id", "lat", "lon", "panoid")
EXTENSIONS = (".jpg", ".jpeg")
FOLDERS = ("Dataframes", "Images")
PHOTO_NAME = re.compile(r"[^/_]+_\d{7}_\d{4}_\d{2}_-?\d{2,}_-?\d+(\.\d+)?_-?\d+(\.\d+)?_.+\.jpe?g", re.IGNORECASE)


class Layout(NamedTuple):
    """The two folders as they are spelled on disk."""

    frames: Path
    images: Path


def find_layout(root: Path) -> Layout | None:
    """The two folders, in any case of letters; None where one is not there."""
    by_name = {name.lower(): root / name for name in names_in(root)}
    by_name.update(
        (name.lower(), root / name) for name in FOLDERS if (root / name).is_dir()
    )  # the usual spelling first
    found = [by_name.get(name.lower()) for name in FOLDERS]
    frames, images = found
    return Layout(frames, images) if frames and images and frames.is_dir() and images.is_dir() else None


def read(root: Path, cities: Sequence[str] = ()) -> Catalogue:
    """The catalogue of a GSV-Cities folder.

    Args:
        root: the folder that holds `Dataframes` and `Images`.
        cities: city_ids to keep; none keeps all.

    Raises:
        DataError: a folder or a data frame is missing or malformed.
        UsageError: a wanted city is in no data frame.
    """
    layout = find_layout(root)
    if layout is None:
        raise DataError(f"{root}: GSV-Cities' layout needs the folders Dataframes/ and Images/ in it")
    frames = [layout.frames / name for name in names_in(layout.frames) if name.lower().endswith((".csv", ".csv.gz"))]
    if not frames:
        raise DataError(f"{layout.frames}: no .csv or .csv.gz file in it")
    files: dict[str, dict[str, tuple[str, int]] | None] = {}
    tables = []
    known: set[str] = set()
    for frame in frames:
        rows = read_frame(frame, COLUMNS)
        _check_cities(rows["city_id"], frame)
        known.update(pc.unique(rows["city_id"]).to_pylist())
        if cities:
            rows = rows.filter(pc.is_in(rows["city_id"], pa.array(list(cities), pa.string())))
        tables.append(_find_files(layout.images, frame, rows, files))
    if unknown := sorted(set(cities) - known):
        raise UsageError(f"--cities: {', '.join(unknown)} not in any data frame; there are {', '.join(sorted(known))}")
    table = pa.concat_tables(tables)
    return build("gsv_cities", root, table, unlisted=_unlisted(layout.images, table, cities))


def _check_cities(column: pa.ChunkedArray, frame: Path) -> None:
    """A city_id becomes the name of a folder: one that leads elsewhere is refused."""
    for city in pc.unique(column).to_pylist():
        if city in ("", ".", "..") or len(city) > 100 or not city.isprintable() or re.search(r"[/\\]", city):
            row = column.to_pylist().index(city) + 1
            told = f"row {row}: city_id is '{shown(city, 60)}', not the plain name of a folder in Images/"
            raise DataError(f"{shown(frame)}: {told}; correct or remove the row")


def _find_files(
    images: Path, frame: Path, rows: pa.Table, files: dict[str, dict[str, tuple[str, int]] | None]
) -> pa.Table:
    """Rows of a data frame as rows of a catalogue, each with its file's real name and size, or -1."""
    place_id = whole_numbers(rows, "place_id", frame, 0, 10**15)
    year = whole_numbers(rows, "year", frame, 1800, 2999)
    month = whole_numbers(rows, "month", frame, 0, 99)
    northdeg = whole_numbers(rows, "northdeg", frame, -100_000, 100_000)
    lat, lon = numbers(rows, "lat", frame, -90, 90), numbers(rows, "lon", frame, -180, 180)
    texts = [rows[name].to_pylist() for name in ("city_id", "lat", "lon", "panoid")]
    paths, sizes = [], []
    for city, lat_text, lon_text, panoid, *whole in zip(
        *texts, (place_id % 100_000).tolist(), year.tolist(), month.tolist(), northdeg.tolist(), strict=True
    ):
        if city not in files:
            files[city] = _scan(images / city)
        there = files[city]
        start = "{}_{:07d}_{:04d}_{:02d}_{:03d}".format(city, *whole)
        stem = f"{start}_{lat_text}_{lon_text}_{panoid}"
        found = there.get(stem) if there else None
        if found is None and there:  # a frame that was saved with other digits than the file's name
            found = there.get(f"{start}_{float(lat_text)}_{float(lon_text)}_{panoid}")
        name, size = found or (stem + ".jpg", UNREADABLE if there is None else MISSING)
        paths.append(f"{images.name}/{city}/{name}")
        sizes.append(size)
    columns = {
        "city": rows["city_id"],
        "place_id": pa.array(place_id).cast(pa.string()),
        "path": pa.array(paths, pa.string()),
        "size": pa.array(sizes, pa.int64()),
        "lat": pa.array(lat),
        "lon": pa.array(lon),
        "year": pa.array(year.astype(np.int32)),
        "month": pa.array(month.astype(np.int32)),
        "bearing": pa.array(np.mod(northdeg, 360).astype(np.float64)),
    }
    return pa.table(columns)


def _scan(folder: Path) -> dict[str, tuple[str, int]] | None:
    """File name without extension -> (file name, bytes) of the JPEG files of a city; empty where there is no folder,
    None where it cannot be read."""
    if not folder.is_dir():
        return {}
    found = []
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                stem, extension = os.path.splitext(entry.name)  # noqa: PTH122 - half a million names: no Path objects
                if extension.lower() in EXTENSIONS and not is_debris(entry.name) and entry.is_file():
                    found.append((stem, (entry.name, entry.stat().st_size)))
    except OSError:
        return None
    return dict(sorted(found, reverse=True))  # where two differ in their extension only, the first in order stays


def _unlisted(images: Path, table: pa.Table, cities: Sequence[str]) -> int:
    """JPEG files that no row names."""
    named = set(table["path"].to_pylist())
    count = 0
    for city in (name for name in names_in(images) if not cities or name in cities):
        try:
            names = names_in(images / city)
        except DataError:  # a loose file; or a folder whose rows, where it has any, are named as unreadable
            continue
        photos = (name for name in names if name.lower().endswith(EXTENSIONS))
        count += sum(f"{images.name}/{city}/{name}" not in named for name in photos)
    return count
