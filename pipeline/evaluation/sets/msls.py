"""Mapillary Street-Level Sequences: the 740 queries of MSLS-val, and MSLS-challenge with its cities apart.

Invariant: MSLS-val is always the official validation protocol (subtask `all`, no panorama, queries with a positive
within 25 m), whatever the layout on disk; the about 11,000 queries that other tools keep are another set, and are
never taken for this one. MSLS-challenge is retrieved within each city, so its parts are marked on the set.
"""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.common.errors import DataError
from pipeline.common.files import replacing
from pipeline.config import EvaluationConfig
from pipeline.evaluation.sets.evaluation_set import EvaluationSet, list_images
from pipeline.evaluation.sets.fixed_lists import existing
from pipeline.evaluation.sets.ground_truth import within_radius
from pipeline.evaluation.sets.layouts import database_folder, from_folders
from pipeline.evaluation.sets.npy_lists import read_strings

VAL_CITIES = ("cph", "sf")
CHALLENGE_CITIES = ("miami", "athens", "buenosaires", "stockholm", "bengaluru", "kampala")
RADIUS = 25.0
QUERY_LISTS = ("msls_val_qImages.npy", "msls_val_queries.txt")


class _Side(NamedTuple):
    """Photos of a city's database or queries, and where they were taken (None: not known)."""

    photos: list[Path]
    positions: np.ndarray | None


def val(name: str, folder: Path, config: EvaluationConfig) -> EvaluationSet:
    """MSLS-val from the original layout (train_val/<city>), or from @utm folders beside a list of its queries."""
    cities = original_cities(folder)
    if cities:
        return _official(_val_original(name, cities, config))
    base = utm_base(folder)
    if base is None:
        raise DataError(
            f"{folder}: expected train_val/{{cph,sf}} as Mapillary ships it, or images/val/{{database,queries}}"
        )
    keys = _official_keys([folder, folder.parent])
    if keys is None:
        raise DataError(
            f"{base / 'queries'}: file names do not tell the 740 official queries from the others; put "
            f"{QUERY_LISTS[0]}, a text file {QUERY_LISTS[1]} (a key or path a line) or Mapillary's "
            f"train_val/<city>/query/subtask_index.csv into {folder}"
        )
    everything = from_folders(name, base, config)
    if everything.query_positions is None:
        raise DataError(f"{everything.queries[0]}: no @UTM_east@UTM_north@ in this name")
    kept = [at for at, path in enumerate(everything.queries) if not keys.isdisjoint(_fields(path))]
    remark = f"{len(kept):,} of {len(everything.queries):,} queries are in the official list; the others are not asked"
    return _official(_take(everything, kept, remark))


def original_cities(folder: Path) -> list[Path]:
    """Folders of the validation cities as Mapillary ships them with positions; empty unless all are there."""
    cities = [folder / "train_val" / city for city in VAL_CITIES]
    return cities if all((city / "query" / "postprocessed.csv").exists() for city in cities) else []


def utm_base(folder: Path) -> Path | None:
    """The folder with database/ and queries/ of the @utm layout: val, or test, which is often a link to it."""
    for place in ("images/val", "images/test", "val", "test", "."):
        if database_folder(folder / place) is not None and (folder / place / "queries").is_dir():
            return folder / place
    return None


def challenge_cities(folder: Path) -> list[str]:
    """The test cities whose photos are on disk, in the benchmark's order."""
    return [city for city in CHALLENGE_CITIES if (folder / "test" / city / "query" / "images").is_dir()]


def _fields(path: Path) -> set[str]:
    return {field.removesuffix(path.suffix) for field in path.name.split("@")}


def _take(loaded: EvaluationSet, kept: Sequence[int], remark: str) -> EvaluationSet:
    positions = loaded.query_positions
    return dataclasses.replace(
        loaded,
        queries=[loaded.queries[at] for at in kept],
        positives=[loaded.positives[at] for at in kept],
        query_positions=None if positions is None else positions[list(kept)],
        remarks=(*loaded.remarks, remark),
    )


def _official(loaded: EvaluationSet) -> EvaluationSet:
    """Without the queries that have no positive within 25 m (7 of 747), whatever radius is asked for."""
    assert loaded.database_positions is not None and loaded.query_positions is not None
    near = within_radius(loaded.database_positions, loaded.query_positions, RADIUS)
    kept = [at for at, rows in enumerate(near) if len(rows)]
    if len(kept) == len(near):
        return loaded
    gone = len(near) - len(kept)
    return _take(
        loaded, kept, f"{gone} official queries have no positive within 25 m and are left out, as by Mapillary"
    )


