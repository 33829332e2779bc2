"""MSLS-val is the 740 protocol in either layout; MSLS-challenge stays within each city, is exported and scored."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from pipeline.common.errors import DataError
from pipeline.config import EvaluationConfig
from pipeline.evaluation.recall import recall_at
from pipeline.evaluation.sets.load import load_set
from pipeline.evaluation.sets.msls import export_predictions, read_predictions

CITIES = {"cph": (347_000.0, 6_172_000.0), "sf": (551_000.0, 4_180_000.0)}


def write_csv(path: Path, rows: list[dict]) -> None:
    """As pandas wrote Mapillary's tables: an unnamed index first."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, ["", *rows[0]])
        writer.writeheader()
        writer.writerows({"": at, **row} for at, row in enumerate(rows))


def write_side(folder: Path, photos: list[tuple[str, float, float, bool, bool]]) -> None:
    """photos: (key, east, north, in subtask all, panorama)."""
    for key, *_ in photos:
        (folder / "images").mkdir(parents=True, exist_ok=True)
        (folder / "images" / f"{key}.jpg").touch()
    write_csv(folder / "postprocessed.csv", [
        {"key": k, "easting": e, "northing": n, "night": False, "control_panel": False, "view_direction": "Forward"}
        for k, e, n, _, _ in photos
    ])  # fmt: skip
    write_csv(folder / "raw.csv", [
        {"key": k, "lon": 12.5, "lat": 55.6, "ca": 90.0, "captured_at": "2018-05-01", "pano": p} for k, *_, p in photos
    ])  # fmt: skip
    write_csv(folder / "subtask_index.csv", [{"key": k, "all": a, "s2w": False} for k, _, _, a, _ in photos])
    write_csv(folder / "seq_info.csv", [{"key": k, "sequence_key": "s", "frame_number": 1} for k, *_ in photos])


def original(root: Path) -> Path:
    folder = root / "msls"
    for city, (east, north) in CITIES.items():
        base = folder / "train_val" / city
        write_side(base / "database", [
            (f"{city}_d2", east + 100, north, True, False),
            (f"{city}_d1", east, north, True, False),
            (f"{city}_pano", east, north + 1, True, True),
        ])  # fmt: skip
        write_side(base / "query", [
            (f"{city}_far", east + 60, north, True, False),
            (f"{city}_q", east, north + 25, True, False),
            (f"{city}_other", east, north, False, False),
            (f"{city}_qpano", east, north, True, True),
        ])  # fmt: skip
    return folder


def test_original_layout_gives_the_official_queries(tmp_path: Path) -> None:
    original(tmp_path)
    loaded = load_set("msls_val", EvaluationConfig(root=str(tmp_path)))
    assert [p.stem for p in loaded.queries] == ["cph_q", "sf_q"], "subtask all, no panorama, with a positive"
    assert [p.stem for p in loaded.database] == ["cph_d1", "cph_d2", "sf_d1", "sf_d2"], (
        "ordered by position, as @utm names"
    )
    assert [p.tolist() for p in loaded.positives] == [[0], [2]] and loaded.rule == "25 m"
    assert any("2 official queries have no positive" in remark for remark in loaded.remarks)
    assert any("published are 18,871 and 740" in remark for remark in loaded.remarks)
    assert load_set(str(tmp_path / "msls"), EvaluationConfig()).name == "msls_val"
    narrow = load_set("MSLS-val", EvaluationConfig(root=str(tmp_path), radius=10.0))
    assert (len(narrow.queries), narrow.without_positives) == (2, 2), "another radius leaves the official queries alone"


def utm_layout(folder: Path, split: str = "val") -> None:
    base = folder / "images" / split
    for side in ("database", "queries"):
        (base / side).mkdir(parents=True)
    for city, (east, north) in CITIES.items():
        for key, de, dn in ((f"{city}_d1", 0, 0), (f"{city}_d2", 100, 0)):
            (base / "database" / f"@{east + de:010.2f}@{north + dn:010.2f}@33@U@@@{key}@@@@@@20180501@day@.jpg").touch()
        for key, de, dn in ((f"{city}_q", 0, 25), (f"{city}_other", 0, 0), (f"{city}_far", 60, 0)):
            (base / "queries" / f"@{east + de:010.2f}@{north + dn:010.2f}@33@U@@@{key}@@@@@@20180501@day@.jpg").touch()


