"""An index that grows: equal to one built at once, nothing described twice, and no kill loses anything."""

from __future__ import annotations

import contextlib
import dataclasses
import glob
import json
import os
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from full_disk import small_files
from job_process import JobProcess
from tiny import photo
from tiny_checkpoint import save_tiny

from pipeline.common.errors import DataError, UsageError
from pipeline.config import EvaluationConfig
from pipeline.locate import descriptor_cache
from pipeline.locate.answers import locate
from pipeline.locate.photo_index import make_index, open_index
from pipeline.model.vpr import PlaceModel
from pipeline.model.weights.files import load_model

CONFIG = EvaluationConfig(workers=0, batch=1)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_tiny(tmp_path_factory.mktemp("run"), 0)


@pytest.fixture(scope="module")
def model(run: Path) -> PlaceModel:
    return load_model(run)


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """Twelve photos in two folders."""
    for place in range(12):
        (tmp_path / "photos" / f"{place % 2}").mkdir(parents=True, exist_ok=True)
        photo(place, 0).save(tmp_path / "photos" / f"{place % 2}" / f"p{place:02d}.jpg", quality=95)
    return tmp_path / "photos"


def change(photos: Path) -> None:
    """Five new ones, at the front and between the others, two changed, one gone."""
    for place in range(20, 24):
        photo(place, 0).save(photos / "0" / f"p{place - 19:02d}x.jpg", quality=95)
    photo(24, 0).save(photos / "a first one.png")
    photo(30, 0).save(photos / "1" / "p03.jpg", quality=95)
    photo(31, 0).save(photos / "0" / "p06.jpg", quality=95)
    (photos / "1" / "p11.jpg").unlink()


def start(run: Path, index: Path, *options: str) -> JobProcess:
    words = ["--checkpoint", str(run), "--workers", "0", "--index", str(index), *options]
    return JobProcess("jobs.locate", words, index.with_suffix(".log"))


def finished(job: JobProcess) -> str:
    assert job.wait() == 0, job.text()
    return job.text()


def in_parts(index: Path) -> list[list[str]]:
    """The photos of each part of the descriptors, by any Parquet reader."""
    return [pq.read_table(f)["photo"].to_pylist() for f in sorted((index / "described").glob("*.parquet"))]


def same_index(one: Path, two: Path) -> bool:
    """Whether two index folders hold the same bytes."""
    places = [next(index.glob("index-*")) for index in (one, two)]
    files = [sorted(file.name for file in place.iterdir()) for place in places]
    return files[0] == files[1] and all((places[0] / f).read_bytes() == (places[1] / f).read_bytes() for f in files[0])


def test_grown_is_the_same_as_built_at_once_and_only_the_new_is_described(
    run: Path, photos: Path, tmp_path: Path
) -> None:
    index, asked = tmp_path / "index", str(tmp_path / "asked.png")
    photo(21, 1).save(asked)
    assert "12 new, 0 changed, 0 gone, 0 kept\n" in finished(start(run, index, "--build", str(photos)))
    change(photos)
    text = finished(start(run, index, "--build", str(photos), "--photos", asked, "--figures", "false"))
    assert "5 new, 2 changed, 1 gone, 9 kept\n" in text and "16 photos without positions" in text, text
    first, second = in_parts(index)
    new = ["0/p01x.jpg", "0/p02x.jpg", "0/p03x.jpg", "0/p04x.jpg", "a first one.png", "0/p06.jpg", "1/p03.jpg"]
    assert len(first) == 12 and sorted(second) == sorted(str(photos / name) for name in new)

    finished(start(run, tmp_path / "fresh", "--build", str(photos), "--photos", asked, "--figures", "false"))
    assert same_index(index, tmp_path / "fresh")
    answers = [json.loads((i / "answers/answers.json").read_text())["photos"] for i in (index, tmp_path / "fresh")]
    assert answers[0] == answers[1] and Path(answers[0][0]["answers"][0]["place"]).name == "p02x.jpg"

    before = {f: f.stat().st_mtime_ns for f in index.rglob("*") if f.is_file() and "answers" not in str(f)}
    assert "0 new, 0 changed, 0 gone, 16 kept\n" in finished(start(run, index, "--build", str(photos)))
    assert all(f.stat().st_mtime_ns == when for f, when in before.items())  # nothing to do, nothing written


