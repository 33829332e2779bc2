"""The reader of Mapillary SLS on small folders in its exact layout."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from pipeline.common.errors import DataError, UsageError
from shards.sources.registry import SourceRule, detect, read_source

Photo = tuple[str, float, float, str, str, str, int]  # key, east, north, view, compass angle, sequence, frame


def write_table(path: Path, head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """As pandas wrote Mapillary's tables: an unnamed index first."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["", *head])
        writer.writerows([n, *row] for n, row in enumerate(rows))


def side(folder: Path, photos: Sequence[Photo], panoramas: Sequence[str] = ()) -> None:
    (folder / "images").mkdir(parents=True)
    for key, *_ in photos:
        (folder / "images" / f"{key}.jpg").write_bytes(b"1")
    write_table(
        folder / "postprocessed.csv",
        ["key", "easting", "northing", "unique_cluster", "control_panel", "night", "view_direction"],
        [(key, east, north, 5, False, False, view) for key, east, north, view, *_ in photos],
    )
    write_table(
        folder / "raw.csv", ["key", "lon", "lat", "ca", "captured_at", "pano"],
        [(key, 10.4, 63.4, ca, "2018-05-23", key in panoramas) for key, _, _, _, ca, *_ in photos],
    )  # fmt: skip
    write_table(
        folder / "seq_info.csv", ["key", "sequence_key", "frame_number"],
        [(key, sequence, frame) for key, *_, sequence, frame in reversed(photos)],
    )  # fmt: skip


def drive(name: str, north: float, heading: int, view: str = "Forward") -> list[Photo]:
    """Four photos 5 m apart, driven to the east (90) or west (270), their compass angles wrong."""
    east = [569_000.0 + 5 * i for i in range(4)]
    steps = enumerate(east if heading == 90 else east[::-1])
    return [(f"{name}-_{i}", at, north, view, "12.5", f"seq{name}", i) for i, at in steps]


@pytest.fixture
def msls(tmp_path: Path) -> Path:
    root = tmp_path / "msls"
    city = root / "train_val" / "trondheim"
    side(city / "database", [*drive("A", 7_000_003, 90), *drive("B", 7_000_004, 270)], panoramas=("B-_0",))
    behind = drive("C", 7_000_005, 270, "Backward")  # drives west, looks east
    still = ("still", 569_001.0, 7_000_001.0, "Forward", "95", "parked", 1)
    side(city / "query", [*behind, still, ("lost", 569_001.0, 7_000_001.0, "Sideways", "", "x", 1)])
    side(root / "train_val" / "cph" / "database", drive("V", 6_172_000, 90))
    (root / "train_val" / "oslo" / "query").mkdir(parents=True)
    (city / "query" / "images" / "unnamed.jpg").write_bytes(b"1")
    (city / "query" / "images" / "._A-_1.jpg").write_bytes(b"1")
    return root


def test_places_are_cells_and_directions_of_the_sequence(msls: Path) -> None:
    found = read_source(msls)
    assert (found.kind, found.images, found.unlisted) == ("msls", 13, 1) and not found.left_out
    place = {Path(row["path"]).stem: (row["city"], row["place_id"]) for row in found.table.to_pylist()}
    assert {place[f"{drive}-_{i}"] for drive in "AC" for i in range(4)} | {place["still"]} == {
        ("trondheim", "22760_280000_1")
    }
    assert {place[f"B-_{i}"] for i in (1, 2, 3)} == {("trondheim", "22760_280000_4")}
    assert place["lost"] == ("trondheim", "22760_280000")
    row = next(row for row in found.table.to_pylist() if row["path"].endswith("/A-_1.jpg"))
    assert row["path"] == "train_val/trondheim/database/images/A-_1.jpg"
    assert (row["lat"], row["lon"], row["year"], row["month"], row["bearing"]) == (63.4, 10.4, 2018, 5, 90.0)
    told = " / ".join(found.remarks)
    assert "no photos of oslo" in told
    assert "cph: the validation cities" in told and "1 panoramas" in told and "1 photos have no direction" in told


def test_cities_cells_and_directions_can_be_set(msls: Path) -> None:
    assert read_source(msls, SourceRule(cities=("cph",))).images == 4
    wide = read_source(msls / "train_val", SourceRule(cell_m=100, heading_deg=0))
    assert wide.listed.to_pylist() == [{"city": "trondheim", "place_id": "5690_70000", "images": 13}]
    with pytest.raises(UsageError, match=r"no rome in .*cph, oslo, trondheim"):
        read_source(msls, SourceRule(cities=("rome",)))


def test_a_part_of_the_layout_is_named(msls: Path, tmp_path: Path) -> None:
    assert detect(tmp_path) == "msls" and "read from" in read_source(tmp_path).remarks[0]
    with pytest.raises(UsageError, match=r"is one city .*--cities trondheim"):
        detect(msls / "train_val" / "trondheim")
    city = msls / "train_val" / "trondheim"
    with pytest.raises(UsageError, match=r"is a part of a city .* give the folder that holds the cities"):
        detect(city / "database")
    (city / "database" / "seq_info.csv").unlink()
    with pytest.raises(DataError, match=r"seq_info\.csv: missing; extract .*metadata\.zip"):
        read_source(msls)
    for table in msls.rglob("postprocessed.csv"):
        table.unlink()
    with pytest.raises(UsageError, match=r"no postprocessed\.csv; extract its metadata\.zip into"):
        read_source(msls)
    (msls / "train_val").rename(msls / "photos")
    for part, told in (("photos", r"no postprocessed\.csv"), ("photos/trondheim", "is a part of a city")):
        with pytest.raises(UsageError, match=told):
            read_source(msls / part)


@pytest.mark.parametrize(
    ("table", "before", "after", "told"),
    [
        ("postprocessed.csv", "569000.0", "here", r"postprocessed\.csv: row 1: easting is 'here'"),
        ("postprocessed.csv", "A-_0", "../../x", r"raw\.csv: no row with the key '\.\./\.\./x'"),
        ("raw.csv", "63.4", "nan", r"raw\.csv: row 1: lat is 'nan', not a number from -90 to 90"),
        ("seq_info.csv", "seqA,0", "seqA,first", r"seq_info\.csv: row 1: frame_number is 'first'"),
    ],
)
def test_a_wrong_value_is_named(table: str, before: str, after: str, told: str, msls: Path) -> None:
    path = msls / "train_val" / "trondheim" / "database" / table
    path.write_text(path.read_text().replace(before, after, 1))
    with pytest.raises(DataError, match=told):
        read_source(msls)
    if after.startswith(".."):
        for other in ("raw.csv", "seq_info.csv"):
            other_path = path.with_name(other)
            other_path.write_text(other_path.read_text().replace(before, after, 1))
        with pytest.raises(DataError, match=r"row 1: key is '\.\./\.\./x'"):
            read_source(msls)