def test_a_folder_with_other_queries_is_told_apart(tmp_path: Path) -> None:
    utm_layout(tmp_path / "msls_val")
    everything = load_set(str(tmp_path / "msls_val"), EvaluationConfig(split="val"))
    assert len(everything.queries) == 6 and everything.remarks == (
        "4 database images and 6 queries here, published are 18,871 and 740",
    )


@pytest.mark.parametrize("listed", ["npy", "txt", "csv"])
@pytest.mark.parametrize("split", ["val", "test"])
def test_utm_layout_is_restricted_to_the_official_queries(tmp_path: Path, listed: str, split: str) -> None:
    folder = tmp_path / "msls"
    utm_layout(folder, split)
    with pytest.raises(
        DataError, match="file names do not tell the 740 official queries from the others; put msls_val_qImages"
    ):
        load_set("msls_val", EvaluationConfig(root=str(tmp_path)))
    names = [f"train_val/{city}/query/images/{city}_{which}.jpg" for city in CITIES for which in ("q", "far")]
    if listed == "npy":
        np.save(folder / "msls_val_qImages.npy", np.array(names))
    elif listed == "txt":
        (folder / "msls_val_queries.txt").write_text("\n".join(names) + "\n")
    else:
        for city in CITIES:
            write_csv(folder / "train_val" / city / "query" / "subtask_index.csv", [
                {"key": f"{city}_{which}", "all": which != "other"} for which in ("q", "far", "other")
            ])  # fmt: skip
    loaded = load_set("msls_val", EvaluationConfig(root=str(tmp_path)))
    assert [p.name.split("@")[7] for p in loaded.queries] == ["cph_q", "sf_q"]
    assert [p.tolist() for p in loaded.positives] == [[0], [2]] and len(loaded.database) == 4
    assert any("4 of 6 queries are in the official list" in remark for remark in loaded.remarks)


def test_tables_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    folder = original(tmp_path)
    write_csv(folder / "train_val" / "sf" / "query" / "raw.csv", [{"key": "sf_q", "pano": False}])
    with pytest.raises(DataError, match="differ in length"):
        load_set("msls_val", EvaluationConfig(root=str(tmp_path)))
    original(tmp_path)
    (folder / "train_val" / "cph" / "database" / "images" / "cph_d1.jpg").unlink()
    with pytest.raises(DataError, match=r"1 of 4 photos are not on disk, the first is .*cph_d1\.jpg"):
        load_set("msls_val", EvaluationConfig(root=str(tmp_path)))


def challenge(root: Path, truth: str | None) -> Path:
    """Two cities whose positions coincide, so that leaving the city would look right."""
    folder = root / "msls"
    for city in ("athens", "miami"):
        for side, keys in (("database", ("d1", "d2", "d3")), ("query", ("q1", "q2"))):
            base = folder / "test" / city / side
            (base / "images").mkdir(parents=True)
            for key in keys:
                (base / "images" / f"{city}_{key}.jpg").touch()
            write_csv(base / "subtask_index.csv", [{"key": f"{city}_{k}", "all": k != "d3"} for k in keys])
            if truth is not None:
                east = {"d1": 0.0, "d2": 500.0, "d3": 0.0, "q1": 10.0, "q2": 490.0}
                rows = [{"key": f"{city}_{k}", "easting": east[k], "northing": 4e6} for k in reversed(keys)]
                write_csv(folder / truth / city / side / "postprocessed.csv", rows)
    return folder


