"""Every layout as a small folder: what is found, in which order, by which rule; and what is said when it is absent."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from pipeline.common.errors import DataError, UsageError
from pipeline.config import EvaluationConfig
from pipeline.evaluation.sets.evaluation_set import EvaluationSet, list_images
from pipeline.evaluation.sets.load import available, load_set, load_sets
from pipeline.evaluation.sets.registry import SETS, published_name


def touch(folder: Path, names: Iterable[str]) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


def utm(east: float, north: float, note: str = "", suffix: str = ".jpg") -> str:
    return f"@{east:010.2f}@{north:010.2f}@17@T@040.44@-080.01@{note}@@@@@@@@{suffix}"


def rows(loaded: EvaluationSet) -> list[list[int]]:
    return [positives.tolist() for positives in loaded.positives]


def config(root: Path, **fields: object) -> EvaluationConfig:
    return EvaluationConfig(root=str(root), **fields)  # type: ignore[arg-type]


DATABASE = [utm(583_400, 4_477_100), utm(583_425, 4_477_100), utm(583_500, 4_477_100, suffix=".png")]
QUERIES = [utm(583_400, 4_477_125, suffix=".JPG"), utm(583_600, 4_477_100, suffix=".jpeg")]


@pytest.mark.parametrize(
    ("name", "folder", "split"),
    [
        ("pitts30k", "pitts30k/images/val", "val"),
        ("Pitts250k", "Pitts250k/images/test", "test"),
        ("Tokyo24/7", "tokyo247/images/test", "test"),
        ("tokyo247", "tokyo24_7/images/test", "test"),
        ("sf-xs", "sf_xs/test", "test"),
    ],
)
def test_the_common_layout_by_name(tmp_path: Path, name: str, folder: str, split: str) -> None:
    touch(tmp_path / folder / "database", DATABASE)
    touch(tmp_path / folder / "queries", QUERIES)
    loaded = load_set(name, config(tmp_path, split=split))
    assert loaded.name == published_name(name)
    assert [p.name for p in loaded.database] == DATABASE
    assert rows(loaded) == [[0], []]  # 25 m exactly counts, 35.4 m does not
    assert (loaded.rule, loaded.without_positives) == ("25 m", 1)
    assert loaded.database_positions is not None and loaded.database_positions[2].tolist() == [583_500, 4_477_100]
    assert any("published are" in remark for remark in loaded.remarks) or not SETS[loaded.name].counts
    assert rows(load_set(name, config(tmp_path, split=split, radius=40.0))) == [[0, 1], []]


@pytest.mark.parametrize("part", ["", "images", "images/test"])
def test_any_folder_by_its_path(tmp_path: Path, part: str) -> None:
    base = tmp_path / "my city" / "images" / "test"
    touch(base / "database", [f"b/{DATABASE[1]}", f"a/{DATABASE[2]}", DATABASE[0], ".hidden.jpg", "readme.txt"])
    touch(base / "queries", QUERIES)
    loaded = load_set(str(tmp_path / "my city" / part), EvaluationConfig())
    assert loaded.name == "my_city"
    relative = [str(p.relative_to(base / "database")) for p in loaded.database]
    assert relative == [DATABASE[0], f"a/{DATABASE[2]}", f"b/{DATABASE[1]}"]
    assert rows(loaded) == [[0], []]
    assert load_set("my city", config(tmp_path)).name == "my_city"


def test_sequences_without_positions_need_frames(tmp_path: Path) -> None:
    for side in ("database", "queries"):
        touch(tmp_path / side, [f"frame{i:02d}.png" for i in range(5)])
    bare = load_set(str(tmp_path), EvaluationConfig())
    assert not bare.has_ground_truth and "answers are shown, not scored; to score them, name images" in bare.remarks[0]
    touch(tmp_path / "pitts30k" / "test" / "database", ["a.jpg"]), touch(tmp_path / "pitts30k/test/queries", ["b.jpg"])
    with pytest.raises(DataError, match=r"a\.jpg: no position in this name; name images @UTM_east"):
        load_set("pitts30k", config(tmp_path))
    loaded = load_set(str(tmp_path), EvaluationConfig(frames=1))
    assert (rows(loaded)[:2], loaded.rule) == ([[0, 1], [0, 1, 2]], "+-1 frames")
    (tmp_path / "queries" / "frame04.png").unlink()
    with pytest.raises(DataError, match=r"5 database frames .* but 4 query frames"):
        load_set(str(tmp_path), EvaluationConfig(frames=1))


def test_frames_do_not_overrule_positions(tmp_path: Path) -> None:
    touch(tmp_path / "database", DATABASE)
    touch(tmp_path / "queries", QUERIES)
    loaded = load_set(str(tmp_path), EvaluationConfig(frames=5))
    assert loaded.rule == "25 m" and "does not apply" in loaded.remarks[0]


def test_svox_and_its_subsets(tmp_path: Path) -> None:
    base = tmp_path / "svox" / "images" / "test"
    touch(base / "gallery", DATABASE)
    for condition in ("night", "rain", "sun", "snow", "overcast"):
        touch(base / f"queries_{condition}", QUERIES[:1])
    night = load_set("svox_night", config(tmp_path))
    assert (night.name, rows(night), len(night.database)) == ("svox_night", [[0]], 3)
    assert night.queries[0].parent.name == "queries_night"
    assert [q.parent.name.removeprefix("queries_") for q in load_set("SVOX", config(tmp_path)).queries] == [
        "night", "rain", "sun", "snow", "overcast",
    ]  # fmt: skip
    (base / "queries_rain" / QUERIES[0]).unlink()
    with pytest.raises(DataError, match="queries_rain: no jpg, jpeg or png"):
        load_set("svox_rain", config(tmp_path))


def test_sf_xl_query_sets(tmp_path: Path) -> None:
    base = tmp_path / "sf_xl" / "processed" / "test"
    touch(base / "database", DATABASE)
    touch(base / "queries_v1", QUERIES)
    assert rows(load_set("sf_xl_v1", config(tmp_path))) == [[0], []]
    with pytest.raises(DataError, match=r"sf_xl_v2 is not there: expected .*queries_v2"):
        load_set("sf_xl_v2", config(tmp_path))


@pytest.mark.parametrize("layout", ["new/old", "ref/query", "images/test/database"])
@pytest.mark.parametrize("name", ["AmsterTime", "SPED"])
def test_pairs(tmp_path: Path, name: str, layout: str) -> None:
    folder = tmp_path / name.lower()
    stems = ["0", "1", "10", "2"]
    if layout.startswith("images"):
        for side in ("database", "queries"):
            touch(folder / "images" / "test" / side, [f"@0@{int(s) * 1000}@@@@@{s}@@@@@@@@.jpg" for s in stems])
    else:
        database, queries = layout.split("/")
        touch(folder / database, [f"{s}.png" for s in stems])
        touch(folder / queries, [f"{s}.jpg" for s in stems])
    loaded = load_set(name, config(tmp_path))
    assert (rows(loaded), loaded.rule) == ([[0], [1], [2], [3]], "pairs")
    loaded.queries[1].unlink()
    with pytest.raises(DataError, match="1 images have no partner of the same name"):
        load_set(name, config(tmp_path))


def frames(count: int, suffix: str = ".png") -> list[str]:
    return [f"images-{i:05d}{suffix}" for i in range(count)]


@pytest.mark.parametrize("layout", ["summer/winter", "images/test/database", "query/ref"])
def test_both_nordlands(tmp_path: Path, layout: str) -> None:
    folder = tmp_path / "Nordland"
    summer, winter = {
        "summer/winter": ("summer", "winter"),
        "images/test/database": ("images/test/database", "images/test/queries"),
        "query/ref": ("query", "ref"),
    }[layout]
    touch(folder / summer, frames(31))
    touch(folder / winter, frames(31))
    dense = load_set("nordland**", config(tmp_path))
    assert dense.name == "nordland_2star" and dense.rule == "+-10 frames"
    assert (len(dense.queries), rows(dense)[15]) == (31, list(range(5, 26)))
    assert dense.queries[0].is_relative_to(folder / winter) and dense.database[0].is_relative_to(folder / summer)
    sparse = load_set("Nordland*", config(tmp_path))
    assert sparse.name == "nordland_star" and sparse.rule == "+-1 frames"
    assert rows(sparse) == [[0, 1], [9, 10, 11], [19, 20, 21], [29, 30]]
    assert sparse.queries[1] == folder / summer / "images-00010.png"
    assert sparse.database[0].is_relative_to(folder / winter)
    assert len(rows(load_set("nordland*", config(tmp_path, frames=3)))[1]) == 7
    with pytest.raises(UsageError, match="two protocols"):
        load_set("nordland", config(tmp_path))


def test_nordland_queries_already_thinned_out(tmp_path: Path) -> None:
    touch(tmp_path / "nordland" / "ref", frames(31))
    touch(tmp_path / "nordland" / "query", frames(4))
    assert rows(load_set("nordland*", config(tmp_path)))[3] == [29, 30]
    with pytest.raises(DataError, match=r"4 database frames .* but 31 query frames"):
        load_set("nordland**", config(tmp_path))
    touch(tmp_path / "nordland" / "query", frames(6))
    with pytest.raises(DataError, match="every tenth frame"):
        load_set("nordland*", config(tmp_path))


def test_gardens_point(tmp_path: Path) -> None:
    for traverse in ("day_left", "day_right", "night_right"):
        touch(tmp_path / "gardens_point" / traverse, [f"Image{i}.jpg" for i in range(12)])  # not zero-padded
    loaded = load_set("gardens_point", config(tmp_path))
    assert loaded.queries[10].name == "Image10.jpg" and loaded.queries[0].parent.name == "night_right"
    assert (rows(loaded)[5], loaded.rule) == ([3, 4, 5, 6, 7], "+-2 frames")
    chosen = load_set("gardens_point:day_left->day_right", config(tmp_path, frames=0))
    assert (chosen.name, rows(chosen)[5]) == ("gardens_point_day_left_in_day_right", [5])
    assert (chosen.queries[0].parent.name, chosen.database[0].parent.name) == ("day_left", "day_right")
    by_path = load_set(f"{tmp_path / 'gardens_point'}:day_right->night_right", EvaluationConfig())
    assert by_path.database[0].parent.name == "night_right"
    with pytest.raises(DataError, match=r"no such traverse.*day_left, day_right, night_right"):
        load_set("gardens_point:noon->day_left", config(tmp_path))


def test_real_gardens_point(shared_dir: Path) -> None:
    loaded = load_set("gardens_point:day_right->night_right", config(shared_dir / "data"))
    assert (len(loaded.database), len(loaded.queries), loaded.remarks) == (200, 200, ())
    assert rows(loaded)[100] == [98, 99, 100, 101, 102]


@pytest.mark.parametrize("name", sorted(SETS))
def test_a_missing_set_says_where_it_is_expected_and_how_it_looks(tmp_path: Path, name: str) -> None:
    with pytest.raises(DataError, match=f"{name} is not there: expected .*{SETS[name].folders[0]}"):
        load_set(name, config(tmp_path))
    (tmp_path / SETS[name].folders[0]).mkdir()
    with pytest.raises(DataError, match=SETS[name].folders[0]):
        load_set(name, config(tmp_path))


def test_what_is_neither_name_nor_path(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="atlantis: neither a path, nor a folder below root"):
        load_set("atlantis", config(tmp_path))
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="no evaluation set here; expected images/test"):
        load_set(str(tmp_path / "empty"), config(tmp_path))


def test_sets_are_read_without_torch(tmp_path: Path) -> None:
    """Listing what is missing must not take the seconds that torch needs to load."""
    import subprocess
    import sys

    code = "import sys, pipeline.evaluation.sets.load as d; d.available('.'); sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).resolve().parents[4])


def test_dots_in_folder_names_stay(tmp_path: Path) -> None:
    touch(tmp_path / "city v1.2" / "database", DATABASE)
    touch(tmp_path / "city v1.2" / "queries", QUERIES)
    assert load_set(str(tmp_path / "city v1.2"), EvaluationConfig()).name == "city_v1.2"


def test_available_tells_present_from_missing(tmp_path: Path) -> None:
    touch(tmp_path / "miniature" / "images" / "test" / "database", DATABASE)
    touch(tmp_path / "miniature" / "images" / "test" / "queries", QUERIES)
    (tmp_path / "SVOX").mkdir()
    (tmp_path / "notes").mkdir()
    found = {entry.name: entry for entry in available(str(tmp_path))}
    assert found["miniature"].folder == tmp_path / "miniature" and "notes" not in found
    assert found["svox_night"].folder is None, "an empty folder is not a set"
    assert found["pitts30k"].folder is None and "pitts30k" in found["pitts30k"].expected
    touch(tmp_path / "SVOX" / "images" / "test" / "gallery", DATABASE)
    touch(tmp_path / "SVOX" / "images" / "test" / "queries_night", QUERIES)
    found = {entry.name: entry for entry in available(str(tmp_path))}
    assert found["svox_night"].folder == tmp_path / "SVOX" and found["svox_rain"].folder is None
    for entry in found.values():
        if entry.folder is not None:
            load_set(entry.name, config(tmp_path))


def test_a_set_is_consistent_or_not_built(tmp_path: Path) -> None:
    photo = [tmp_path / "a.jpg"]
    with pytest.raises(DataError, match="names row 4"):
        EvaluationSet("s", photo, photo, [np.array([4])], "pairs")
    with pytest.raises(DataError, match="1 queries but positives of 2"):
        EvaluationSet("s", photo, photo, [np.array([0])] * 2, "pairs")
    with pytest.raises(DataError, match="no database"):
        EvaluationSet("s", [], photo, [np.array([], np.int64)], "pairs")
    with pytest.raises(DataError, match="no jpg, jpeg or png"):
        list_images(tmp_path)


def test_a_missing_set_is_named_once_and_without_placeholders(tmp_path: Path) -> None:
    config = EvaluationConfig(root=str(tmp_path), split="val")
    for name in ("gardens_point", "pitts30k", "atlantis", "tokyo247"):
        with pytest.raises(DataError) as told:
            load_sets([name], config)
        assert str(told.value).startswith(name) and f"{name}: {name}" not in str(told.value)
        assert "{split}" not in str(told.value)
    with pytest.raises(DataError, match="images/val/"):
        load_sets(["pitts30k"], config)