@pytest.mark.parametrize("settings", [{"search": "hnsw"}, {"search": "binary", "refine": 9, "prefix": 16}, {"pca": 5}])
def test_other_ways_to_search_grow_alike(
    model: PlaceModel, photos: Path, tmp_path: Path, settings: dict[str, object]
) -> None:
    config = dataclasses.replace(CONFIG, **settings)  # type: ignore[arg-type]
    make_index(model, photos, tmp_path / "grown", CONFIG, "cpu", "f", progress=False)
    change(photos)
    index = make_index(model, photos, tmp_path / "grown", config, "cpu", "f", progress=False)
    assert index.growth is not None and index.growth.described == 7  # other settings of the search describe nothing
    make_index(model, photos, tmp_path / "fresh", config, "cpu", "f", progress=False)
    assert same_index(tmp_path / "grown", tmp_path / "fresh")


def test_other_weights_describe_all_again(run: Path, model: PlaceModel, photos: Path, tmp_path: Path) -> None:
    index = tmp_path / "index"
    make_index(model, photos, index, CONFIG, "cpu", "f", progress=False)
    other = load_model(save_tiny(tmp_path / "other", 1))
    grown = make_index(other, photos, index, CONFIG, "cpu", "g", progress=False)
    assert "12 of these described again: other weights or settings" in str(grown.growth)
    make_index(other, photos, tmp_path / "fresh", CONFIG, "cpu", "g", progress=False)
    assert same_index(index, tmp_path / "fresh") and len(in_parts(index)) == 1  # the former weights' are gone


def test_several_folders_and_a_manifest(model: PlaceModel, photos: Path, tmp_path: Path) -> None:
    (tmp_path / "list.csv").write_text("image\nphotos/1/p03.jpg\nphotos/1/p01.jpg\n")
    sources = [photos / "0", tmp_path / "list.csv", tmp_path / "photos" / "1" / ".." / "0"]
    index = make_index(model, sources, tmp_path / "index", CONFIG, "cpu", "f", progress=False)
    names = [str(p.relative_to(photos)) for p in index.photos]
    assert names == [f"0/p{i:02d}.jpg" for i in range(0, 12, 2)] + ["1/p03.jpg", "1/p01.jpg"]
    assert any("6 photos are named twice" in line for line in index.about["remarks"])
    again = make_index(model, [photos / "1", photos / "0"], tmp_path / "index", CONFIG, "cpu", "f", progress=False)
    assert str(again.growth) == "4 new, 0 changed, 0 gone, 8 kept"
    assert [p.name for p in again.photos][:2] == ["p01.jpg", "p03.jpg"]
    (tmp_path / "metres.csv").write_text("image,utm_east,utm_north\nphotos/1/p03.jpg,500000,5000000\n")
    (tmp_path / "degrees.csv").write_text("image,lat,lon\nphotos/1/p01.jpg,45.16,3.01\nphotos/1/p05.jpg,,\n")
    both = [tmp_path / "metres.csv", tmp_path / "degrees.csv"]
    with pytest.raises(UsageError, match=r"p03.*unknown UTM zone.*p01.*--zone 31N"):
        make_index(model, both, tmp_path / "index", CONFIG, "cpu", "f", progress=False)
    mixed = make_index(model, both, tmp_path / "index", CONFIG, "cpu", "f", progress=False, zone="31N")
    assert mixed.degrees is not None and mixed.positions is not None and mixed.zone == "31N"
    np.testing.assert_allclose(mixed.degrees[:2], [[45.1535, 3.0], [45.16, 3.01]], atol=1e-4)
    assert mixed.positions[0].tolist() == [500000, 5000000] and np.isnan(mixed.positions[2]).all()


