"""Positions: file names, and UTM against published points, quadrature and an independent series."""

from __future__ import annotations

import csv
import gzip
import math
from pathlib import Path

import numpy as np
import pytest

from pipeline.common.errors import DataError
from pipeline.evaluation.sets.utm import (
    degrees_for_metres,
    file_position,
    file_positions,
    metres_between,
    position_remarks,
    to_utm,
    utm_zone,
)  # fmt: skip


def test_names_are_read_as_common_evaluators_read_them() -> None:
    full = "@0583405.12@4477100.50@17@T@040.44@-080.01@pano_id@00@090@@@@201407@@.jpg"
    assert file_position(Path("a/b") / full) == (583405.12, 4477100.5)
    assert file_position(Path("@0@00024.0@@@@@10@@@@@@@@.jpg")) == (0.0, 24.0)
    assert file_position(Path("@0619586.56@5734983.03@20141216_191044@.jpg")) == (619586.56, 5734983.03)
    assert file_position(Path("IMG_1234.jpg")) is None
    with pytest.raises(DataError, match="no UTM position"):
        file_position(Path("@east@4477100.50@.jpg"))
    with pytest.raises(DataError, match="no UTM position"):
        file_position(Path("@nan@4477100.50@.jpg"))
    with pytest.raises(DataError, match=r"plain\.jpg: this name carries no"):
        file_positions([Path("@1@2@.jpg"), Path("plain.jpg")])


@pytest.mark.parametrize(
    ("latitude", "longitude", "zone", "east", "north"),
    [  # CN Tower, Toronto (published for its position in textbooks on UTM), and two southern and eastern points
        (43 + 38 / 60 + 33.24 / 3600, -(79 + 23 / 60 + 13.7 / 3600), 17, 630_084, 4_833_438),
        (0.0, 3.0, 31, 500_000, 0),
        (0.0, 9.0, 32, 500_000, 0),
    ],
)
def test_published_points(latitude: float, longitude: float, zone: int, east: float, north: float) -> None:
    assert utm_zone(latitude, longitude) == zone
    assert to_utm(np.array([latitude]), np.array([longitude]))[0] == pytest.approx([east, north], abs=1.0)


def meridian_arc(latitude: float, steps: int = 20_000) -> float:
    """Distance along a meridian from the equator, by Simpson's rule on the ellipse itself."""
    a, f = 6378137.0, 1 / 298.257223563
    e2 = f * (2 - f)
    phi = np.linspace(0, math.radians(latitude), steps + 1)
    curvature = a * (1 - e2) / (1 - e2 * np.sin(phi) ** 2) ** 1.5
    weights = np.ones(steps + 1)
    weights[1:-1:2], weights[2:-1:2] = 4, 2
    return float((weights * curvature).sum() * (phi[1] - phi[0]) / 3)


@pytest.mark.parametrize("latitude", [10.0, 40.44, 59.9, 80.0])
def test_northing_on_the_central_meridian_is_the_arc_of_the_ellipse(latitude: float) -> None:
    east, north = to_utm(np.array([latitude]), np.array([9.0]), zone=32)[0]
    assert east == pytest.approx(500_000, abs=1e-9)
    assert north == pytest.approx(0.9996 * meridian_arc(latitude), abs=1e-5)


def snyder(latitude: float, longitude: float, zone: int) -> tuple[float, float]:
    """USGS Professional Paper 1395, Eqs. 8-9 to 8-15 and 3-21: another expansion, good to a few millimetres."""
    a, f, k0 = 6378137.0, 1 / 298.257223563, 0.9996
    e2 = f * (2 - f)
    ep2 = e2 / (1 - e2)
    phi, lam = math.radians(latitude), math.radians(longitude - (6 * zone - 183))
    n = a / math.sqrt(1 - e2 * math.sin(phi) ** 2)
    t, c, big_a = math.tan(phi) ** 2, ep2 * math.cos(phi) ** 2, lam * math.cos(phi)
    m = meridian_arc(latitude)
    east = k0 * n * (big_a + (1 - t + c) * big_a**3 / 6 + (5 - 18 * t + t**2 + 72 * c - 58 * ep2) * big_a**5 / 120)
    north = k0 * (m + n * math.tan(phi) * (big_a**2 / 2 + (5 - t + 9 * c + 4 * c**2) * big_a**4 / 24
                  + (61 - 58 * t + t**2 + 600 * c - 330 * ep2) * big_a**6 / 720))  # fmt: skip
    return 500_000 + east, north


@pytest.mark.parametrize(
    ("latitude", "longitude"), [(35.65, 139.69), (51.75, -1.25), (55.67, 12.56), (37.77, -122.41), (68.0, 15.2)]
)
def test_agrees_with_an_independent_series(latitude: float, longitude: float) -> None:
    zone = utm_zone(latitude, longitude)
    got = to_utm(np.array([latitude]), np.array([longitude]))[0]
    assert got == pytest.approx(snyder(latitude, longitude, zone), abs=0.02)


def test_one_zone_keeps_distances_across_its_border() -> None:
    """Two points 100 m apart on either side of 12 degrees east stay 100 m apart (scale error under 0.1 %)."""
    phi, e2 = math.radians(55), (2 - 1 / 298.257223563) / 298.257223563
    half = math.degrees(50 * math.sqrt(1 - e2 * math.sin(phi) ** 2) / (6378137.0 * math.cos(phi)))
    east = to_utm(np.array([55.0, 55.0]), np.array([12 - half, 12 + half]))
    assert np.linalg.norm(east[0] - east[1]) == pytest.approx(100, rel=1e-3)


