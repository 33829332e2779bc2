"""Reads Mapillary Street-Level Sequences as Mapillary ships them (Warburg et al., 2020).

`train_val/<city>/{query,database}/` holds `images/<key>.jpg` and, from the archive metadata.zip, `postprocessed.csv`
(easting, northing, view_direction), `raw.csv` (lat, lon, compass angle, date, panorama) and `seq_info.csv` (sequence,
frame number). A place is a square cell of the map (25 m by default, the distance that counts as the same place in
MSLS) and a sector of the direction that its photos look in (60 degrees by default), of both sides together.

The direction is that of the sequence: from a photo's neighbours in its sequence, turned round for cameras that look
backward. Phones' compass angles are used only for photos that look sideways, stand still or are alone in their
sequence. Panoramas are not used. The validation cities are left out unless they are named, because who trains on them
cannot validate on MSLS-val.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from pipeline.common.errors import DataError, UsageError
from pipeline.common.text import shown
from shards.catalogue import SCHEMA, Catalogue, build
from shards.sources.frames import numbers, read_frame, whole_numbers
from shards.sources.listing import is_debris, names_in, size_of
from shards.sources.street_view import cell_name, sector_name

SIDES = ("database", "query")
VALIDATION_CITIES = ("cph", "sf")
_STILL = 0.5  # metres between neighbours that tell no direction


def find_cities(root: Path) -> Path | None:
    """The folder whose sub-folders are cities: `root` or its `train_val`; None where there is none.

    Raises:
        UsageError: `root` is a single city, or has the photos without the tables.
    """
    for base in (root / "train_val", root):
        if not base.is_dir():
            continue
        cities = [name for name in names_in(base) if any((base / name / side / "images").is_dir() for side in SIDES)]
        if any((base / city / side / "postprocessed.csv").is_file() for city in cities for side in SIDES):
            return base
        both = [city for city in cities if all((base / city / side / "images").is_dir() for side in SIDES)]
        if both or (cities and base.name.lower() == "train_val"):
            raise UsageError(
                f"{shown(base / cities[0])}: has Mapillary SLS's photos but no postprocessed.csv; extract its "
                f"metadata.zip into {shown(base.parent)}"
            )
    if any((root / side / "postprocessed.csv").is_file() for side in SIDES):
        raise UsageError(
            f"{shown(root)}: is one city of Mapillary SLS; give --source {shown(root.parent)} --cities {root.name}"
        )
    if (root / "postprocessed.csv").is_file() or all((root / side / "images").is_dir() for side in SIDES):
        raise UsageError(f"{shown(root)}: is a part of a city of Mapillary SLS; give the folder that holds the cities")
    return None


def read(root: Path, cities: Sequence[str] = (), cell_m: float = 25.0, heading_deg: float = 60.0) -> Catalogue:
    """The catalogue of the training photos of MSLS.

    Args:
        root: the folder that holds `train_val`, or `train_val` itself.
        cities: cities to keep; none keeps all but the validation cities.
        cell_m: side of a place's cell in metres.
        heading_deg: width of a place's sector of directions in degrees; 0 puts all directions together.

    Raises:
        DataError: a table is missing or malformed.
        UsageError: a wanted city is not there.
    """
    base = find_cities(root)
    if base is None:
        raise DataError(f"{shown(root)}: Mapillary SLS's layout needs train_val/<city>/database/postprocessed.csv")
    present = [name for name in names_in(base) if any((base / name / side).is_dir() for side in SIDES)]
    if unknown := sorted(set(cities) - set(present)):
        raise UsageError(f"--cities: no {', '.join(unknown)} in {shown(base)}; there are {', '.join(present)}")
    kept = [city for city in present if city in cities or (not cities and city not in VALIDATION_CITIES)]
    remarks = []
    if spared := sorted(set(present) - set(kept) - set(cities)) if not cities else []:
        remarks.append(
            f"{', '.join(spared)}: the validation cities of MSLS are left out; name them in --cities to train on them"
        )
    if empty := [city for city in kept if not any((base / city / side / "images").is_dir() for side in SIDES)]:
        remarks.append(f"no photos of {', '.join(empty)}: there is no images/ in their folders, so they are left out")
        kept = [city for city in kept if city not in empty]
    tables, panoramas, unheaded, unlisted = [], 0, 0, 0
    for city in kept:
        for side in SIDES:
            folder = base / city / side
            if not folder.is_dir():
                continue
            table, round_ones, without, extra = _side(root, folder, city, cell_m, heading_deg)
            tables.append(table)
            panoramas, unheaded, unlisted = panoramas + round_ones, unheaded + without, unlisted + extra
    if panoramas:
        remarks.append(f"{panoramas:,} panoramas are not used")
    if unheaded and heading_deg > 0:
        remarks.append(f"{unheaded:,} photos have no direction: one place for all directions of their cell")
    return build("msls", root, pa.concat_tables(tables or [SCHEMA.empty_table()]), unlisted=unlisted, remarks=remarks)


def _side(root: Path, folder: Path, city: str, cell_m: float, heading_deg: float) -> tuple[pa.Table, int, int, int]:
    """Rows of a catalogue of one side of a city, its panoramas, photos without direction, and files no row names."""
    where = _table(folder, "postprocessed", ("key", "easting", "northing", "view_direction"))
    raw = _table(folder, "raw", ("key", "lon", "lat", "ca", "captured_at", "pano"))
    frames = _table(folder, "seq_info", ("key", "sequence_key", "frame_number"))
    raw, frames = (_matched(where, t, folder / f"{name}.csv") for t, name in ((raw, "raw"), (frames, "seq_info")))
    keys = where["key"].to_pylist()
    for row, key in enumerate(keys, 1):
        if not re.fullmatch(r"[\w-]{1,100}", key):
            told = f"row {row}: key is '{shown(key, 60)}', not a photo's name"
            raise DataError(f"{shown(folder / 'postprocessed.csv')}: {told}")
    table = folder / "postprocessed.csv"
    metres = np.stack([numbers(where, name, table, -1e8, 1e8) for name in ("easting", "northing")], axis=1)
    lat = numbers(raw, "lat", folder / "raw.csv", -90, 90)
    lon = numbers(raw, "lon", folder / "raw.csv", -180, 180)
    numbered = whole_numbers(frames, "frame_number", folder / "seq_info.csv", -(10**9), 10**9)
    headings = _headings(
        metres, frames["sequence_key"].to_pylist(), numbered, where["view_direction"].to_pylist(), raw["ca"]
    )
    panorama = np.array([text.lower() == "true" for text in raw["pano"].to_pylist()], bool)
    dates = [re.match(r"([12]\d{3})-(0[1-9]|1[0-2])", text) for text in raw["captured_at"].to_pylist()]
    images = folder / "images"
    inside = f"{images.relative_to(root).as_posix()}/"
    rows: list[dict[str, Any]] = []
    for i in np.flatnonzero(~panorama).tolist():
        heading = float(headings[i]) if np.isfinite(headings[i]) else None
        name, date, (east, north) = f"{keys[i]}.jpg", dates[i], metres[i].tolist()
        rows.append(
            {"city": city, "place_id": cell_name(east, north, cell_m) + sector_name(heading, heading_deg),
             "path": inside + name, "size": size_of(str(images / name)), "lat": lat[i], "lon": lon[i],
             "year": int(date[1]) if date else None, "month": int(date[2]) if date else None, "bearing": heading}
        )  # fmt: skip
    named = {f"{key}.jpg" for key in keys}
    extra = [n for n in (names_in(images) if images.is_dir() else []) if n not in named and not is_debris(n)]
    unheaded = int((~np.isfinite(headings) & ~panorama).sum())
    return pa.Table.from_pylist(rows, SCHEMA), int(panorama.sum()), unheaded, len(extra)


def _table(folder: Path, name: str, columns: Sequence[str]) -> pa.Table:
    path = folder / f"{name}.csv"
    if not path.is_file():
        raise DataError(f"{shown(path)}: missing; extract Mapillary SLS's metadata.zip over the photos")
    return read_frame(path, columns)


def _matched(where: pa.Table, table: pa.Table, path: Path) -> pa.Table:
    """The rows of a table in the order of postprocessed.csv's keys."""
    rows = pc.index_in(where["key"], value_set=table["key"].combine_chunks())
    if rows.null_count:
        key = where["key"][int(np.flatnonzero(rows.is_null().to_numpy())[0])].as_py()
        raise DataError(f"{shown(path)}: no row with the key '{shown(key, 60)}', which postprocessed.csv names")
    return table.take(rows)


