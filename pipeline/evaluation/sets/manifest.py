"""A set written down by its owner: one row a photo, in a CSV or Parquet file.

Columns: `image` (path, relative to the file), `role` (`database` or `query`), and one way to tell what is correct:
`positives` (database images, `;` between them, or a list in Parquet), `frame` (whole number), `utm_east` and
`utm_north` (metres), or `lat` and `lon` (degrees, WGS84). The first of these that is there decides.
Invariant: photos keep the order of the rows; every complaint names the file and the row.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.common.errors import DataError, UsageError
from pipeline.common.text import shown
from pipeline.config import EvaluationConfig
from pipeline.evaluation.sets.evaluation_set import EvaluationSet, clean_name
from pipeline.evaluation.sets.fixed_lists import existing
from pipeline.evaluation.sets.ground_truth import within_frames, within_radius
from pipeline.evaluation.sets.utm import degrees_for_metres, to_utm

SUFFIXES = (".csv", ".parquet")


def from_manifest(path: Path, config: EvaluationConfig) -> EvaluationSet:
    """The set of the manifest `path`. Raises `DataError` for missing columns, values or photos."""
    rows = _read(path)
    if not rows:
        raise DataError(f"{path}: no rows; expected the columns image, role and a position a row")
    columns = rows[0].keys()
    for column in ("image", "role"):
        if column not in columns:
            raise DataError(f"{path}: no column '{column}'; it has {shown(', '.join(columns))}")
    split: dict[str, list[int]] = {"database": [], "query": []}
    for at, row in enumerate(rows):
        if row["role"] not in split:
            raise DataError(f"{path}, row {at + 1}: role is '{shown(row['role'])}'; it can be database or query")
        split[row["role"]].append(at)
    database, queries = ([rows[at] for at in split[role]] for role in ("database", "query"))
    photos = [existing([path.parent / str(row["image"]) for row in side], str(path)) for side in (database, queries)]
    places, remarks = _positions(path, rows)
    of_database = None if places is None else places[split["database"]]
    of_queries = None if places is None else places[split["query"]]
    if "positives" in columns:
        positives, rule = _listed(path, database, queries), "listed positives"
    elif "frame" in columns:
        numbers = _numbers(path, rows, "frame")
        if (numbers != np.round(numbers)).any():
            raise DataError(
                f"{path}: column 'frame' holds {numbers[numbers != np.round(numbers)][0]}, not a whole number"
            )
        whole, frames = numbers.astype(np.int64), config.frames or 0
        positives = within_frames(whole[split["database"]], whole[split["query"]], frames)
        rule = f"+-{frames} frames"
    elif of_database is not None and of_queries is not None:
        positives, rule = within_radius(of_database, of_queries, config.radius), f"{config.radius:g} m"
    else:
        raise DataError(
            f"{path}: needs positives, frame, utm_east and utm_north, or lat and lon; it has "
            f"{shown(', '.join(columns))}"
        )
    return EvaluationSet(
        clean_name(path.stem), photos[0], photos[1], positives, rule, of_database, of_queries, remarks=remarks
    )


def manifest_in(folder: Path) -> Path | None:
    """The table in a folder that has the columns of a manifest; None where there is none.

    Raises `UsageError` where several have them.
    """
    found = [file for file in sorted(folder.iterdir()) if file.suffix.lower() in SUFFIXES and _has_columns(file)]
    if len(found) > 1:
        names = ", ".join(shown(file.name) for file in found)
        raise UsageError(f"{folder}: {names} are all manifests; give one of the files instead of the folder")
    return found[0] if found else None


def _has_columns(file: Path) -> bool:
    if file.name.startswith("."):
        return False
    try:
        if file.suffix.lower() == ".parquet":
            from pyarrow import parquet

            columns = set(parquet.read_schema(file).names)
        else:
            with file.open(newline="", encoding="utf-8-sig") as stream:
                columns = set(next(csv.reader(stream), []))
    except (OSError, ValueError, csv.Error):
        return False  # some other file
    return {"image", "role"} <= columns


def read_photos(path: Path) -> tuple[list[Path], np.ndarray | None, str]:
    """The photos of a manifest that need not be a set: paths, positions [n, 2] or None, and what these are.

    Coordinates: `utm` (east, north in metres), `degrees` (latitude, longitude), or `none`. Only `image` is needed;
    where there is a `role`, the rows of role database count. A row with both cells empty has no position: NaN. Raises
    `DataError` for missing photos, and for values that are no numbers.
    """
    rows = _read(path)
    if rows and "role" in rows[0]:
        rows = [row for row in rows if row["role"] == "database"]
    if not rows or "image" not in rows[0]:
        raise DataError(f"{path}: no photos in it; expected a column image, and utm_east and utm_north, or lat and lon")
    photos = existing([path.parent / str(row["image"]) for row in rows], str(path))
    for kind, (first, second) in {"degrees": ("lat", "lon"), "utm": ("utm_east", "utm_north")}.items():
        if {first, second} <= rows[0].keys():
            positions = np.full((len(rows), 2), np.nan)
            told = [at for at, row in enumerate(rows) if not all(row[c] in (None, "") for c in (first, second))]
            positions[told] = np.stack([_numbers(path, rows, c, told)[told] for c in (first, second)], axis=1)
            if kind == "utm" and told:
                _in_metres(path, positions[told])
            return photos, positions, kind
    return photos, None, "none"


def _read(path: Path) -> list[dict[str, Any]]:
    try:
        if path.suffix.lower() == ".parquet":
            from pyarrow import parquet

            return list(parquet.read_table(path).to_pylist())
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows: list[dict[str, Any]] = list(csv.DictReader(file))
    except (OSError, ValueError, csv.Error) as error:
        reason = shown(" ".join(str(error).split()))
        raise DataError(f"{path}: not a readable {path.suffix} table ({reason})") from error
    long = next((at for at, row in enumerate(rows) if None in row), None)
    if long is not None:
        raise DataError(f"{path}, row {long + 1}: has more cells than the first line has columns")
    return rows


def _numbers(path: Path, rows: list[dict[str, Any]], column: str, only: Sequence[int] | None = None) -> np.ndarray:
    """A column as float64 [n], of all rows or `only` some, NaN in the others.

    `DataError` names the first of them without a finite number.
    """
    values = np.full(len(rows), np.nan)
    for at in range(len(rows)) if only is None else only:
        row = rows[at]
        try:
            values[at] = float(row[column])
        except (TypeError, ValueError):
            values[at] = np.nan
        if not np.isfinite(values[at]):
            raise DataError(f"{path}, row {at + 1}: {column} is '{shown(row[column])}', not a number")
    return values


def _in_metres(path: Path, positions: np.ndarray) -> tuple[str, ...]:
    """Remarks about positions [n, 2] that should be metres; `DataError` where they are degrees."""
    degrees = degrees_for_metres(positions)
    if degrees == "yes":
        raise DataError(
            f"{path}: utm_east and utm_north hold degrees ({positions[0, 0]:g}, {positions[0, 1]:g} in row 1); "
            "call the columns lon and lat, or give metres"
        )
    doubt = "utm_east and utm_north are small enough to be degrees; they are taken as metres"
    return (doubt,) if degrees == "maybe" else ()


def _positions(path: Path, rows: list[dict[str, Any]]) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """UTM positions [n, 2] of the rows, None where no columns tell them; and remarks about them."""
    if {"utm_east", "utm_north"} <= rows[0].keys():
        positions = np.stack([_numbers(path, rows, "utm_east"), _numbers(path, rows, "utm_north")], axis=1)
        return positions, _in_metres(path, positions)
    if {"lat", "lon"} <= rows[0].keys():
        try:
            return to_utm(_numbers(path, rows, "lat"), _numbers(path, rows, "lon")), ()
        except DataError as error:
            raise error if str(error).startswith(str(path)) else DataError(f"{path}, {error}") from error
    return None, ()


def _listed(path: Path, database: list[dict[str, Any]], queries: list[dict[str, Any]]) -> list[np.ndarray]:
    row_of = {str(row["image"]): at for at, row in enumerate(database)}
    positives = []
    for row in queries:
        given = row["positives"] or []
        names = (
            [n.strip() for n in given.split(";") if n.strip()] if isinstance(given, str) else [str(n) for n in given]
        )
        unknown = [name for name in names if name not in row_of]
        if unknown:
            raise DataError(
                f"{path}: positive '{shown(unknown[0])}' of query '{shown(row['image'])}' is no database image of "
                "this file"
            )
        positives.append(np.array(sorted({row_of[name] for name in names}), np.int64))
    return positives
