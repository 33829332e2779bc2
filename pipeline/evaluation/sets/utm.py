"""Positions: the field's `@UTM_east@UTM_north@...@.jpg` file names, and latitude and longitude to UTM metres.

Invariant: file names are split at `@` and fields 1 and 2 are metres, whatever follows (common evaluators read no
more); fields that hold degrees are refused, since every photo of a city lies within 25 "metres" of every other then.
Conversions are PROJ's (`pyproj`), on WGS84.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from pipeline.common.errors import DataError
from pipeline.common.text import shown

WIDEST = 20.0  # degrees of longitude from the middle of a zone
CITY = 2.0  # degrees: the photos of a city lie within so many; no set in metres is so small


def file_position(path: Path) -> tuple[float, float] | None:
    """UTM east and north of an `@` file name; None where the name has no `@`.

    Raises `DataError` for a name with `@` whose fields 1 and 2 are not finite numbers.
    """
    fields = path.name.split("@")
    if len(fields) < 3:
        return None
    try:
        east, north = float(fields[1]), float(fields[2])
    except ValueError:
        east = north = float("nan")
    if not (np.isfinite(east) and np.isfinite(north)):
        raise DataError(
            f"{shown(path)}: '@{shown(fields[1])}@{shown(fields[2])}' is no UTM position; "
            "names go @UTM_east@UTM_north@...@.jpg, in metres"
        )
    return east, north


def file_positions(paths: Iterable[Path]) -> np.ndarray | None:
    """Positions [n, 2] of all files; None when no name has `@`. Raises `DataError` when only some have it."""
    paths = list(paths)
    found = [file_position(path) for path in paths]
    known = [position for position in found if position is not None]
    if not known:
        return None
    if len(known) < len(found):
        raise DataError(
            f"{shown(paths[found.index(None)])}: this name carries no @UTM_east@UTM_north@ while others of the folder "
            "do; rename it, or take it away"
        )
    positions = np.array(known, np.float64).reshape(-1, 2)
    degrees = degrees_for_metres(positions, written=True)
    if degrees == "yes" or (degrees == "maybe" and file_zone(paths[0])):
        fields = paths[0].name.split("@")
        raise DataError(
            f"{shown(paths[0])}: '@{shown(fields[1])}@{shown(fields[2])}' looks like degrees; fields 1 and 2 of these "
            "names are UTM east and north in metres. Write a manifest with the columns image, role, lat, lon instead"
        )
    return positions


def position_remarks(paths: Iterable[Path], positions: np.ndarray) -> tuple[str, ...]:
    """What a reader of a recall should know about positions [n, 2] in file names: doubtful units, several zones."""
    found: list[str] = []
    if degrees_for_metres(positions, written=True) == "maybe":
        found.append("positions in the names are small enough to be degrees; they are taken as metres")
    zones = sorted({zone for zone in map(file_zone, paths) if zone})
    if len(zones) > 1:
        found.append(f"names are of the UTM zones {', '.join(zones)}; distances across zones mean nothing")
    return tuple(found)


def file_zone(path: Path) -> str:
    """The zone of an `@` file name as its number and hemisphere, "31N" or "31S"; "" where fields 3 and 4 do not tell.

    Field 4 is a latitude band: C to M lie south of the equator, N to X north of it.
    """
    fields = path.name.split("@")
    if len(fields) < 5 or not fields[3].isdigit() or not 1 <= int(fields[3]) <= 60:
        return ""
    band = fields[4].upper()
    if len(band) != 1 or band not in "CDEFGHJKLMNPQRSTUVWX":
        return ""
    return f"{int(fields[3])}{'S' if band < 'N' else 'N'}"


def utm_zone(latitude: float, longitude: float) -> int:
    """The UTM zone 1 ... 60 of a point in degrees, with the exceptions for Norway and Svalbard."""
    longitude = (longitude + 180.0) % 360.0 - 180.0
    if 56.0 <= latitude < 64.0 and 3.0 <= longitude < 12.0:
        return 32
    if 72.0 <= latitude <= 84.0 and 0.0 <= longitude < 42.0:
        return 31 + 2 * int((longitude + 3.0) // 12.0)
    return int((longitude + 180.0) // 6.0) + 1


def meridian_offset(longitude: np.ndarray, zone: int) -> np.ndarray:
    """Degrees east of the central meridian of a UTM zone, -180 ... 180, float64 [n]."""
    offset: np.ndarray = (np.asarray(longitude, np.float64) - (6 * zone - 183) + 180.0) % 360.0 - 180.0
    return offset


def to_utm(
    latitude: np.ndarray, longitude: np.ndarray, zone: int | None = None, south: bool | None = None
) -> np.ndarray:
    """UTM east and north in metres, float64 [n, 2], of WGS84 degrees [n] and [n].

    All points go into one zone, `zone` or else that of the middle point, so that distances across a zone border stay
    distances. All points get the usual 10,000 km added when `south`, or else when the middle point is southern; so a
    set across the equator also stays in one piece. Raises `DataError` for values that are no coordinates, and when
    points lie more than 20 degrees from the zone's central meridian.
    """
    latitude, longitude = np.asarray(latitude, np.float64).ravel(), np.asarray(longitude, np.float64).ravel()
    good = (np.abs(latitude) <= 90) & (np.abs(longitude) <= 360)
    if not good.all():
        at = int(np.argmin(good))
        raise DataError(
            f"row {at + 1}: latitude {latitude[at]}, longitude {longitude[at]} is no place on Earth, in degrees"
        )
    if len(latitude) == 0:
        return np.zeros((0, 2))
    if zone is None:
        zone = utm_zone(float(np.median(latitude)), float(np.median(longitude)))
    offset = meridian_offset(longitude, zone)
    if np.abs(offset).max() > WIDEST:
        at = int(np.argmax(np.abs(offset)))
        raise DataError(
            f"row {at + 1}: longitude {longitude[at]} is {abs(offset[at]):.0f} degrees from the middle of UTM zone "
            f"{zone}; make one set a region, or give utm_east and utm_north"
        )
    from pyproj import Proj

    south = bool(np.median(latitude) < 0) if south is None else south
    # the longitude counted from the zone's meridian, so that 359 and -1 are the same place
    east, north = Proj(proj="utm", zone=zone, south=south, ellps="WGS84")(6 * zone - 183 + offset, latitude)
    return np.stack([east, north], axis=1)


def from_utm(positions: np.ndarray, zone: int, south: bool) -> np.ndarray:
    """Latitude and longitude, float64 [n, 2], of UTM east and north in metres [n, 2] (WGS84); NaN outside the Earth."""
    from pyproj import Proj

    longitude, latitude = Proj(proj="utm", zone=zone, south=south, ellps="WGS84")(
        positions[:, 0], positions[:, 1], inverse=True
    )
    degrees = np.stack([latitude, longitude], axis=1)
    degrees[~np.isfinite(degrees).all(axis=1)] = np.nan
    return degrees


def metres_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Distance in metres [n] along the WGS84 ellipsoid between (latitude, longitude) [n, 2] and [n, 2] (or [2])."""
    from pyproj import Geod

    a, b = np.broadcast_arrays(np.asarray(first, np.float64), np.asarray(second, np.float64))
    distance: np.ndarray = np.asarray(Geod(ellps="WGS84").inv(a[..., 1], a[..., 0], b[..., 1], b[..., 0])[2])
    return distance


def degrees_for_metres(positions: np.ndarray, written: bool = False) -> str:
    """Whether positions [n, 2] that should be metres look like longitude and latitude: "yes", "maybe" or "no".

    "yes": all lie in the range of degrees, not all are whole numbers, and they span less than two degrees, or, where
    they were `written` in file names (UTM metres are written with two decimals), most have more than two decimals.
    "maybe": in that range, but as far apart as a small local frame in metres could be.
    """
    values = np.abs(np.asarray(positions, np.float64).reshape(-1, 2))
    values = values[~np.isnan(values).any(axis=1)]
    if len(values) == 0 or (values == np.round(values)).all():
        return "no"  # numbers of frames, which some downloads write there, are whole
    if not (values.max(axis=0) <= [180, 90]).all() and not (values.max(axis=0) <= [90, 180]).all():
        return "no"
    if np.ptp(positions, axis=0).max() < CITY:
        return "yes"
    fine = np.abs(values - np.round(values, 2)).max(axis=1) > 1e-9
    return "yes" if written and fine.mean() > 0.5 else "maybe"
