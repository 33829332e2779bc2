"""Reads a folder of a user's own places, in one of two layouts.

- `folders`: each folder that directly holds photos is a place; what lies above it names the city. So
  `cafe/1.jpg` is place "cafe" of city ".", and `Lisbon/cafe/1.jpg` is place "cafe" of city "Lisbon".
- `utm`: photos anywhere below, named `@UTM_east@UTM_north@zone@letter@lat@lon@pano_id@tile@heading@...@.jpg` as the
  field's evaluation folders are. A place is a square cell of the map (10 m by default) and a sector of the heading
  (30 degrees by default, as in CosPlace, Berton et al. 2022), where the name gives a heading; the UTM zone is the city.
  Two photos a metre apart on either side of a border are two places: the price of a grid.

JPEG is copied, PNG is converted to JPEG; other picture formats are left out by name. Invariant: every picture file
below the root is in the catalogue, as a photo or as left out with its reason.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa

from shards.catalogue import SCHEMA, Catalogue, LeftOut, build

READ = (".jpg", ".jpeg", ".png")
UNREAD = (".heic", ".heif", ".webp", ".tif", ".tiff", ".bmp", ".gif", ".avif")


def read_folders(root: Path) -> Catalogue:
    """The catalogue of one sub-folder a place.

    Raises:
        DataError: there is no photo.
    """
    rows: list[dict[str, Any]] = []
    left_out: list[LeftOut] = []
    for path, size in _pictures(root):
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
        DataError: there is no photo.
    """
    rows: list[dict[str, Any]] = []
    left_out: list[LeftOut] = []
    for path, size in _pictures(root):
        fields = path.rsplit("/", 1)[-1].split("@")
        east, north = (_number(fields, i) for i in (1, 2))
        if path.lower().endswith(UNREAD):
            left_out.append(LeftOut(path, "", "", "only JPEG and PNG are read"))
        elif east is None or north is None:
            left_out.append(LeftOut(path, "", "", "no position (@UTM_east@UTM_north@) in its name"))
        else:
            zone = "".join(f for f in fields[3:5] if re.fullmatch(r"\w{1,2}", f)) or "."
            heading = _number(fields, 9)
            cell = f"{math.floor(east / cell_m)}_{math.floor(north / cell_m)}"
            sector = f"_{math.floor(heading % 360 / heading_deg)}" if heading is not None and heading_deg > 0 else ""
            rows.append(
                {"city": zone, "place_id": cell + sector, "path": path, "size": size, **_told(fields), "bearing":
                 heading % 360 if heading is not None else None}
            )  # fmt: skip
    return build("utm", root, pa.Table.from_pylist(rows, SCHEMA), left_out)


def has_utm_names(root: Path) -> bool:
    """Whether any picture below has a position in its name; stops at the first."""
    return any(_number(path.rsplit("/", 1)[-1].split("@"), 2) is not None for path, _ in _pictures(root))


def _pictures(root: Path) -> Iterator[tuple[str, int]]:
    """(path from the root, bytes or -1) of every picture file but hidden ones; linked folders are entered once."""
    visited: set[tuple[int, int]] = set()
    for folder, below, names in os.walk(root, followlinks=True):
        at = os.stat(folder)  # noqa: PTH116
        if (at.st_dev, at.st_ino) in visited:  # a link back up, or a second way to the same photos
            below.clear()
            continue
        visited.add((at.st_dev, at.st_ino))
        below[:] = sorted(name for name in below if not name.startswith((".", "__MACOSX")))
        inside = Path(folder).relative_to(root).as_posix()
        for name in sorted(names):
            if name.lower().endswith(READ + UNREAD) and not name.startswith("."):
                try:
                    size = os.stat(os.path.join(folder, name)).st_size  # noqa: PTH116, PTH118
                except OSError:
                    size = -1  # a link to nowhere
                yield (name if inside == "." else f"{inside}/{name}"), size


def _number(fields: list[str], i: int) -> float | None:
    try:
        value = float(fields[i])
    except (IndexError, ValueError):
        return None
    return value if math.isfinite(value) else None


def _told(fields: list[str]) -> dict[str, Any]:
    """Latitude, longitude, year and month where the name gives them."""
    date = re.match(r"(\d{4})-?(\d{2})", fields[13]) if len(fields) > 13 else None
    return {
        "lat": _number(fields, 5),
        "lon": _number(fields, 6),
        "year": int(date[1]) if date else None,
        "month": int(date[2]) if date else None,
    }