def test_southern_points_and_exceptions() -> None:
    (east, north), (_, mirrored) = to_utm(np.array([-33.86]), np.array([151.21]))[0], to_utm(
        np.array([33.86]), np.array([151.21]))[0]  # fmt: skip
    assert (utm_zone(-33.86, 151.21), 333_000 < east < 336_000) == (56, True)
    assert north == pytest.approx(10_000_000 - mirrored, abs=1e-6)
    assert (utm_zone(60.0, 5.0), utm_zone(78.0, 10.0), utm_zone(10.0, 180.0), utm_zone(10.0, -180.0)) == (32, 33, 1, 1)
    with pytest.raises(DataError, match="no place on Earth"):
        to_utm(np.array([95.0]), np.array([0.0]))
    with pytest.raises(DataError, match="degrees from the middle of UTM zone"):
        to_utm(np.array([10.0, 10.0, 10.0]), np.array([0.0, 0.0, 90.0]))


def test_real_metadata_agrees(shared_dir: Path) -> None:
    """GSV-Cities' frames carry both; latitude and longitude are cut to 5 decimals, which is up to 1.1 m each."""
    for city, zone in (("Bangkok", 47), ("Chicago", 16), ("BuenosAires", 21), ("OSL", 32)):
        with gzip.open(shared_dir / "data" / "gsv_cities_metadata" / f"{city}.csv.gz", "rt") as file:
            rows = [row for at, row in enumerate(csv.DictReader(file)) if at % 50 == 0]
        lat, lon = (np.array([float(row[c]) for row in rows]) for c in ("lat", "lon"))
        theirs = np.array([[float(row["utm_east"]), float(row["utm_north"])] for row in rows])
        assert utm_zone(float(np.median(lat)), float(np.median(lon))) == zone
        assert np.abs(to_utm(lat, lon) - theirs).max() < 1.2, city


def names(values: list[tuple[object, object]], zone: str = "") -> list[Path]:
    return [Path(f"@{a}@{b}@{zone}@@@@@.jpg") for a, b in values]


CITIES = {
    "longitude first": [(2.3522, 48.8566), (2.3601, 48.8500)],
    "latitude first": [(48.8566, 2.3522), (48.8500, 2.3601)],
    "west and south": [(-122.4194, -37.7749), (-122.4000, -37.7800)],
    "two decimals, padded": [("0000002.35", "0000048.86"), ("0000002.36", "0000048.85")],
    "a region, five decimals": [(2.35222, 48.85661), (13.40495, 52.52001)],
}


@pytest.mark.parametrize("kind", CITIES)
def test_degrees_in_the_fields_of_metres_are_refused(kind: str) -> None:
    with pytest.raises(DataError, match=r"looks like degrees; fields 1 and 2 .* are UTM east and north in metres"):
        file_positions(names(CITIES[kind]))


def test_metres_are_no_degrees() -> None:
    for values in (
        [(0, 0), (0, 24), (0, 48)],  # frames, as downloads of Nordland write them
        [("0583405.12", "4477100.50"), ("0583400.00", "4477100.00")],
        [(0.5, 10.25), (300.0, 20.0)],  # a local frame
        [(-0.5, 91.0), (0.25, 220.5)],
    ):
        assert file_positions(names(values)) is not None and not position_remarks([], file_positions(names(values)))
    small = [(12.5, 3.25), (40.25, 70.0)]  # a local frame that could be degrees far apart: taken, and told
    positions = file_positions(names(small))
    assert positions is not None and "small enough to be degrees" in position_remarks([], positions)[0]
    with pytest.raises(DataError, match="looks like degrees"):  # a zone in the name: UTM, and no UTM is so small
        file_positions(names(small, "31@N"))
    assert degrees_for_metres(np.full((2, 2), np.nan)) == "no"


def test_zones_that_differ_are_told() -> None:
    files = [Path("@583405.12@4477100.50@17@T@.jpg"), Path("@183405.12@4477100.50@18@T@.jpg")]
    assert position_remarks(files, np.array([[583405.12, 4477100.5], [183405.12, 4477100.5]])) == (
        "names are of the UTM zones 17N, 18N; distances across zones mean nothing",
    )


def test_longitudes_beyond_180_and_poles() -> None:
    assert to_utm(np.array([52.0]), np.array([359.0]), 31)[0] == pytest.approx(to_utm([52.0], [-1.0], 31)[0])  # type: ignore[arg-type]
    assert np.isfinite(to_utm(np.array([90.0, -90.0]), np.array([9.0, 9.0]), 32)).all()


def test_distances_follow_the_ellipsoid() -> None:
    quarter = metres_between(np.array([[0.0, 0.0]]), np.array([0.0, 90.0]))
    assert quarter == pytest.approx(math.pi / 2 * 6378137.0, abs=1e-3)
    flinders, buninyong = np.array([-37.951033417, 144.424867889]), np.array([-37.652821139, 143.926495528])
    assert metres_between(flinders, buninyong) == pytest.approx(54_972.271, abs=1.5)