def _official_keys(folders: Sequence[Path]) -> set[str] | None:
    """Keys of the official queries from the first list found; panoramas do not matter, they are in no @utm folder."""
    for folder in folders:
        tables = [folder / "train_val" / city / "query" / "subtask_index.csv" for city in VAL_CITIES]
        if all(table.exists() for table in tables):
            return {row["key"] for table in tables for row in _rows(table) if row["all"] == "True"}
        if (folder / QUERY_LISTS[0]).exists():
            return {Path(line).stem for line in read_strings(folder / QUERY_LISTS[0])}
        if (folder / QUERY_LISTS[1]).exists():
            lines = (folder / QUERY_LISTS[1]).read_text(encoding="utf-8").splitlines()
            return {Path(line.strip()).stem for line in lines if line.strip()}
    return None


def _val_original(name: str, cities: Sequence[Path], config: EvaluationConfig) -> EvaluationSet:
    """Both cities as one set, in the order that @utm names would have, so that `ordered` groups mean the same."""
    sides = []
    for side in ("database", "query"):
        photos: list[Path] = []
        places: list[tuple[float, float]] = []
        for city in cities:
            wanted = _wanted_rows(city / side)
            photos += [city / side / "images" / f"{row['key']}.jpg" for row in wanted]
            places += [(float(row["easting"]), float(row["northing"])) for row in wanted]
        order = sorted(range(len(photos)), key=lambda at: (*places[at], photos[at].name))
        positions = np.array(places, np.float64).reshape(-1, 2)[order]
        sides.append((existing([photos[at] for at in order], str(cities[0].parent)), positions))
    (database, of_database), (queries, of_queries) = sides
    near = within_radius(of_database, of_queries, config.radius)
    return EvaluationSet(name, database, queries, near, f"{config.radius:g} m", of_database, of_queries)


def _wanted_rows(folder: Path) -> list[dict[str, str]]:
    """Rows of postprocessed.csv in subtask `all` that are no panorama; the three tables go row by row."""
    places, raw, tasks = (_rows(folder / f"{table}.csv") for table in ("postprocessed", "raw", "subtask_index"))
    if not len(places) == len(raw) == len(tasks):
        raise DataError(
            f"{folder}: postprocessed.csv, raw.csv and subtask_index.csv differ in length; download them anew"
        )
    try:
        return [
            place
            for place, photo, task in zip(places, raw, tasks, strict=True)
            if task["all"] == "True" and photo["pano"] != "True"
        ]
    except KeyError as error:
        raise DataError(f"{folder}: no column {error} in raw.csv or subtask_index.csv") from error


def _rows(table: Path) -> list[dict[str, str]]:
    try:
        with table.open(newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))
    except OSError as error:
        raise DataError(f"{table}: cannot be read ({error.strerror})") from error


def challenge(name: str, folder: Path, config: EvaluationConfig) -> EvaluationSet:
    """MSLS-challenge, each city a part; scored where the public ground truth (postprocessed.csv) is present."""
    present = challenge_cities(folder)
    if not present:
        raise DataError(f"{folder / 'test'}: expected {'/, '.join(CHALLENGE_CITIES)}/ here, with query/ and database/")
    database: list[Path] = []
    queries: list[Path] = []
    parts: tuple[list[int], list[int]] = ([], [])
    known: list[tuple[np.ndarray, np.ndarray]] = []
    for part, city in enumerate(present):
        in_database, in_queries = _challenge_side(folder, city, "database"), _challenge_side(folder, city, "query")
        database += in_database.photos
        queries += in_queries.photos
        parts[0].extend([part] * len(in_database.photos))
        parts[1].extend([part] * len(in_queries.photos))
        if in_database.positions is not None and in_queries.positions is not None:
            known.append((in_database.positions, in_queries.positions))
    of_database, of_queries = np.array(parts[0], np.int64), np.array(parts[1], np.int64)
    remarks = [f"without {city}, which is not on disk" for city in CHALLENGE_CITIES if city not in present]
    scored = len(known) == len(present)
    unscored = "no ground truth (postprocessed.csv, public since 2026): predictions can be exported, not scored"
    where = np.concatenate([a for a, _ in known]) if scored else None
    asked = np.concatenate([b for _, b in known]) if scored else None
    positives = [np.zeros(0, np.int64) for _ in queries]
    if where is not None and asked is not None:
        positives = within_radius(where, asked, config.radius, (of_database, of_queries))
    return EvaluationSet(
        name,
        database,
        queries,
        positives,
        f"{config.radius:g} m within the city" if scored else "no ground truth",
        where,
        asked,
        of_database,
        of_queries,
        scored,
        tuple(remarks if scored else [*remarks, unscored]),
    )


