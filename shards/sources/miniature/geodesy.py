"""Metres of a UTM zone to latitude and longitude on WGS 84, so that a drawn photo's two positions agree.

Invariant: northern hemisphere only; the error of the series is under a millimetre inside a zone.
"""

from __future__ import annotations

import math

SEMI_MAJOR, FLATTENING, SCALE = 6378137.0, 1 / 298.257223563, 0.9996
BANDS = "CDEFGHJKLMNPQRSTUVWX"


def to_degrees(east: float, north: float, zone: int) -> tuple[float, float]:
    """Inverse of the transverse Mercator projection by Krüger's series (Karney 2011, eqs. 5-11 and 36, to n^3).

    Args:
        east, north: UTM coordinates in metres, northern hemisphere.
        zone: UTM zone, 1 to 60.

    Returns:
        latitude and longitude in degrees.
    """
    n = FLATTENING / (2 - FLATTENING)
    radius = SEMI_MAJOR / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    xi, eta = north / (SCALE * radius), (east - 500000.0) / (SCALE * radius)
    beta = (n / 2 - 2 * n**2 / 3 + 37 * n**3 / 96, n**2 / 48 + n**3 / 15, 17 * n**3 / 480)
    xi_p = xi - sum(b * math.sin(2 * j * xi) * math.cosh(2 * j * eta) for j, b in enumerate(beta, 1))
    eta_p = eta - sum(b * math.cos(2 * j * xi) * math.sinh(2 * j * eta) for j, b in enumerate(beta, 1))
    chi = math.asin(math.sin(xi_p) / math.cosh(eta_p))
    delta = (2 * n - 2 * n**2 / 3 - 2 * n**3, 7 * n**2 / 3 - 8 * n**3 / 5, 56 * n**3 / 15)
    latitude = chi + sum(d * math.sin(2 * j * chi) for j, d in enumerate(delta, 1))
    longitude = math.radians(6 * zone - 183) + math.atan2(math.sinh(eta_p), math.cos(xi_p))
    return math.degrees(latitude), math.degrees(longitude)


def band(latitude: float) -> str:
    """The letter of the 8-degree latitude band (X reaches 84 degrees)."""
    return BANDS[min(int((latitude + 80) // 8), 19)]