def test_killed_while_describing_the_old_index_answers_and_the_build_continues(
    run: Path, model: PlaceModel, photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(descriptor_cache, "PART_SECONDS", 0.0)  # a part a photo, as if each took half a minute
    index = tmp_path / "index"
    finished(start(run, index, "--build", str(photos)))
    former = {f: f.read_bytes() for f in next(index.glob("index-*")).iterdir()}
    for place in range(40, 100):
        photo(place, 0).save(photos / f"later {place}.jpg", quality=95)
    job = start(run, index, "--build", str(photos))
    held = len(in_parts(index))
    job.kill_when(lambda: len(list((index / "described").glob("*.parquet"))) >= held + 3)
    assert job.wait() == -9
    assert all(f.read_bytes() == content for f, content in former.items())
    fingerprint = json.loads((index / "about.json").read_text())["fingerprint"]
    assert len(open_index(index, fingerprint).photos) == 12
    asked = photos / "0" / "p04.jpg"
    (answer,) = locate(model, open_index(index, fingerprint), [asked], 1, "cpu", progress=False)
    assert [found.place for found in answer.found] == [asked]

    survived = sum(map(len, in_parts(index))) - 12
    assert 3 <= survived < 60
    text = finished(start(run, index, "--build", str(photos)))
    assert f"60 new, 0 changed, 0 gone, 12 kept; {survived} had been described by an earlier build" in text, text
    finished(start(run, tmp_path / "fresh", "--build", str(photos)))
    assert same_index(index, tmp_path / "fresh")
    (tidied,) = in_parts(index)
    assert sorted(tidied) == sorted(map(str, photos.rglob("*.jpg")))


def test_killed_at_any_moment_it_is_the_old_index_or_the_new_one(
    run: Path, photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(descriptor_cache, "PART_SECONDS", 0.0)
    index = tmp_path / "index"
    finished(start(run, index, "--build", str(photos)))
    fingerprint = json.loads((index / "about.json").read_text())["fingerprint"]
    sizes, killed = [12], 0
    moments = [("described/*", 0), ("index-*", 0), ("index-*/*", 0), ("index-*/*", 2), ("index-*/*", 5), ("a*.tmp", 0)]
    for turn, (files, delay) in enumerate(moments):
        pattern = str(index / files)
        photo(200 + turn, 0).save(photos / f"turn {turn}.jpg", quality=95)
        before = set(glob.glob(pattern))  # noqa: PTH207  Path.glob fails where a folder goes away meanwhile
        job = start(run, index, "--build", str(photos))
        while job.alive() and set(glob.glob(pattern)) <= before:  # noqa: PTH207
            time.sleep(0.0005)
        time.sleep(delay / 1000)
        killed += job.alive()
        with contextlib.suppress(ProcessLookupError):
            job.send(9)
        job.wait()
        sizes.append(len(open_index(index, fingerprint).photos))
        assert sizes[-1] in (sizes[-2], 13 + turn)
    assert killed > 0
    finished(start(run, index, "--build", str(photos)))
    finished(start(run, tmp_path / "fresh", "--build", str(photos)))
    assert same_index(index, tmp_path / "fresh") and len(list(index.glob("index-*"))) == 1


def test_a_first_build_killed_just_before_its_end_is_continued(
    model: PlaceModel, photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    index = tmp_path / "index"

    class Killed(BaseException):
        pass

    whole = Path.rename

    def kill(self: Path, target: Path) -> Path:
        if target.name == "about.json":
            raise Killed
        return whole(self, target)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(Path, "rename", kill)
        make_index(model, photos, index, CONFIG, "cpu", "f", progress=False)
    assert (index / "about.json.tmp").exists()
    make_index(model, photos, index, CONFIG, "cpu", "f", progress=False)
    assert sorted(f.name for f in index.iterdir()) == [".lock", "about.json", "described", "index-000001"]


def test_a_full_disk_leaves_no_half_part(photos: Path, tmp_path: Path) -> None:
    files = sorted(photos.rglob("*.jpg"))
    states, described = np.zeros((len(files), 2), np.int64), [(np.arange(len(files)), np.ones((len(files), 50)))]
    kept = descriptor_cache.KeptDescriptors(tmp_path / "described", {})
    with pytest.raises(OSError, match="too large"), small_files(1_000):
        kept.keep(files, states, described)
    assert list((tmp_path / "described").iterdir()) == []
    kept.keep(files, states, described)
    assert len(kept.find(files, states)) == len(files)


def test_stale_descriptors_do_not_pile_up(model: PlaceModel, photos: Path, tmp_path: Path) -> None:
    index, few = tmp_path / "index", photos / "0"
    for turn in range(16):  # each day one of the six photos is another one
        if turn:
            photo(300 + turn, 0).save(few / f"p{turn % 6 * 2:02d}.jpg", quality=95)
        grown = make_index(model, few, index, CONFIG, "cpu", "f", progress=False)
        assert grown.growth is not None and grown.growth.described == (1 if turn else 6)
    assert sum(map(len, in_parts(index))) <= 4 * 6 and len(in_parts(index)) <= 12
    make_index(model, few, tmp_path / "fresh", CONFIG, "cpu", "f", progress=False)
    assert same_index(index, tmp_path / "fresh")


def test_a_broken_photo_keeps_what_came_before_it(model: PlaceModel, photos: Path, tmp_path: Path) -> None:
    index = tmp_path / "index"
    make_index(model, photos, index, CONFIG, "cpu", "f", progress=False)
    photo(50, 0).save(photos / "good.jpg")
    (photos / "x broken.jpg").write_bytes(b"no photo")
    with pytest.raises(DataError, match=r"x broken\.jpg"):
        make_index(model, photos, index, CONFIG, "cpu", "f", progress=False)
    assert len(open_index(index, "f").photos) == 12
    (photos / "x broken.jpg").unlink()
    grown = make_index(model, photos, index, CONFIG, "cpu", "f", progress=False)
    assert str(grown.growth) == "1 new, 0 changed, 0 gone, 12 kept; 1 had been described by an earlier build"


def test_folders_that_are_no_index_and_builds_at_once_are_refused(
    run: Path, model: PlaceModel, photos: Path, tmp_path: Path
) -> None:
    import fcntl

    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "about.json").write_text('{"title": "my web site"}')
    with pytest.raises(UsageError, match="not that of an index"):
        make_index(model, photos, tmp_path / "mine", CONFIG, "cpu", "f", progress=False)
    (tmp_path / "index").mkdir()
    with (tmp_path / "index" / ".lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        job = start(run, tmp_path / "index", "--build", str(photos))
        assert job.wait() == 2 and "another build works in it" in job.text()


def test_the_photo_itself_is_at_distance_zero(model: PlaceModel, photos: Path, tmp_path: Path) -> None:
    index = make_index(model, photos, tmp_path / "index", CONFIG, "cpu", "f", progress=False)
    for answer in locate(model, index, index.photos, 1, "cpu", progress=False):
        assert [(found.place, found.distance) for found in answer.found] == [(answer.photo, 0.0)]
    state = (photos / "0" / "p00.jpg").stat()
    photo(60, 0).save(photos / "0" / "p00.jpg", quality=95)
    os.utime(photos / "0" / "p00.jpg", ns=(state.st_atime_ns, state.st_mtime_ns + 1))
    again = make_index(model, photos, tmp_path / "index", CONFIG, "cpu", "f", progress=False)
    assert again.growth is not None and again.growth.changed == 1
    assert np.isclose(locate(model, again, [photos / "0" / "p00.jpg"], 1, "cpu", False)[0].found[0].distance, 0)
