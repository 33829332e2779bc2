"""Mixed positions, answers as files of other programs, what is asked, and "probably not on this map"."""

from __future__ import annotations

import csv
import dataclasses
import json
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from located import degrees, write
from PIL import Image
from tiny import photo
from tiny_checkpoint import save_tiny

from pipeline.common.errors import DataError, UsageError
from pipeline.config import EvaluationConfig
from pipeline.evaluation.search.approximate import build_index
from pipeline.evaluation.search.exact import slices
from pipeline.locate.answers import Answer, locate
from pipeline.locate.asked import asked_photos
from pipeline.locate.exports import NO_MATCH, export, table
from pipeline.locate.no_match import Apart, Calibration, calibrate, nearest_elsewhere
from pipeline.locate.photo_index import PhotoIndex, make_index
from pipeline.locate.photos import Photos, find_photos, taken
from pipeline.model.weights.files import load_model

HOSTILE = '@500200@5000000@31@T@ <b>&\x1b, "quo\'te" =1@.jpg'


@pytest.fixture(scope="module")
def asked(tmp_path_factory: pytest.TempPathFactory) -> tuple[PhotoIndex, list[Answer]]:
    """An index of one folder with positions in names, in EXIF and none, and two photos that asked it."""
    home = tmp_path_factory.mktemp("home")
    model = load_model(save_tiny(home / "run", 0))
    for place in range(4):
        write(home / "p" / f"@{500000 + 10 * place}@5000000@31@T@{place}@.jpg", None, place)
    write(home / "p" / HOSTILE, None, 4)
    write(home / "p" / "exif.jpg", degrees(45.16, 3.01), 5)
    write(home / "p" / "none.jpg", None, 6)
    index = make_index(
        model, home / "p", home / "index", EvaluationConfig(workers=0, batch=1), "cpu", "f", progress=False
    )
    questions = [write(home / "q" / "@500012@5000000@31@T@.jpg", None, 1), write(home / "q" / "plain.jpg", None, 6)]
    return index, locate(model, index, questions, 7, "cpu", progress=False)


def test_a_folder_with_positions_of_every_kind(asked: tuple[PhotoIndex, list[Answer]]) -> None:
    index, (named, plain) = asked
    assert (index.coordinates, index.zone, len(index.photos)) == ("utm", "31N", 7)
    assert any("6 of 7 photos have a position" in line for line in index.about["remarks"])
    for found in named.found:
        if found.place.name == "none.jpg":
            assert found.utm is found.degrees is found.metres is found.right is None
        elif found.place.name == "exif.jpg":
            assert found.degrees == pytest.approx((45.16, 3.01), abs=1e-6) and not found.right
        else:
            east = float(found.place.name.split("@")[1])
            assert found.utm == (east, 5000000) and found.degrees is not None
            assert found.metres == pytest.approx(abs(500012 - east)) and found.right == (abs(500012 - east) <= 25)
    assert [f.right for f in plain.found] == [None] * 7
    told = table([named, plain], index)
    assert {"latitude", "longitude", "zone", "metres away"} <= set(told.head)
    text = told.text()
    assert "\x1b" not in text and all(re.search(r"\b45\.1\d{5}\b.* 31N", line) for line in text.splitlines()
                                      if "@.jpg" in line and "none" not in line and "plain" not in line)  # fmt: skip


def test_one_rule_for_the_photo_that_asks(tmp_path: Path) -> None:
    path = write(tmp_path / "a.jpg", degrees(48.5, 2.25))
    assert taken("a.jpg", path).degrees == pytest.approx((48.5, 2.25)) == taken("x", path.read_bytes()).degrees
    named = taken("@500000@5000000@.jpg", path)
    assert named.degrees is None and named.metres == (500000, 5000000) and named.zone == ""
    assert taken("@500000@5000000@.jpg", path, "31S").degrees is not None
    assert taken("@x@y@.jpg", path).degrees is not None  # no position in this name; the GPS is
    (tmp_path / "m.csv").write_text("image,lat,lon\na.jpg,48,\n")
    with pytest.raises(DataError, match="row 1: lon"):
        find_photos([tmp_path / "m.csv"], progress=False)
    (tmp_path / "m.csv").write_text("image,lat,lon\na.jpg,98,2\n")
    with pytest.raises(DataError, match=r"m\.csv.*a\.jpg.*latitude 98.*no place"):
        find_photos([tmp_path / "m.csv"], progress=False)