@pytest.mark.parametrize("truth", ["test", "test_meta"])
def test_challenge_is_scored_within_each_city(tmp_path: Path, truth: str) -> None:
    challenge(tmp_path, truth)
    loaded = load_set("msls_challenge", EvaluationConfig(root=str(tmp_path)))
    assert [p.stem for p in loaded.database] == ["miami_d1", "miami_d2", "athens_d1", "athens_d2"]
    assert [p.tolist() for p in loaded.positives] == [[0], [1], [2], [3]], "never the other city's"
    assert loaded.database_part is not None and loaded.database_part.tolist() == [0, 0, 1, 1]
    assert loaded.query_part is not None and loaded.query_part.tolist() == [0, 0, 1, 1]
    assert loaded.has_ground_truth and loaded.rule == "25 m within the city"
    assert "without stockholm, which is not on disk" in loaded.remarks


def test_challenge_without_ground_truth_can_still_be_exported(tmp_path: Path) -> None:
    challenge(tmp_path, None)
    loaded = load_set("msls_challenge", EvaluationConfig(root=str(tmp_path)))
    assert not loaded.has_ground_truth and loaded.without_positives == 4
    assert any("exported, not scored" in remark for remark in loaded.remarks)
    predictions = np.array([[1, 0], [0, -1], [3, 2], [2, 3]])
    export_predictions(loaded, predictions, tmp_path / "out" / "predictions.txt")
    assert (tmp_path / "out" / "predictions.txt").read_text().splitlines() == [
        "miami_q1 miami_d2 miami_d1",
        "miami_q2 miami_d1",
        "athens_q1 athens_d2 athens_d1",
        "athens_q2 athens_d1 athens_d2",
    ]
    with pytest.raises(DataError, match=r"athens_q1\.jpg lie in another city"):
        export_predictions(loaded, np.array([[1, 0], [0, -1], [0, 2], [2, 3]]), tmp_path / "stray.txt")
    assert not (tmp_path / "stray.txt").exists()


def test_a_prediction_file_is_scored_as_it_was_written(tmp_path: Path) -> None:
    challenge(tmp_path, "test_meta")
    loaded = load_set("msls_challenge", EvaluationConfig(root=str(tmp_path)))
    predictions = np.array([[1, 0], [1, -1], [3, 2], [2, -1]])
    path = tmp_path / "predictions.txt"
    export_predictions(loaded, predictions, path)
    path.write_text("# a comment, and a query of somebody else's\nsf_q sf_d1 sf_d2\n" + path.read_text())
    again = read_predictions(loaded, path)
    assert np.array_equal(again, predictions)
    assert recall_at(again, loaded.positives, [1, 2]) == {1: 25.0, 2: 75.0}
    path.write_text("miami_q1 miami_d9\n")
    with pytest.raises(DataError, match="no line for query miami_q2, nor for 2 others"):
        read_predictions(loaded, path)
    path.write_text("".join(f"{city}_q{i} sf_d1\n" for city in ("miami", "athens") for i in (1, 2)))
    with pytest.raises(DataError, match="'sf_d1', predicted for miami_q1, is no database image"):
        read_predictions(loaded, path)


def test_keys_of_utm_names_are_exported_too(tmp_path: Path) -> None:
    utm_layout(tmp_path / "msls")
    (tmp_path / "msls" / "msls_val_queries.txt").write_text("cph_q\nsf_q\n")
    loaded = load_set("msls_val", EvaluationConfig(root=str(tmp_path)))
    export_predictions(loaded, np.array([[0], [2]]), tmp_path / "p.txt")
    assert (tmp_path / "p.txt").read_text() == "cph_q cph_d1\nsf_q sf_d1\n"


def test_a_city_without_a_position_is_named(tmp_path: Path) -> None:
    folder = challenge(tmp_path, "test")
    write_csv(folder / "test/miami/query/postprocessed.csv", [{"key": "miami_q1", "easting": 0, "northing": 0}])
    with pytest.raises(DataError, match=r"no position for miami_q2\.jpg"):
        load_set("msls_challenge", EvaluationConfig(root=str(tmp_path)))
