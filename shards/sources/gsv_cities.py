"""Reads GSV-Cities' layout: `Dataframes/<City>.csv` (or .csv.gz) and `Images/<city_id>/*.jpg`.

A photo's file name is made of its row (Ali-bey et al., GSV-Cities, 2022):
`{city_id}_{place_id % 100000:07d}_{year:04d}_{month:02d}_{northdeg:03d}_{lat}_{lon}_{panoid}.jpg`, so columns are read
as text, and latitude and longitude are never rounded. Invariant: a place is keyed by (city_id, place_id), never by the
order of files; a row whose file is not there is named, not skipped.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv

from pipeline.common.errors import DataError, UsageError
from shards.catalogue import Catalogue, build

COLUMNS = ("place_id", "year", "month", "northdeg", "city_id", "lat", "lon", "panoid")
EXTENSIONS = (".jpg", ".jpeg")


def is_gsv_cities(root: Path) -> bool:
    """Whether a folder has the two folders of the layout."""
    return (root / "Dataframes").is_dir() and (root / "Images").is_dir()


def read(root: Path, cities: Sequence[str] = ()) -> Catalogue:
    """The catalogue of a GSV-Cities folder.

    Args:
        root: the folder that holds `Dataframes` and `Images`.
        cities: city_ids to keep; none keeps all.

    Raises:
        DataError: a folder or a data frame is missing or malformed.
        UsageError: a wanted city is in no data frame.
    """
    if not is_gsv_cities(root):
        raise DataError(f"{root}: GSV-Cities' layout needs the folders Dataframes/ and Images/ in it")
    frames = sorted(p for p in (root / "Dataframes").iterdir() if p.name.endswith((".csv", ".csv.gz")))
    if not frames:
        raise DataError(f"{root}/Dataframes: no .csv or .csv.gz file in it")
    files: dict[str, dict[str, tuple[str, int]]] = {}
    tables = []
    known: set[str] = set()
    for frame in frames:
        rows = _read_frame(frame)
        known.update(pc.unique(rows["city_id"]).to_pylist())
        if cities:
            rows = rows.filter(pc.is_in(rows["city_id"], pa.array(list(cities), pa.string())))
        tables.append(_find_files(root, frame, rows, files))
    if unknown := sorted(set(cities) - known):
        raise UsageError(f"--cities: {', '.join(unknown)} in no data frame; there are {', '.join(sorted(known))}")
    table = pa.concat_tables(tables)
    return build("gsv_cities", root, table, unlisted=_unlisted(root, table, cities))


def _read_frame(path: Path) -> pa.Table:
    """The needed columns of a data frame, as trimmed text."""
    options = csv.ConvertOptions(
        column_types=dict.fromkeys(COLUMNS, pa.string()), include_columns=list(COLUMNS), strings_can_be_null=False
    )
    try:
        rows = csv.read_csv(path, convert_options=options)
    except KeyError as error:  # ArrowKeyError
        raise DataError(f"{path}: {str(error).strip(chr(39))}; columns needed: {', '.join(COLUMNS)}") from None
    except (pa.ArrowInvalid, OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: not a readable CSV file: {error}") from None
    trimmed = {name: pc.utf8_trim_whitespace(rows[name]) for name in COLUMNS}
    return pa.table(trimmed)


def _find_files(root: Path, frame: Path, rows: pa.Table, files: dict[str, dict[str, tuple[str, int]]]) -> pa.Table:
    """Rows of a data frame as rows of a catalogue, each with its file's real name and size, or -1."""
    whole = {name: _integers(rows[name], frame, name) for name in ("place_id", "year", "month", "northdeg")}
    place = pc.subtract(whole["place_id"], pc.multiply(pc.divide(whole["place_id"], 100_000), 100_000))
    head = pc.binary_join_element_wise(
        rows["city_id"], *(_padded(n, w) for n, w in ((place, 7), (whole["year"], 4), (whole["month"], 2))),
        _padded(whole["northdeg"], 3), "_",
    )  # fmt: skip
    heads, lats, lons, panoids = (c.to_pylist() for c in (head, rows["lat"], rows["lon"], rows["panoid"]))
    paths, sizes = [], []
    for city, start, lat, lon, panoid in zip(rows["city_id"].to_pylist(), heads, lats, lons, panoids, strict=True):
        if city not in files:
            files[city] = _scan(root / "Images" / city)
        stem = f"{start}_{lat}_{lon}_{panoid}"
        found = files[city].get(stem)
        if found is None and files[city]:  # a frame that was saved with other digits than the file's name
            found = files[city].get(f"{start}_{_as_float(lat)}_{_as_float(lon)}_{panoid}")
        name, size = found or (stem + ".jpg", -1)
        paths.append(f"Images/{city}/{name}")
        sizes.append(size)
    degrees = pc.cast(whole["northdeg"], pa.float64())
    columns = {
        "city": rows["city_id"],
        "place_id": pc.cast(whole["place_id"], pa.string()),
        "path": pa.array(paths, pa.string()),
        "size": pa.array(sizes, pa.int64()),
        "lat": _floats(rows["lat"], frame, "lat"),
        "lon": _floats(rows["lon"], frame, "lon"),
        "year": pc.cast(whole["year"], pa.int32()),
        "month": pc.cast(whole["month"], pa.int32()),
        "bearing": pc.subtract(degrees, pc.multiply(pc.floor(pc.divide(degrees, 360.0)), 360.0)),
    }
    return pa.table(columns)