def _headings(
    metres: NDArray[np.float64], sequences: list[str], frame: NDArray[np.int64], views: list[str], compass: Any
) -> NDArray[np.float64]:
    """The direction each photo looks in, degrees clockwise from north, [n]; NaN where nothing tells it."""
    n = len(metres)
    codes = np.unique(np.array(sequences, dtype=object).astype(str), return_inverse=True)[1] if n else np.zeros(0, int)
    order = np.lexsort((frame, codes))
    first, last = np.arange(n), np.arange(n)  # the neighbours of the i-th photo in the order of its sequence
    same = codes[order][1:] == codes[order][:-1]
    first[1:] -= same
    last[:-1] += same
    step = metres[order[last]] - metres[order[first]]
    travel = np.full(n, np.nan)
    travel[order] = np.where(np.hypot(*step.T) >= _STILL, np.degrees(np.arctan2(step[:, 0], step[:, 1])) % 360, np.nan)
    turn = np.array([{"forward": 0.0, "backward": 180.0}.get(view.lower(), np.nan) for view in views])
    looking = (travel + turn) % 360
    told = pc.cast(pc.if_else(pc.match_substring_regex(compass, r"^-?\d+(\.\d*)?$"), compass, None), pa.float64())
    angle = told.to_numpy() % 360
    headings: NDArray[np.float64] = np.where(np.isfinite(looking), looking, angle) % 360  # -1e-20 % 360 is 360
    return headings
