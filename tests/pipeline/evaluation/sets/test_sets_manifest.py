"""A manifest in CSV or Parquet: four ways to say what is correct, and a row named in every complaint."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from pipeline.common.errors import DataError
from pipeline.config import EvaluationConfig
from pipeline.evaluation.sets.evaluation_set import EvaluationSet
from pipeline.evaluation.sets.load import load_set

PHOTOS = ["d/z.jpg", "d/a.png", "d/m.jpg", "q/1.jpg", "q/2.jpg"]
ROLES = ["database", "database", "database", "query", "query"]


def manifest(folder: Path, suffix: str, **columns: list) -> Path:
    for photo in PHOTOS:
        (folder / photo).parent.mkdir(exist_ok=True)
        (folder / photo).touch()
    table = {"image": PHOTOS, "role": ROLES} | columns
    path = folder / f"my walk{suffix}"
    if suffix == ".parquet":
        import pyarrow as pa
        from pyarrow import parquet

        parquet.write_table(pa.table(table), path)
    else:
        with path.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(table)
            writer.writerows(zip(*table.values(), strict=True))
    return path


def load(path: Path, **fields: object) -> EvaluationSet:
    return load_set(str(path), EvaluationConfig(**fields))  # type: ignore[arg-type]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_positions_in_metres(tmp_path: Path, suffix: str) -> None:
    loaded = load(manifest(tmp_path, suffix, utm_east=[0.0, 30, 60, 5, 300], utm_north=[0.0, 0, 0, 0, 0]))
    assert [p.name for p in loaded.database] == ["z.jpg", "a.png", "m.jpg"], "the order of the rows"
    assert [p.tolist() for p in loaded.positives] == [[0, 1], []]
    assert (loaded.name, loaded.rule, loaded.without_positives) == ("my_walk", "25 m", 1)
    assert loaded.query_positions is not None and loaded.query_positions.tolist() == [[5, 0], [300, 0]]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_positions_in_degrees(tmp_path: Path, suffix: str) -> None:
    step = 1 / 111_132  # about a metre northward
    lat = [45.0, 45 + 30 * step, 45 + 60 * step, 45 + 5 * step, 46.0]
    loaded = load(manifest(tmp_path, suffix, lat=lat, lon=[12.0001, 11.9999, 12.0001, 12.0, 12.0]))
    assert [p.tolist() for p in loaded.positives] == [[0], []], (
        "7.9 m west over a zone border; 25 m north and 7.9 m east is out"
    )
    assert [p.tolist() for p in load(tmp_path / f"my walk{suffix}", radius=27.0).positives] == [[0, 1], []]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_frames(tmp_path: Path, suffix: str) -> None:
    path = manifest(tmp_path, suffix, frame=[30, 10, 20, 10, 25])
    assert [p.tolist() for p in load(path).positives] == [[1], []]
    loaded = load(path, frames=5)
    assert ([p.tolist() for p in loaded.positives], loaded.rule) == ([[1], [0, 2]], "+-5 frames")


def test_positives_by_name(tmp_path: Path) -> None:
    in_csv = load(manifest(tmp_path, ".csv", positives=["", "", "", "d/m.jpg; d/z.jpg", ""]))
    in_parquet = load(manifest(tmp_path, ".parquet", positives=[None, None, None, ["d/m.jpg", "d/z.jpg"], []]))
    for loaded in (in_csv, in_parquet):
        assert [p.tolist() for p in loaded.positives] == [[0, 2], []] and loaded.rule == "listed positives"


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({}, "needs positives, frame, utm_east and utm_north, or lat and lon"),
        ({"role": ["database", "database", "db", "query", "query"], "frame": [0] * 5}, "row 3: role is 'db'"),
        ({"utm_east": [0, 0, "", 0, 0], "utm_north": [0] * 5}, "row 3: utm_east is '', not a number"),
        ({"lat": [0, 0, 91, 0, 0], "lon": [0] * 5}, "row 3: latitude 91.0"),
        ({"frame": [0, 0, 1.5, 0, 0]}, "'frame' holds 1.5, not a whole number"),
        ({"positives": ["", "", "", "d/q.jpg", ""]}, "'d/q.jpg' of query 'q/1.jpg' is no database image"),
        ({"role": ["database"] * 5, "frame": [0] * 5}, "the set has no queries"),
    ],
)
def test_complaints_name_the_row(tmp_path: Path, columns: dict[str, list], words: str) -> None:
    with pytest.raises(DataError, match=words):
        load(manifest(tmp_path, ".csv", **columns))


def test_missing_photos_columns_and_files(tmp_path: Path) -> None:
    path = manifest(tmp_path, ".csv", frame=[0] * 5)
    (tmp_path / "d" / "a.png").unlink()
    with pytest.raises(DataError, match=r"1 of 3 photos are not on disk, the first is .*a\.png"):
        load(path)
    (tmp_path / "bare.csv").write_text("photo\na.jpg\n")
    with pytest.raises(DataError, match="no column 'image'; it has photo"):
        load(tmp_path / "bare.csv")
    (tmp_path / "empty.csv").write_text("")
    with pytest.raises(DataError, match="no rows"):
        load(tmp_path / "empty.csv")
    (tmp_path / "broken.parquet").write_bytes(b"not parquet")
    with pytest.raises(DataError, match=r"not a readable \.parquet table"):
        load(tmp_path / "broken.parquet")


def test_degrees_in_columns_of_metres_are_refused(tmp_path: Path) -> None:
    path = manifest(tmp_path, ".csv", utm_east=[2.35, 2.36, 2.37, 2.35, 2.36], utm_north=[48.85] * 5)
    with pytest.raises(DataError, match=r"utm_east and utm_north hold degrees \(2\.35, 48\.85 in row 1\)"):
        load(path)
