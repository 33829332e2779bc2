"""Positions from real EXIF in real JPEG files, against surveyed points; broken ones named and never a photo lost."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from located import degrees, point, write
from tiny_checkpoint import save_tiny

from pipeline.common.errors import DataError
from pipeline.config import EvaluationConfig
from pipeline.evaluation.sets.utm import metres_between
from pipeline.locate.answers import Answer, locate
from pipeline.locate.gps import gps_position
from pipeline.locate.photo_index import make_index, open_index
from pipeline.locate.photos import find_photos
from pipeline.model.vpr import PlaceModel
from pipeline.model.weights.files import load_model

CONFIG = EvaluationConfig(workers=0, batch=1)
CN_TOWER = ("N", (43, 38, 33.24), "W", (79, 23, 13.7))  # zone 17, 630084 m east, 4833438 m north (Wikipedia, UTM)
GOOD = {1: "N", 2: (48.0, 30.0, 0.0), 3: "E", 4: (2.0, 15.0, 36.0)}


def metres_of(answer: Answer, row: int) -> float | None:
    return next(found.metres for found in answer.found if found.row == row)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> PlaceModel:
    return load_model(save_tiny(tmp_path_factory.mktemp("run"), 0))


@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_degrees_minutes_and_seconds(tmp_path: Path, suffix: str) -> None:
    found, problem = gps_position(write(tmp_path / f"a.{suffix}", point(*CN_TOWER)))
    assert problem == "" and found == pytest.approx((43.6425667, -79.3871389), abs=1e-7)
    whole = point("S", (33.5, 0.0, 0.0), "e\0", (18.25, 0, 0))
    assert gps_position(write(tmp_path / f"b.{suffix}", whole))[0] == pytest.approx((-33.5, 18.25))
    assert gps_position(write(tmp_path / f"c.{suffix}", None)) == (None, "")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({2: (0.0, 0.0, 0.0), 4: (0.0, 0.0, 0.0)}, "(0, 0)"),
        ({2: (91.0, 0.0, 0.0)}, "91 is out of range"),
        ({4: (180.0, 0.0, 1.0)}, "out of range"),
        ({2: (48.0, 75.0, 0.0)}, "out of range"),
        ({1: "Q"}, "reference 'Q'"),
        ({1: None}, "reference ''"),
        ({4: None}, "Longitude"),
    ],
)
def test_broken_positions_have_a_reason(tmp_path: Path, change: dict[int, Any], reason: str) -> None:
    tags = {key: value for key, value in {**GOOD, **change}.items() if value is not None}
    found, problem = gps_position(write(tmp_path / "a.jpg", tags))
    assert found is None and reason in problem


@pytest.mark.parametrize("fraction", [(0, 0), (5, 0)])
def test_fractions_without_a_denominator(tmp_path: Path, fraction: tuple[int, int]) -> None:
    """Patched into the file's bytes, as cameras write them without a fix."""
    path = write(tmp_path / "a.jpg", GOOD)
    data = path.read_bytes()
    order = {b"II": "<", b"MM": ">"}[data[data.index(b"Exif") + 6 :][:2]]
    assert data.count(struct.pack(order + "II", 48, 1)) == 1
    path.write_bytes(data.replace(struct.pack(order + "II", 48, 1), struct.pack(order + "II", *fraction)))
    found, problem = gps_position(path)
    assert found is None and "Latitude" in problem


def test_damaged_exif_and_no_photo_at_all(tmp_path: Path) -> None:
    path = write(tmp_path / "a.jpg", GOOD)
    data = path.read_bytes()
    for cut in range(data.index(b"Exif") + 6, data.index(b"Exif") + 120):  # whatever byte is lost, an answer comes
        path.write_bytes(data[:cut] + b"\xff" + data[cut + 1 :])
        found, _ = gps_position(path)
        assert found is None or (abs(found[0]) <= 90 and abs(found[1]) <= 180)
    path.write_bytes(b"no photo")
    assert gps_position(path) == (None, "") and gps_position(tmp_path / "nowhere.jpg") == (None, "")


def test_a_folder_goes_into_one_zone_and_photos_without_stay(tmp_path: Path) -> None:
    write(tmp_path / "p" / "a tower.jpg", point(*CN_TOWER))
    write(tmp_path / "p" / "b none.jpg", None)
    write(tmp_path / "p" / "c zero.jpg", degrees(0.0, 0.0))
    write(tmp_path / "p" / "d over the border.jpg", degrees(43.64, -77.9))  # zone 18, six kilometres into it
    write(tmp_path / "p" / "e near.jpg", degrees(43.65, -79.38))
    photos = find_photos([tmp_path / "p"], progress=False)
    assert (photos.coordinates, photos.zone, len(photos.files)) == ("utm", "17N", 5)
    assert photos.positions is not None and photos.degrees is not None
    assert photos.positions[0] == pytest.approx((630084, 4833438), abs=1)
    assert np.isnan(photos.positions[1:3]).all() and np.isnan(photos.degrees[1:3]).all()
    far = np.hypot(*(photos.positions[3] - photos.positions[0]))
    assert far == pytest.approx(metres_between(photos.degrees[3], photos.degrees[0]), rel=0.006)
    assert far == pytest.approx(120_000, rel=0.01)  # 1.487 degrees of 80.67 km each at this latitude
    assert len(photos.remarks) == 2 and "3 of 5 photos have a position" in photos.remarks[1]
    assert "broken GPS, taken for none, in 1: " in photos.remarks[0] and "c zero.jpg: (0, 0)" in photos.remarks[0]


