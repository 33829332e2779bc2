"""Reads a folder of a user's own places, in one of two layouts.

- `folders`: each folder that directly holds photos is a place; what lies above it names the city. So
  `cafe/1.jpg` is place "cafe" of city ".", and `Lisbon/cafe/1.jpg` is place "cafe" of city "Lisbon".
- `utm`: photos anywhere below, named `@UTM_east@UTM_north@zone@letter@lat@lon@pano_id@tile@heading@...@.jpg` as the
  field's evaluation folders and the training photos of SF-XL are. A place is a square cell of the map (10 m by default)
  and a sector of the heading (30 degrees by default, as in CosPlace, Berton et al. 2022), where the name gives a
  heading; the UTM zone is the city. Two photos a metre apart on either side of a border are two places: the price of a
  grid. Pittsburgh's names have no heading but a yaw in their note field: `pitch1_yaw3`, one of twelve directions.

JPEG is copied, PNG is converted to JPEG; other picture formats are left out by name. Invariant: every picture file
below the root is in the catalogue, as a photo or as left out with its reason.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline.common.errors import DataError
from pipeline.common.text import shown
from shards.catalogue import SCHEMA, Catalogue, LeftOut, build
from shards.sources.listing import files_below

READ = (".jpg", ".jpeg", ".jpe", ".jfif", ".png")
UNREAD = (".heic", ".heif", ".webp", ".tif", ".tiff", ".bmp", ".gif", ".avif", ".jxl", ".dng")
_YAWS = 12  # directions of Pittsburgh's views around a spot


def read_folders(root: Path) -> Catalogue:
    """The catalogue of one sub-folder a place.

    Raises:
        DataError: there is no photo.
    """
    rows: list[dict[str, Any]] = []
    left_out: list[LeftOut] = []
    for path, size in _pictures(root, left_out):
        *above, place = path.split("/")[:-1] or [""]
        if path.lower().endswith(UNREAD):
            left_out.append(LeftOut(path, "/".join(above) or ".", place, "only JPEG and PNG are read"))
        elif not place:
            left_out.append(LeftOut(path, "", "", "lies in no place's folder"))
        else:
            rows.append({"city": "/".join(above) or ".", "place_id": place, "path": path, "size": size})
    return build("folders", root, pa.Table.from_pylist(rows, SCHEMA), left_out)


def read_utm(root: Path, cell_m: float = 10.0, heading_deg: float = 30.0) -> Catalogue:
    """The catalogue of photos with @utm names, grouped into places by position and heading.

    Args:
        root: the folder, searched to its depths.
        cell_m: side of a place's cell in metres.
        heading_deg: width of a place's heading sector in degrees; 0 puts all headings together.

    Raises:
        DataError: there is no photo; the names hold degrees where metres are expected.
    """
    left_out: list[LeftOut] = []
    named: list[tuple[str, int, list[str], float, float]] = []
    for path, size in _pictures(root, left_out):
        fields = path.rsplit("/", 1)[-1].split("@")
        east, north = (_number(fields, i) for i in (1, 2))
        if path.lower().endswith(UNREAD):
            left_out.append(LeftOut(path, "", "", "only JPEG and PNG are read"))
        elif east is None or north is None:
            left_out.append(LeftOut(path, "", "", "no position (@UTM_east@UTM_north@) in its name"))
        else:
            named.append((path, size, fields, east, north))
    _refuse_degrees(root, [(path, east, north) for path, _, _, east, north in named])
    yaw_step = _yaw_step([fields for _, _, fields, _, _ in named])
    rows: list[dict[str, Any]] = []
    from_field = from_yaw = 0
    for path, size, fields, east, north in named:
        zone = "".join(f for f in fields[3:5] if re.fullmatch(r"\w{1,2}", f)) or "."
        heading, yaw = _number(fields, 9), _yaw(fields)
        from_field += heading is not None
        if heading is None and yaw is not None:
            heading = yaw * yaw_step - (yaw_step if yaw_step > 1 else 0)
            from_yaw += 1
        heading = heading % 360 % 360 if heading is not None else None  # twice: -1e-20 % 360 is 360
        rows.append(
            {"city": zone, "place_id": cell_name(east, north, cell_m) + sector_name(heading, heading_deg),
             "path": path, "size": size, "bearing": heading, **_told(fields)}
        )  # fmt: skip
    without = len(rows) - from_field
    remarks = []
    if without and heading_deg > 0:
        remarks.append(
            f"{without:,} of {len(rows):,} photos have no heading in their name: {from_yaw:,} are put by the yaw in "
            f"their note field, {without - from_yaw:,} into one place for all directions of their cell"
        )
    table = _located(pa.Table.from_pylist(rows, SCHEMA), rows)
    return build("utm", root, table, left_out, remarks=remarks)


def has_utm_names(root: Path) -> bool:
    """Whether any picture below has a position in its name; stops at the first."""
    return any(_number(path.rsplit("/", 1)[-1].split("@"), 2) is not None for path, _ in _pictures(root, []))


def pictures(root: Path) -> Iterator[str]:
    """Paths from the root of the picture files below."""
    return (path for path, _ in _pictures(root, []))


def cell_name(east: float, north: float, cell_m: float) -> str:
    """The square cell of the map that a point in metres lies in."""
    return f"{math.floor(east / cell_m)}_{math.floor(north / cell_m)}"


def sector_name(heading: float | None, heading_deg: float) -> str:
    """The sector of a heading (0 <= heading < 360) behind a cell's name; "" where headings are not told apart."""
    return f"_{math.floor(heading / heading_deg)}" if heading is not None and heading_deg > 0 else ""


