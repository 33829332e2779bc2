"""`jobs.locate` as a person starts it: build, ask, and what it says when something is wrong."""

from __future__ import annotations

import json
import re
import signal
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest
import torch
from job_process import JobProcess
from PIL import Image
from tiny import photo
from tiny_checkpoint import save_tiny

from jobs.locate import path_words
from pipeline.common.errors import DataError, UsageError
from pipeline.config import EvaluationConfig
from pipeline.data.images import load_image, normalise, to_input
from pipeline.evaluation.identity import model_digest
from pipeline.locate.answers import locate
from pipeline.locate.photo_index import make_index, open_index
from pipeline.model.vpr import PlaceModel
from pipeline.model.weights.files import load_model

CONFIG = EvaluationConfig(workers=0, batch=4)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run, another run, eleven photos with `@utm` names, the same without positions, and two that ask."""
    folder = tmp_path_factory.mktemp("home")
    save_tiny(folder / "run", 0)
    save_tiny(folder / "other", 1)
    for name in ("utm", "plain", "asked"):
        (folder / name).mkdir()
    for place in range(11):
        photo(place, 0).save(folder / "utm" / f"@{500000 + 50 * place}@{4400000}@p{place}@.jpg", quality=95)
        photo(place, 0).save(folder / "plain" / f"p{place:02d}.jpg", quality=95)
    photo(3, 1).save(folder / "asked" / "three, at night.jpg", quality=95)
    Image.open(folder / "plain" / "p07.jpg").save(folder / "asked" / "seven.png")
    return folder


@pytest.fixture(scope="module")
def model(home: Path) -> PlaceModel:
    return load_model(home / "run")


def start(home: Path, *options: str) -> tuple[int, str]:
    job = JobProcess("jobs.locate", ["--workers", "0", "--index", str(home / "index"), *options], home / "job.log")
    code = job.wait()
    return code, job.text()


def plainly(model: PlaceModel, photos: list[Path]) -> np.ndarray:
    """Descriptors of photos alone, without the engine."""
    with torch.no_grad():
        return np.stack([model(normalise(to_input(load_image(p), 28))[None]).numpy()[0] for p in photos])


def test_build_and_ask_from_the_command_line(home: Path, model: PlaceModel) -> None:
    run = ("--checkpoint", str(home / "run"))
    code, text = start(home, *run, "--build", str(home / "utm"))
    assert code == 0 and "11 photos with UTM positions" in text, text
    asked = sorted((home / "asked").glob("*"))
    questions = [str(home / "asked" / "*.*"), str(asked[0])]  # a pattern, and one of its photos again
    files = [str(home / "out" / f"a.{ending}") for ending in ("geojson", "csv", "kml")]
    code, text = start(home, *run, "--photos", *questions, "--answers", "3", "--to", *files)
    assert code == 0 and all(Path(file).stat().st_size > 100 for file in files), text
    answers = json.loads((home / "index" / "answers" / "answers.json").read_text())["photos"]
    assert [Path(a["photo"]) for a in answers] == asked
    database = sorted((home / "utm").glob("*"))
    far = np.linalg.norm(plainly(model, asked)[:, None] - plainly(model, database)[None], axis=-1)
    for answer, row in zip(answers, far, strict=True):
        found = [database.index(Path(a["place"])) for a in answer["answers"]]
        assert found == np.argsort(row)[:3].tolist()
        np.testing.assert_allclose([a["distance"] for a in answer["answers"]], np.sort(row)[:3], atol=2e-3)
        assert [a["utm_east"] for a in answer["answers"]] == [500000 + 50 * int(database[f].name.split("@p")[1][:-5])
                                                              for f in found]  # fmt: skip
    assert answers[0]["answers"][0]["distance"] < 2e-3 and "@p7@" in answers[0]["answers"][0]["place"]
    line = next(line for line in text.splitlines() if "@500350@4400000@p7@" in line and " 0.000 " in line)
    assert line.split()[-2:] == ["500350.0", "4400000.0"] and "latitude" not in text  # of which zone is not known
    picture = np.asarray(Image.open(home / "index" / "answers" / "answers.jpg")).astype(int)
    assert (np.abs(picture - (0x3B, 0x6F, 0xB6)).max(-1) < 20).mean() > 0.01  # the frames of answers


def test_an_answer_does_not_depend_on_other_photos(home: Path, model: PlaceModel, tmp_path: Path) -> None:
    index = make_index(model, home / "plain", tmp_path / "index", CONFIG, "cpu", "f", progress=False)
    assert index.positions is None and index.coordinates == "none"
    asked = sorted((home / "utm").glob("*"))
    together = locate(model, index, asked, 4, "cpu", progress=False)
    for photo_asked, answer in zip(asked, together, strict=True):
        (alone,) = locate(model, index, [photo_asked], 4, "cpu", progress=False)
        assert alone == answer and len(alone.found) == 4  # to the last bit
        assert all(found.utm is None and found.degrees is None for found in alone.found)


def test_saved_and_opened_with_positions_from_a_manifest(home: Path, model: PlaceModel, tmp_path: Path) -> None:
    lines = [f"{home}/plain/p{i:02d}.jpg,{48 + i / 100},{-0.125 * i}" for i in range(11)]
    (tmp_path / "mine.csv").write_text("image,lat,lon\n" + "\n".join(lines) + "\n")
    config = EvaluationConfig(workers=0, pca=5, search="hnsw")
    made = make_index(model, tmp_path / "mine.csv", tmp_path / "index", config, "cpu", "f", progress=False)
    again = open_index(tmp_path / "index", "f")
    asked = [home / "asked" / "seven.png"]
    (first,), (second,) = (locate(model, index, asked, 20, "cpu", progress=False) for index in (made, again))
    assert first == second and len(first.found) == 11 and again.index.d == 5 and again.zone == "30N"
    best = first.found[0]
    assert best.degrees == pytest.approx((48.07, -0.875)) and best.place.name == "p07.jpg"
    assert first.to_dict()["answers"][0]["lat"] == pytest.approx(48.07)


def test_mistakes_are_one_line(home: Path, model: PlaceModel, tmp_path: Path) -> None:
    make_index(model, home / "plain", home / "index", CONFIG, "cpu", model_digest(model), progress=False)
    asked = str(home / "asked" / "seven.png")
    broken = tmp_path / "broken.jpg"
    broken.write_bytes((home / "plain" / "p01.jpg").read_bytes()[:300])
    cases = [
        (["--checkpoint", str(home / "other"), "--photos", asked], 2, "made with other weights"),
        (["--checkpoint", str(home / "run"), "--photos", str(broken)], 3, "broken.jpg"),
        (["--checkpoint", str(home / "run"), "--photos", "nowhere.jpg"], 2, "nowhere.jpg: no such photo"),
        (["--checkpoint", str(home / "run"), "--photos", asked, "--index", str(tmp_path / "no")], 3, "no finished"),
        (["--checkpoint", str(home / "run"), "--build", str(home / "plain"), "--index", str(tmp_path)], 2, "other thi"),
        (["--checkpoint", str(home / "run")], 2, "nothing to do"),
        (["--checkpoint", str(home / "run"), "--photos", asked, "--to", "a.gpx"], 2, "no known ending"),
        (["--checkpoint", str(home / "run"), "--photos", asked, "--zone", "61N"], 2, "--zone is '61N'"),
    ]
    for options, wanted, message in cases:
        code, text = start(home, *options)
        assert code == wanted and message in text and "Traceback" not in text, (options, text)


def test_a_broken_photo_of_the_folder_is_named_and_nothing_is_left(
    home: Path, model: PlaceModel, tmp_path: Path
) -> None:
    (tmp_path / "photos").mkdir()
    photo(1, 0).save(tmp_path / "photos" / "good.jpg")
    (tmp_path / "photos" / "bad.jpg").write_bytes(b"no photo")
    with pytest.raises(DataError, match=r"bad\.jpg"):
        make_index(model, tmp_path / "photos", tmp_path / "index", CONFIG, "cpu", "f", progress=False)
    with pytest.raises(DataError, match="no finished index"):
        open_index(tmp_path / "index", "f")
    with pytest.raises(UsageError, match="needs at least as many"):
        make_index(model, home / "plain", tmp_path / "index", EvaluationConfig(workers=0, pca=12), "cpu", "f")


def test_a_page_until_interrupted(home: Path, model: PlaceModel, tmp_path: Path) -> None:
    make_index(model, home / "plain", tmp_path / "index", CONFIG, "cpu", model_digest(model), progress=False)
    options = ["--checkpoint", str(home / "run"), "--index", str(tmp_path / "index"), "--serve", "--port", "0"]
    job, deadline = JobProcess("jobs.locate", options, tmp_path / "job.log"), time.monotonic() + 60
    while not (address := re.search(r"http://127\.0\.0\.1:\d+", job.text())):
        assert job.alive() and time.monotonic() < deadline, job.text()
        time.sleep(0.05)
    with urllib.request.urlopen(address[0], timeout=60) as answer:
        assert answer.status == 200 and b"11 photos in index" in answer.read()
    job.send(signal.SIGINT)
    assert job.wait() == 0 and "Traceback" not in job.text()


def test_names_of_photos_may_hold_anything() -> None:
    words = path_words(["--index", "i", "--photos", "a, b.jpg", "[c].jpg", "--answers", "2", "--build", "A", "B"])
    assert words == ["--index", "i", "--photos", '["a, b.jpg", "[c].jpg"]', "--answers", "2", "--build", '["A", "B"]']