def _challenge_side(folder: Path, city: str, side: str) -> _Side:
    """Photos of subtask `all` in the table's order, else every photo; positions from where the ground truth lies."""
    images = folder / "test" / city / side / "images"
    places = [folder / part / city / side for part in ("test", "test_meta")]
    tasks = next((p / "subtask_index.csv" for p in places if (p / "subtask_index.csv").exists()), None)
    if tasks is None:
        photos = list_images(images)
    else:
        photos = existing([images / f"{row['key']}.jpg" for row in _rows(tasks) if row["all"] == "True"], str(tasks))
    truth = next((p / "postprocessed.csv" for p in places if (p / "postprocessed.csv").exists()), None)
    if truth is None:
        return _Side(photos, None)
    at = {row["key"]: (float(row["easting"]), float(row["northing"])) for row in _rows(truth)}
    unknown = [photo for photo in photos if photo.stem not in at]
    if unknown:
        raise DataError(f"{truth}: no position for {unknown[0].name}, nor for {len(unknown) - 1} others")
    return _Side(photos, np.array([at[photo.stem] for photo in photos], np.float64).reshape(-1, 2))


def _key(photo: Path) -> str:
    """Mapillary's key: the stem, or field 7 of an @utm name."""
    fields = photo.name.split("@")
    return fields[7] if len(fields) > 8 else photo.stem


def export_predictions(loaded: EvaluationSet, predictions: np.ndarray, path: Path) -> None:
    """Writes Mapillary's prediction file: a line a query, `query_key key1 key2 ...`, best first.

    `predictions` [Q, K] holds database rows; negative entries (padding) are left out. Raises `DataError` where a
    prediction leaves the query's city, since the benchmark retrieves within each.
    """
    rows = np.asarray(predictions)
    if len(rows) != len(loaded.queries):
        raise DataError(f"{path}: predictions of {len(rows):,} queries for a set of {len(loaded.queries):,}")
    if loaded.database_part is not None and loaded.query_part is not None:
        strays = (rows >= 0) & (loaded.database_part[rows] != loaded.query_part[:, None])
        if strays.any():
            query = loaded.queries[int(np.argmax(strays.any(axis=1)))]
            raise DataError(f"{path}: predictions of {query} lie in another city; retrieve within each city")
    keys = [_key(photo) for photo in loaded.database]
    lines = [
        " ".join([_key(query), *(keys[row] for row in found if row >= 0)])
        for query, found in zip(loaded.queries, rows.tolist(), strict=True)
    ]
    with replacing(path) as partial:
        partial.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_predictions(loaded: EvaluationSet, path: Path) -> np.ndarray:
    """A prediction file as database rows [Q, K], padded with -1: scores any tool's file with `recall_at`.

    Lines for other queries are ignored, as by Mapillary's script. Raises `DataError` for a query without a line and
    for keys that are no database image.
    """
    row_of = {_key(photo): row for row, photo in enumerate(loaded.database)}
    lines = (line.split() for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#"))
    given = {fields[0]: fields[1:] for fields in lines if fields}
    missing = [query for query in loaded.queries if _key(query) not in given]
    if missing:
        raise DataError(f"{path}: no line for query {_key(missing[0])}, nor for {len(missing) - 1} others")
    width = max((len(keys) for keys in given.values()), default=0)
    rows = np.full((len(loaded.queries), width), -1, np.int64)
    for at, query in enumerate(loaded.queries):
        for rank, key in enumerate(given[_key(query)]):
            if key not in row_of:
                raise DataError(f"{path}: '{key}', predicted for {_key(query)}, is no database image of {loaded.name}")
            rows[at, rank] = row_of[key]
    return rows
