"""The reader of a user's own places: sub-folders, and @utm names grouped by position and heading."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from pipeline.common.errors import DataError, UsageError
from shards.catalogue import LeftOut
from shards.report import report_bytes
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
    with (tmp_path / "cafe" / "sparse.jpg").open("wb") as stream:
        stream.truncate(1 << 40)  # a hole: no room on the disk
    found = read_source(tmp_path)
    assert {(x.file, x.reason) for x in found.left_out} == {
        ("loose.jpg", "lies in no place's folder"),
        ("cafe/2.heic", "only JPEG and PNG are read"),
        ("cafe/0.jpg", "empty file (0 bytes)"),
        ("cafe/gone.jpg", "missing"),
        ("cafe/sparse.jpg", "too large: 1,099,511,627,776 bytes, the limit is 1,073,741,824"),
    }
    assert found.images == 6


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


def test_a_heading_just_below_zero_is_in_the_first_sector(tmp_path: Path) -> None:
    put(tmp_path, utm(500001, 6900001, "-1e-20"), utm(500001, 6900001, "360"), utm(500001, 6900001, "0"))
    assert [p["images"] for p in read_source(tmp_path).listed.to_pylist()] == [3]


def test_headings_and_cells_can_be_set(tmp_path: Path) -> None:
    put(tmp_path, utm(500001, 6900001, "10"), utm(500019, 6900001, "200"))
    assert read_source(tmp_path).listed.num_rows == 2
    assert read_source(tmp_path, SourceRule(cell_m=20, heading_deg=0)).listed.num_rows == 1
    with pytest.raises(UsageError, match="cell_m"):
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


def test_pittsburghs_views_are_told_apart_by_the_yaw_in_their_note(tmp_path: Path) -> None:
    """24 views around one spot: two pitches of twelve directions, the heading field empty."""
    names = [
        f"@0585001.00@4477001.00@17@T@040.44110@-079.99810@000829@{24 * p + y:02d}@@@@@@pitch{p}_yaw{y}@.jpg"
        for p in (1, 2)
        for y in range(1, 13)
    ]
    put(tmp_path, *names, "@0585001.00@4477001.00@17@T@040.4@-080.0@000829@@@@@@@@.jpg")
    found = read_source(tmp_path)
    assert [p["images"] for p in found.listed.to_pylist()] == [1] + [2] * 12
    assert {row["bearing"] for row in found.table.to_pylist()} == {None, *(30.0 * y for y in range(12))}
    (told,) = found.remarks
    assert "25 of 25 photos have no heading" in told and "24 are put by the yaw" in told and "1 into one place" in told


def test_sf_xls_names_are_read_with_their_heading_and_month(tmp_path: Path) -> None:
    """As published: latitude folders, heading in degrees without zeros, year and month together."""
    stem = "@054325{}.96@4178906.70@10@S@037.75645@-122.50893@L-2IR8dif5bpYQIeb5o7oQ@@{}@@@@201502@@.jpg"
    put(tmp_path, *("train/37.75/" + stem.format(i, h) for i, h in ((1, 0), (2, 29), (3, 30), (4, 359))))
    found = read_source(tmp_path / "train")
    places = {row["bearing"]: row["place_id"] for row in found.table.to_pylist()}
    assert places == {0: "54325_417890_0", 29: "54325_417890_0", 30: "54325_417890_1", 359: "54325_417890_11"}
    row = found.table.to_pylist()[0]
    assert (row["city"], row["lat"], row["lon"], row["year"], row["month"]) == ("10S", 37.75645, -122.50893, 2015, 2)
    assert not found.remarks


def test_degrees_in_the_place_of_metres_are_refused(tmp_path: Path) -> None:
    put(tmp_path, *(f"@-122.5089{i}@37.75645@10@S@37.7@-122.5@p@@{i}@@@@@@.jpg" for i in range(4)))
    with pytest.raises(
        DataError, match=r"degrees where UTM metres are expected, such as @-122\.509@37\.7565@ in @-122"
    ):
        read_source(tmp_path)


def test_a_name_without_degrees_gets_them_from_its_metres(tmp_path: Path) -> None:
    names = ["@0448252.00@5411943.00@31@U@@@eiffel@@@@@@@@.jpg", "@0334368.00@6250948.00@56@H@@@opera@@@@@@@@.jpg"]
    put(tmp_path, *names, "@0448252.00@5411943.00@@@@@nowhere@@@@@@@@.jpg")
    found = {row["path"].split("@")[7]: (row["lat"], row["lon"]) for row in read_source(tmp_path).table.to_pylist()}
    assert found["nowhere"] == (None, None)
    assert found["eiffel"] == pytest.approx((48.85837, 2.29448), abs=1e-4)
    assert found["opera"] == pytest.approx((-33.8654, 151.2096), abs=1e-2)  # the southern hemisphere


def test_the_splits_of_an_evaluation_set_are_not_put_together(tmp_path: Path) -> None:
    for split in ("train", "val", "test"):
        put(tmp_path, f"images/{split}/database/" + utm(500001, 6900001, "10"))
    with pytest.raises(UsageError, match=r"holds train, val, test .* give one of them, such as .*/images/train"):
        read_source(tmp_path)
    assert read_source(tmp_path / "images" / "train").images == 1


def test_debris_is_passed_over_and_odd_names_are_named(tmp_path: Path) -> None:
    put(tmp_path, *(f"cafe/{n}.jpg" for n in range(4)), "cafe/._1.jpg", "cafe/.DS_Store", "cafe/Thumbs.db")
    put(tmp_path, "__MACOSX/cafe/1.jpg", "cafe/@eaDir/1.jpg", "line\nfeed/=1+1.jpg")
    bad = os.fsencode(tmp_path / "cafe") + b"/\xff.jpg"
    Path(os.fsdecode(bad)).write_bytes(b"1")
    found = read_source(tmp_path)
    assert found.images == 6
    assert [tuple(x) for x in found.left_out] == [(r"cafe/\udcff.jpg", "", "", "its name is not UTF-8")]
    told = report_bytes([*found.left_out, LeftOut("=cmd|x.jpg", "a\nb", "\x1b[31m", "broken")]).decode().splitlines()
    assert told[1] == r"./=cmd|x.jpg,a\nb,\x1b[31m,broken" and len(told) == 3


def test_a_folder_that_may_not_be_read_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests may run as root, whom no permission stops: the system's answer is made."""
    put(tmp_path, "Lisbon/cafe/1.jpg", "Lisbon/square/1.jpg", "Lisbon/square/2.jpg")
    scan, stat = os.scandir, os.stat

    def no_scan(path: str) -> object:
        if str(path).endswith("cafe"):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return scan(path)

    def no_stat(path: object, **options: object) -> object:
        if str(path).endswith("square/2.jpg"):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return stat(path, **options)  # type: ignore[call-overload]

    monkeypatch.setattr(os, "scandir", no_scan)
    monkeypatch.setattr(os, "stat", no_stat)
    found = read_source(tmp_path, SourceRule(kind="folders"))
    assert found.images == 3 and found.table.num_rows == 1
    assert [tuple(x) for x in found.left_out] == [
        ("Lisbon/cafe/", "Lisbon", "cafe", "cannot be read: Permission denied"),
        ("Lisbon/square/2.jpg", "Lisbon", "square", "cannot be read"),
    ]
