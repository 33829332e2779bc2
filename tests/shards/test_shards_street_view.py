"""The reader of a user's own places: sub-folders, and @utm names grouped by position and heading."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.common.errors import DataError, UsageError
from shards.sources.registry import SourceRule, detect, read_source


def put(root: Path, *paths: str, data: bytes = b"1") -> None:
    for path in paths:
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).write_bytes(data)


def utm(east: float, north: float, heading: str = "", zone: str = "56@J", pano: str = "p", ext: str = "jpg") -> str:
    return f"@{east:010.2f}@{north:010.2f}@{zone}@-27.5@153.0@{pano}@@{heading}@@@@20240517_1200@@.{ext}"


def test_a_sub_folder_is_a_place(tmp_path: Path) -> None:
    put(tmp_path, "cafe/1.jpg", "cafe/2.PNG", "Lisbon/cafe/a.jpeg", "Lisbon/cafe/deep/b.jpg")
    put(tmp_path, "cafe/notes.txt", ".cache/x.jpg", "cafe/._1.jpg", "__MACOSX/cafe/1.jpg")
    assert detect(tmp_path) == "folders"
    found = read_source(tmp_path)
    assert [(r["city"], r["place_id"], r["path"]) for r in found.table.to_pylist()] == [
        (".", "cafe", "cafe/1.jpg"),
        (".", "cafe", "cafe/2.PNG"),
        ("Lisbon", "cafe", "Lisbon/cafe/a.jpeg"),
        ("Lisbon/cafe", "deep", "Lisbon/cafe/deep/b.jpg"),
    ]
    assert found.table["lat"].null_count == 4


def test_linked_folders_are_entered_once(tmp_path: Path) -> None:
    put(tmp_path, "elsewhere/cafe/1.jpg", "mine/square/1.jpg")
    (tmp_path / "mine" / "linked").symlink_to(tmp_path / "elsewhere" / "cafe")
    (tmp_path / "mine" / "square" / "up").symlink_to(tmp_path / "mine")
    (tmp_path / "mine" / "zz").symlink_to(tmp_path / "elsewhere" / "cafe")
    assert read_source(tmp_path / "mine").table["path"].to_pylist() == ["linked/1.jpg", "square/1.jpg"]


def test_pictures_that_cannot_be_used_are_named(tmp_path: Path) -> None:
    put(tmp_path, "cafe/1.jpg", "loose.jpg", "cafe/2.heic")
    put(tmp_path, "cafe/0.jpg", data=b"")
    (tmp_path / "cafe" / "gone.jpg").symlink_to("nowhere.jpg")
    found = read_source(tmp_path)
    assert {(x.file, x.reason) for x in found.left_out} == {
        ("loose.jpg", "lies in no place's folder"),
        ("cafe/2.heic", "only JPEG and PNG are read"),
        ("cafe/0.jpg", "empty file (0 bytes)"),
        ("cafe/gone.jpg", "missing"),
    }
    assert found.images == 5


def test_utm_names_are_grouped_by_cell_heading_and_zone(tmp_path: Path) -> None:
    together = [utm(500001, 6900001, "10", pano="a"), "below/" + utm(500009.9, 6900009, "29.9", pano="b")]
    apart = [
        utm(500001, 6900001, "31"), utm(500010, 6900001, "10"), utm(499999.9, 6900001, "10"),
        utm(500001, 6900010, "10"), utm(500001, 6900001, "10", zone="55@J"), utm(500001, 6900001, ""),
    ]  # fmt: skip
    put(tmp_path, *together, *apart, "street.jpg")
    assert detect(tmp_path) == "utm"
    found = read_source(tmp_path)
    rows = {r["path"]: r for r in found.table.to_pylist()}
    key = {path: (r["city"], r["place_id"]) for path, r in rows.items()}
    assert key[together[0]] == key[together[1]]
    assert len({key[path] for path in [together[0], *apart]}) == 7
    assert [(x.file, x.reason[:11]) for x in found.left_out] == [("street.jpg", "no position")]
    told = rows[together[0]]
    assert (told["lat"], told["lon"], told["year"], told["month"], told["bearing"]) == (-27.5, 153.0, 2024, 5, 10.0)


def test_headings_and_cells_can_be_set(tmp_path: Path) -> None:
    put(tmp_path, utm(500001, 6900001, "10"), utm(500019, 6900001, "200"))
    assert read_source(tmp_path).listed.num_rows == 2
    assert read_source(tmp_path, SourceRule(cell_m=20, heading_deg=0)).listed.num_rows == 1
    with pytest.raises(UsageError, match="cell-m"):
        read_source(tmp_path, SourceRule(cell_m=0))


def test_the_layout_can_be_forced(tmp_path: Path) -> None:
    put(tmp_path, "corner/" + utm(500001, 6900001, "10"), "corner/" + utm(500101, 6900001, "10"))
    assert read_source(tmp_path).listed.num_rows == 2
    assert read_source(tmp_path, SourceRule(kind="folders")).listed.num_rows == 1
    with pytest.raises(UsageError, match="--cities"):
        read_source(tmp_path, SourceRule(cities=("PRS",)))


def test_an_empty_folder_is_told(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no photos"):
        read_source(tmp_path)