def _pictures(root: Path, left_out: list[LeftOut]) -> Iterator[tuple[str, int]]:
    """(path from the root, bytes or what stands for them) of every picture file; adds folders that cannot be read."""

    def refused(folder: str, why: str) -> None:
        folder = shown(folder, 4096)
        *above, place = folder.split("/")
        left_out.append(LeftOut(folder + "/", "/".join(above) or ".", place, f"cannot be read: {why}"))

    for path, size in files_below(root, READ + UNREAD, refused):
        if any("\ud800" <= c <= "\udfff" for c in path):  # how Python writes bytes that are no UTF-8
            left_out.append(LeftOut(shown(path, 4096), "", "", "its name is not UTF-8"))
        else:
            yield path, size


def _refuse_degrees(root: Path, named: Sequence[tuple[str, float, float]]) -> None:
    """Metres of UTM are never all within the range of degrees: east is above 100,000."""
    if named and all(abs(east) <= 180 and abs(north) <= 180 for _, east, north in named):
        path, east, north = named[0]
        raise DataError(
            f"{shown(root)}: names hold degrees where UTM metres are expected, such as @{east:g}@{north:g}@ in "
            f"{shown(path)}; rename the photos to @UTM_east@UTM_north@..., or give --kind folders"
        )


def _yaw(fields: list[str]) -> int | None:
    """The number behind `yaw` in the note field, which is the last before the ending."""
    found = re.search(r"yaw(\d{1,3})(?!\d)", fields[14]) if len(fields) > 14 else None
    return int(found[1]) if found else None


def _yaw_step(names: Sequence[list[str]]) -> int:
    """Degrees a yaw number stands for: 30 where they count Pittsburgh's twelve directions from 1, else 1."""
    yaws = {yaw for fields in names if (yaw := _yaw(fields)) is not None}
    return 360 // _YAWS if yaws and min(yaws) >= 1 and max(yaws) <= _YAWS else 1


def _number(fields: list[str], i: int) -> float | None:
    try:
        value = float(fields[i])
    except (IndexError, ValueError):
        return None
    return value if math.isfinite(value) and abs(value) < 1e9 else None


def _told(fields: list[str]) -> dict[str, Any]:
    """Latitude, longitude, year and month where the name gives them."""
    date = re.match(r"([12]\d{3})-?(0[1-9]|1[0-2])", fields[13]) if len(fields) > 13 else None
    lat, lon = _number(fields, 5), _number(fields, 6)
    known = lat is not None and lon is not None and abs(lat) <= 90 and abs(lon) <= 180
    return {
        "lat": lat if known else None,
        "lon": lon if known else None,
        "year": int(date[1]) if date else None,
        "month": int(date[2]) if date else None,
        "utm": None if known else _utm(fields),
    }


def _utm(fields: list[str]) -> tuple[int, bool, float, float] | None:
    """Zone, whether south of the equator, east and north in metres, where the name gives all of them."""
    east, north = _number(fields, 1), _number(fields, 2)
    if east is None or north is None or len(fields) < 5 or not re.fullmatch(r"[C-HJ-NP-X]", fields[4].upper()):
        return None
    if not re.fullmatch(r"\d{1,2}", fields[3]) or not 1 <= int(fields[3]) <= 60:
        return None
    return int(fields[3]), fields[4].upper() < "N", east, north


def _located(table: pa.Table, rows: Sequence[dict[str, Any]]) -> pa.Table:
    """Fills in latitude and longitude where a name has UTM metres and a zone only."""
    by_zone: dict[tuple[int, bool], list[int]] = {}
    for i, row in enumerate(rows):
        if row["utm"] is not None:
            by_zone.setdefault(row["utm"][:2], []).append(i)
    if not by_zone:
        return table
    lat, lon = (np.array(table[name].to_pylist(), np.float64) for name in ("lat", "lon"))
    for (zone, south), which in by_zone.items():
        metres = np.array([rows[i]["utm"][2:] for i in which])
        lat[which], lon[which] = utm_degrees(metres, zone, south).T
    for name, values in (("lat", lat), ("lon", lon)):
        column = pa.array(np.where(np.isfinite(lat) & np.isfinite(lon), values, np.nan), from_pandas=True)
        table = table.set_column(table.schema.get_field_index(name), name, column)
    return table


def utm_degrees(metres: np.ndarray, zone: int, south: bool) -> np.ndarray:
    """Latitude and longitude in degrees on WGS84, float64 [n, 2], of UTM east and north in metres [n, 2]."""
    from pyproj import Transformer

    transformer = Transformer.from_crs(32700 + zone if south else 32600 + zone, 4326, always_xy=True)
    lon, lat = transformer.transform(metres[:, 0], metres[:, 1])
    return np.stack([lat, lon], axis=1)