def test_names_come_first_and_the_whole_world_stays_in_degrees(tmp_path: Path) -> None:
    write(tmp_path / "named" / "@500000@4400000@31@U@x@.jpg", degrees(10, 10))
    named = find_photos([tmp_path / "named"], progress=False)
    assert (named.coordinates, named.zone) == ("utm", "31N")
    assert named.degrees is not None and named.degrees[0, 1] == pytest.approx(3.0)
    assert metres_between(named.degrees[0], np.array([0.0, 3.0])) * 0.9996 == pytest.approx(4400000, abs=0.01)
    assert named.positions is not None and named.positions.tolist() == [[500000, 4400000]]
    write(tmp_path / "world" / "a.jpg", degrees(-33.5, 151.25))
    write(tmp_path / "world" / "b.jpg", degrees(51.5, -0.125))
    world = find_photos([tmp_path / "world"], progress=False)
    assert world.coordinates == "degrees" and world.degrees is None and "too far apart" in world.remarks[-1]
    np.testing.assert_allclose(world.positions, [[-33.5, 151.25], [51.5, -0.125]], atol=1e-6)  # type: ignore[arg-type]


def test_answers_tell_how_far_the_photo_says_it_was(model: PlaceModel, tmp_path: Path) -> None:
    for place in range(6):  # a minute of latitude apart, 1852.2 m on the ellipsoid
        tags = degrees(45 + place / 60, 7.5) if place != 4 else None
        write(tmp_path / "p" / f"{place}.jpg", tags, place)
    make_index(model, tmp_path / "p", tmp_path / "index", CONFIG, "cpu", "f", progress=False)
    index = open_index(tmp_path / "index", "f")
    assert index.zone == "32N" and index.degrees is not None
    asked = write(tmp_path / "asked.jpg", degrees(45.0, 7.5), 2)
    (answer,) = locate(model, index, [asked], 6, "cpu", progress=False)
    assert answer.own.degrees == pytest.approx((45, 7.5), abs=1e-6)
    for found in answer.found:
        if found.row == 4:
            assert found.metres is None and found.right is None and found.utm is None
        else:
            assert found.metres == pytest.approx(1852.2 * found.row, rel=1e-3, abs=0.01)
            assert found.right == (found.row == 0)
    first = answer.to_dict()["answers"][0]
    assert (first["lat"], first["lon"]) == pytest.approx((45 + 2 / 60, 7.5)) and first["metres"] > 3000
    (plain,) = locate(model, index, [write(tmp_path / "plain.jpg", None, 2)], 6, "cpu", progress=False)
    rows = [found.row for found in answer.found]
    assert plain.own.degrees is None and [f.metres for f in plain.found] == [None] * 6
    assert [found.row for found in plain.found] == rows
    broken = write(tmp_path / "broken.jpg", degrees(0, 0), 2)
    (told,) = locate(model, index, [broken], 1, "cpu", progress=False)
    assert told.own.degrees is None and "(0, 0)" in told.own.problem and told.found[0].row == rows[0]


def test_southern_and_degrees_indices_measure_too(model: PlaceModel, tmp_path: Path) -> None:
    for place, latitude in enumerate((-0.02, -0.01, -0.03)):
        write(tmp_path / "p" / f"{place}.jpg", degrees(latitude, 33.0), place)
    index = make_index(model, tmp_path / "p", tmp_path / "index", CONFIG, "cpu", "f", progress=False)
    asked = write(tmp_path / "north.jpg", degrees(0.01, 33.0), 0)  # over the equator, from an index south of it
    (answer,) = locate(model, index, [asked], 3, "cpu", progress=False)
    assert index.zone == "36S"
    assert metres_of(answer, 0) == pytest.approx(0.03 * 110_574 * 0.9996, rel=1e-3)
    (tmp_path / "list.csv").write_text("image,lat,lon\np/0.jpg,-0.02,33\np/1.jpg,-0.01,33\n")
    listed = make_index(model, tmp_path / "list.csv", tmp_path / "listed", CONFIG, "cpu", "f", progress=False)
    (answer,) = locate(model, listed, [asked], 2, "cpu", progress=False)
    assert metres_of(answer, 0) == pytest.approx(0.03 * 110_574, rel=0.006)
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "@1@2@.jpg").write_bytes((tmp_path / "p" / "0.jpg").read_bytes())
    unknown = make_index(model, tmp_path / "x", tmp_path / "unknown", CONFIG, "cpu", "f", progress=False)
    assert locate(model, unknown, [asked], 1, "cpu", progress=False)[0].found[0].metres is None  # metres of which zone?
    with pytest.raises(DataError, match="no jpg"):
        (tmp_path / "empty").mkdir()
        make_index(model, tmp_path / "empty", tmp_path / "index", CONFIG, "cpu", "f", progress=False)