def test_files_of_other_programs(asked: tuple[PhotoIndex, list[Answer]], tmp_path: Path) -> None:
    index, answers = asked
    answers = [answers[0], dataclasses.replace(answers[1], matched=False)]
    for name in ("a.geojson", "a.csv", "a.kml"):
        export(answers, index, tmp_path / name)
    features = json.loads((tmp_path / "a.geojson").read_text())["features"]
    assert len(features) == 14 and [f["properties"]["rank"] for f in features] == [*range(1, 8)] * 2
    near = next(f for f in features if f["properties"]["place"].endswith("exif.jpg"))
    assert near["geometry"]["coordinates"] == pytest.approx([3.01, 45.16], abs=1e-6)  # longitude first
    assert next(f for f in features if f["properties"]["place"].endswith("none.jpg"))["geometry"] is None
    rows = list(csv.DictReader((tmp_path / "a.csv").open(newline="")))
    assert len(rows) == 14 and rows[0]["right"] == "True" and rows[7]["matched"] == "False"
    assert float(rows[0]["lat"]) == answers[0].found[0].degrees[0] and rows[0]["utm_zone"] == "31N"  # type: ignore[index]
    tree = ElementTree.parse(tmp_path / "a.kml").getroot()
    space = {"k": "http://www.opengis.net/kml/2.2"}
    marks = tree.findall(".//k:Placemark", space)
    assert len(marks) == 14 and len(tree.findall(".//k:Point", space)) == 12
    assert sum(r"<b>&\x1b" in (m.findtext("k:name", "", space)) for m in marks) == 2
    assert [d.text for d in tree.findall(".//k:Folder/k:description", space)] == [NO_MATCH]
    with pytest.raises(DataError, match="names with spaces"):
        export(answers, index, tmp_path / "pairs.txt")
    clean = [dataclasses.replace(a, found=[f for f in a.found if " " not in f.place.name]) for a in answers]
    export(clean, index, tmp_path / "pairs.txt")
    lines = (tmp_path / "pairs.txt").read_text().splitlines()
    assert [line.split()[1] for line in lines] == [f.place.name for f in clean[0].found]  # none of what is not there
    assert {line.split()[0] for line in lines} == {"@500012@5000000@31@T@.jpg"}
    with pytest.raises(UsageError, match=r"\.geojson, \.csv"):
        export(answers, index, tmp_path / "a.gpx")


def test_what_is_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a.jpg", "b.jpg", "c.png", "[x].jpg"):
        photo(0, 0).save(tmp_path / name)
    (tmp_path / "notes.txt").write_text("no photo")
    monkeypatch.chdir(tmp_path)
    assert [p.name for p in asked_photos(["*.jpg", "c.png", "c.png"], tmp_path)] == [
        "[x].jpg", "a.jpg", "b.jpg", "c.png",
    ]  # fmt: skip
    assert asked_photos(["[x].jpg"], tmp_path) == [Path("[x].jpg")]  # a file of that name before a pattern
    assert len(asked_photos([str(tmp_path)], tmp_path)) == 4 and len(asked_photos(["*"], tmp_path)) == 4
    for word in ("nowhere.jpg", "z*.jpg"):
        with pytest.raises(UsageError, match=re.escape(word)):
            asked_photos([word], tmp_path)


def test_a_video_every_n_th_second(tmp_path: Path) -> None:
    (tmp_path / "drive.mp4").write_bytes(b"no video")
    try:
        import av
    except ImportError:
        with pytest.raises(UsageError, match=r"drive\.mp4: a video needs PyAV"):
            asked_photos([str(tmp_path / "drive.mp4")], tmp_path / "frames")
        return
    with pytest.raises(DataError, match=r"drive\.mp4: not a readable video"):
        asked_photos([str(tmp_path / "drive.mp4")], tmp_path / "frames")
    with av.open(str(tmp_path / "drive.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width = stream.height = 64
        for number in range(55):  # 5.5 seconds, brighter and brighter
            image = Image.new("RGB", (64, 64), (4 * number,) * 3)
            container.mux(stream.encode(av.VideoFrame.from_image(image)))
        container.mux(stream.encode())
    found = asked_photos([str(tmp_path / "drive.mp4")], tmp_path / "frames", every=2.0)
    assert [float(f.stem.split("-")[-1][:-1]) for f in found] == pytest.approx([0, 2, 4], abs=0.06)
    grey = [np.asarray(Image.open(f)).mean() for f in found]
    assert grey == pytest.approx([0, 80, 160], abs=8)


@pytest.mark.parametrize("search", ["exact", "hnsw"])
def test_the_threshold_is_a_quantile_of_the_nearest_of_another_place(search: str) -> None:
    rng = np.random.default_rng(0)
    rows = 200
    values = rng.normal(size=(rows, 8)).astype(np.float32)
    positions = rng.uniform(0, 600, (rows, 2))
    positions[7] = np.nan
    files = [Path(f"/p/{i}.jpg") for i in range(rows)]
    photos = Photos(files, np.zeros((rows, 2), np.int64), Path("/p"), "utm", positions)
    index = build_index(lambda: slices(values), search)
    told = calibrate(index, photos, np.arange(rows), values, Apart(metres=150))
    far = np.linalg.norm(values[:, None] - values[None], axis=-1)
    with np.errstate(invalid="ignore"):
        apart = np.linalg.norm(positions[:, None] - positions[None], axis=-1) > 150
    wanted = np.sort(np.where(apart, far, np.inf).min(1)[np.arange(rows) != 7])
    np.testing.assert_allclose(told.elsewhere, wanted, atol=1e-4)
    assert told.threshold is not None and np.mean(wanted < told.threshold) <= 0.05
    assert told.matched(told.threshold - 1e-3) and told.matched(told.threshold) is False
    assert told.confidence(0.0) == 1 and told.confidence(99) == 0
    assert "199 photos of the index" in told.how

    bare = dataclasses.replace(photos, positions=None, coordinates="none")
    unknown = calibrate(index, bare, np.arange(rows), values, Apart())
    assert unknown.threshold is unknown.confidence(0) is unknown.matched(0) is None and "no position" in unknown.how
    ordered = calibrate(index, bare, np.arange(rows), values, Apart(frames=150))
    distant = np.abs(np.arange(rows)[:, None] - np.arange(rows)[None]) > 150
    np.testing.assert_allclose(
        ordered.elsewhere, np.sort(np.where(distant, far, np.inf).min(1)[distant.any(1)]), atol=1e-4
    )  # rows in the middle have no such photo, and k grows to all rows before the last is found
    few = nearest_elsewhere(index, np.arange(3), values[:3], lambda row: np.zeros(rows, bool))
    assert len(few) == 0
    assert Calibration(np.zeros(0), "").threshold is None