def _scan(folder: Path) -> dict[str, tuple[str, int]]:
    """File name without extension -> (file name, bytes) of the JPEG files of a city; empty where there is no folder."""
    if not folder.is_dir():
        return {}
    found = []
    with os.scandir(folder) as entries:
        for entry in entries:
            stem, extension = os.path.splitext(entry.name)  # noqa: PTH122 - half a million names: no Path objects
            if extension.lower() in EXTENSIONS and not stem.startswith("._") and entry.is_file():
                found.append((stem, (entry.name, entry.stat().st_size)))
    return dict(sorted(found, reverse=True))  # where two differ in their extension only, the first in order stays


def _unlisted(root: Path, table: pa.Table, cities: Sequence[str]) -> int:
    """JPEG files that no row names."""
    named = set(table["path"].to_pylist())
    folders = [f for f in (root / "Images").iterdir() if f.is_dir() and (not cities or f.name in cities)]
    names = (f"Images/{f.name}/{e.name}" for f in folders for e in os.scandir(f) if e.name[:2] != "._")
    return sum(name not in named for name in names if name.lower().endswith(EXTENSIONS))


def _integers(column: pa.ChunkedArray, frame: Path, name: str) -> pa.ChunkedArray:
    """Text as whole numbers; "2015.0" passes too."""
    try:
        return pc.cast(column, pa.int64())
    except pa.ArrowInvalid:
        values = _floats(column, frame, name)
    try:
        return pc.cast(values, pa.int64())
    except pa.ArrowInvalid as error:
        raise DataError(f"{frame}: column {name} is to hold whole numbers: {error}") from None


def _floats(column: pa.ChunkedArray, frame: Path, name: str) -> pa.ChunkedArray:
    try:
        return pc.cast(column, pa.float64())
    except pa.ArrowInvalid as error:
        raise DataError(f"{frame}: column {name} is to hold numbers: {error}") from None


def _padded(values: pa.ChunkedArray, width: int) -> pa.ChunkedArray:
    """`f"{value:0{width}d}"` of each value, also of negative ones."""
    digits = pc.cast(pc.abs(values), pa.string())
    minus = pc.binary_join_element_wise("-", pc.utf8_lpad(digits, width - 1, "0"), "")
    return pc.if_else(pc.less(values, 0), minus, pc.utf8_lpad(digits, width, "0"))


def _as_float(text: str) -> str:
    return str(float(text))
