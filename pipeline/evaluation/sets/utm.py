"""Positions: the field's `@UTM_east@UTM_north@...@.jpg` file names, and latitude and longitude to UTM metres.

Invariant: file names are split at `@` and fields 1 and 2 are metres, whatever follows (common evaluators read no
more); `to_utm` is Krueger's series to the sixth order on WGS84, better than a millimetre within 20 degrees of the
central meridian (Karney, Transverse Mercator with an accuracy of a few nanometers, 2011, Eqs. 7-11 and 35).
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from pipeline.common.errors import DataError

AXIS = 6378137.0
FLATTENING = 1 / 298.257223563
SCALE = 0.9996
WIDEST = 20.0  # degrees of longitude from the middle of a zone
_N = FLATTENING / (2 - FLATTENING)
# coefficients of n, n^2, ... n^6 for the harmonics 1 ... 6 (Karney 2011, Eq. 35)
_ALPHA = (
    (1 / 2, -2 / 3, 5 / 16, 41 / 180, -127 / 288, 7891 / 37800),
    (0, 13 / 48, -3 / 5, 557 / 1440, 281 / 630, -1983433 / 1935360),
    (0, 0, 61 / 240, -103 / 140, 15061 / 26880, 167603 / 181440),
    (0, 0, 0, 49561 / 161280, -179 / 168, 6601661 / 7257600),
    (0, 0, 0, 0, 34729 / 80640, -3418889 / 1995840),
    (0, 0, 0, 0, 0, 212378941 / 319334400),
)


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
            f"{path}: '@{fields[1]}@{fields[2]}' is no UTM position; names go @UTM_east@UTM_north@...@.jpg, in metres"
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
            f"{paths[found.index(None)]}: this name carries no @UTM_east@UTM_north@ while others of the folder do; "
            "rename it, or take it away"
        )
    return np.array(known, np.float64).reshape(-1, 2)


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
    phi, lam = np.radians(latitude), np.radians(offset)
    e = np.sqrt(FLATTENING * (2 - FLATTENING))
    tau = np.tan(phi)
    sigma = np.sinh(e * np.arctanh(e * np.sin(phi)))
    conformal = tau * np.hypot(1, sigma) - sigma * np.hypot(1, tau)
    xi = np.arctan2(conformal, np.cos(lam))
    eta = np.arcsinh(np.sin(lam) / np.hypot(conformal, np.cos(lam)))
    powers = _N ** np.arange(1, 7)
    east, north = eta.copy(), xi.copy()
    for harmonic, coefficients in enumerate(_ALPHA, start=1):
        alpha = float(np.dot(coefficients, powers))
        north += alpha * np.sin(2 * harmonic * xi) * np.cosh(2 * harmonic * eta)
        east += alpha * np.cos(2 * harmonic * xi) * np.sinh(2 * harmonic * eta)
    radius = AXIS / (1 + _N) * (1 + _N**2 / 4 + _N**4 / 64 + _N**6 / 256)
    south = bool(np.median(latitude) < 0) if south is None else south
    false_north = 10_000_000.0 if south else 0.0
    return np.stack([500_000.0 + SCALE * radius * east, false_north + SCALE * radius * north], axis=1)


def metres_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Great-circle distance in metres [n] between WGS84 (latitude, longitude) [n, 2] and [n, 2] (or [2]).

    On the sphere of the mean radius (haversine): within 0.6 % of the ellipsoid's distance, anywhere on Earth.
    """
    a, b = np.radians(np.asarray(first, np.float64)), np.radians(np.asarray(second, np.float64))
    half = np.sin((b - a) / 2) ** 2
    chord = half[..., 0] + np.cos(a[..., 0]) * np.cos(b[..., 0]) * half[..., 1]
    distance: np.ndarray = 2 * 6371008.8 * np.arcsin(np.sqrt(np.clip(chord, 0, 1)))
    return distance
