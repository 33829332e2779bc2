"""The reader of GSV-Cities against folders that hold each trap of the real one."""

from __future__ import annotations

import errno
import gzip
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.common.errors import DataError, UsageError
from shards.sources import gsv_cities
from shards.sources.registry import SourceRule, detect, read_source

HEADER = "place_id,year,month,northdeg,city_id,lat,lon,panoid\n"


def folder(root: Path, rows: list[str], files: dict[str, bytes], csv_name: str = "PRS.csv", city: str = "PRS") -> Path:
    (root / "Dataframes").mkdir(parents=True, exist_ok=True)
    (root / "Images" / city).mkdir(parents=True, exist_ok=True)
    text = (HEADER + "\n".join(rows) + "\n").encode()
    (root / "Dataframes" / csv_name).write_bytes(gzip.compress(text) if csv_name.endswith("gz") else text)
    for name, data in files.items():
        (root / "Images" / city / name).write_bytes(data)
    return root


@pytest.mark.parametrize(
    ("row", "file"),
    [
        (  # the example of the documentation: long digits, panoid with _ and -, .JPG
            "3,2015,5,584,PRS,48.79733778544615,2.231461206488333,7P0FnGV3k4Fmtw66b8_-Gg",
            "PRS_0000003_2015_05_584_48.79733778544615_2.231461206488333_7P0FnGV3k4Fmtw66b8_-Gg.JPG",
        ),
        ("812345,2015,12,7,PRS,48.0,2.5,_a_-", "PRS_0012345_2015_12_007_48.0_2.5__a_-.jpg"),  # place_id % 100000
        ("4,2015,5,-10,PRS,-48.5,-2.5,x", "PRS_0000004_2015_05_-10_-48.5_-2.5_x.jpg"),  # northdeg as written by :03d
        ("4,2015,5,-5,PRS,-48.5,-2.5,x", "PRS_0000004_2015_05_-05_-48.5_-2.5_x.jpg"),
        ("4,2015,5,731,PRS,40.000000,-3.700000,x", "PRS_0000004_2015_05_731_40.000000_-3.700000_x.jpeg"),
        ("4,2015,5,0,PRS,40.000000,-3.700000,x", "PRS_0000004_2015_05_000_40.0_-3.7_x.jpg"),  # saved with other digits
        ("4,2015.0,5.0,0.0,PRS,40.1,-3.7,NA", "PRS_0000004_2015_05_000_40.1_-3.7_NA.jpg"),  # saved by pandas with gaps
    ],
)
def test_a_row_finds_its_file(row: str, file: str, tmp_path: Path) -> None:
    root = folder(tmp_path, [row], {file: b"123"})
    found = gsv_cities.read(root).table.to_pylist()
    assert [(r["path"], r["size"]) for r in found] == [(f"Images/PRS/{file}", 3)]


def test_values_are_the_rows(tmp_path: Path) -> None:
    name = "PRS_0000003_2015_05_584_48.79733778544615_2.231461206488333_p.jpg"
    root = folder(tmp_path, ["100003,2015,5,584,PRS,48.79733778544615,2.231461206488333,p"], {name: b"1"})
    (row,) = gsv_cities.read(root).table.to_pylist()
    assert (row["city"], row["place_id"]) == ("PRS", "100003")
    assert (row["lat"], row["lon"], row["year"], row["month"]) == (48.79733778544615, 2.231461206488333, 2015, 5)
    assert row["bearing"] == 584 - 360


def test_missing_empty_duplicate_and_unnamed_files_are_counted(tmp_path: Path) -> None:
    rows = [f"1,2015,{month},0,PRS,48.5,2.5,p" for month in (1, 2, 3, 3, 4)]
    files = {f"PRS_0000001_2015_{month:02d}_000_48.5_2.5_p.jpg": b"1" * (month != 2) for month in (1, 2, 3)}
    root = folder(tmp_path, rows, {**files, "PRS_stray.jpg": b"1", "notes.txt": b"1", "._hidden.jpg": b"1"})
    found = gsv_cities.read(root)
    assert found.duplicates == 1 and found.unlisted == 1 and found.images == 4
    assert {(Path(x.file).name[17:19], x.reason) for x in found.left_out} == {
        ("02", "empty file (0 bytes)"),
        ("04", "missing"),
    }
    assert found.listed.to_pylist() == [{"city": "PRS", "place_id": "1", "images": 4}]


def test_the_catalogue_does_not_depend_on_the_order_of_rows_or_files(tmp_path: Path) -> None:
    rows = [f"{p},2015,{m},0,PRS,48.5,2.5,p{p}" for p in (1, 2, 10) for m in (1, 2)]
    files = {f"PRS_{p:07d}_2015_{m:02d}_000_48.5_2.5_p{p}.jpg": b"1" for p in (1, 2, 10) for m in (1, 2)}
    one = gsv_cities.read(folder(tmp_path / "a", rows, files))
    two = gsv_cities.read(folder(tmp_path / "b", rows[::-1], dict(reversed(files.items())), csv_name="Paris.csv.gz"))
    assert one.table.equals(two.table) and one.digest == two.digest
    files[next(iter(files))] = b"12"
    assert gsv_cities.read(folder(tmp_path / "c", rows, files)).digest != one.digest


def test_the_same_place_id_in_two_cities_is_two_places(tmp_path: Path) -> None:
    folder(tmp_path, ["1,2015,1,0,PRS,48.5,2.5,p"], {})
    root = folder(tmp_path, ["1,2015,1,0,OSL,48.5,2.5,p"], {}, "OSL.csv", "OSL")
    assert [(p["city"], p["place_id"]) for p in gsv_cities.read(root).listed.to_pylist()] == [
        ("OSL", "1"),
        ("PRS", "1"),
    ]


def test_cities_can_be_chosen(gsv: Callable[..., Path]) -> None:
    root = gsv({"PRS": [4, 2], "OSL": [5]})
    found = read_source(root, SourceRule(cities=("OSL",)))
    assert found.images == 5 and found.unlisted == 0
    with pytest.raises(UsageError, match=r"Oslo.*OSL, PRS"):
        read_source(root, SourceRule(cities=("Oslo",)))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("place_id,year\n1,2\n", "month"),
        ("", "PRS.csv"),
        (HEADER + "one,2015,1,0,PRS,48.5,2.5,p\n", "place_id"),
        (HEADER + "1,2015,1.5,0,PRS,48.5,2.5,p\n", "month"),
        (HEADER + "1,2015,1,0,PRS,48.5,2.5,p\n1,2015,1,0,PRS,north,2.5,p\n", r"PRS\.csv: row 2: lat is 'north', not a"),
        (HEADER + "1,2015,1,0,PRS,nan,2.5,p\n", "row 1: lat is 'nan', not a number from -90 to 90"),
        (HEADER + "1,2015,1,0,PRS,48.5,1e400,p\n", "row 1: lon is '1e400'"),
        (HEADER + "1,99999999999,1,0,PRS,48.5,2.5,p\n", "row 1: year is '99999999999'"),
        (HEADER + "1,2015,1,0,../..,48.5,2.5,p\n", r"row 1: city_id is '\.\./\.\.', not the plain name"),
        (HEADER + "1,2015,1,0,/etc,48.5,2.5,p\n", "row 1: city_id is '/etc'"),
        (HEADER + "1,2015,1,0,a\x1bb,48.5,2.5,p\n", r"row 1: city_id is 'a\\x1bb'"),
        (HEADER + "1,2015,1,0,PRS\n", "Expected 8 columns, got 5"),
        (HEADER.replace("lat", "place_id"), "no column lat"),
        (HEADER.replace("\n", ",lat\n") + "1,2015,1,0,PRS,48.5,2.5,p,1\n", "two columns are called lat"),
        (HEADER.replace(",", ";") + "1;2015;1;0;PRS;48,5;2,5;p\n", "row 1: lat is '48,5'"),
    ],
)
def test_a_malformed_frame_is_named(text: str, message: str, tmp_path: Path) -> None:
    root = folder(tmp_path, [], {})
    (root / "Dataframes" / "PRS.csv").write_text(text)
    with pytest.raises(DataError, match=message) as caught:
        gsv_cities.read(root)
    assert "PRS.csv" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("how", ["bom", "crlf", "semicolons", "quotes", "tabs", "spaces", "long"])
def test_a_frame_saved_by_another_program_is_read(how: str, tmp_path: Path) -> None:
    text = HEADER + "1,2015,1,0,PRS,48.50,2.5,p_é\n"
    text = {
        "bom": "\ufeff" + text, "crlf": text.replace("\n", "\r\n"), "semicolons": text.replace(",", ";"),
        "quotes": '"' + text.replace(",", '","').replace("\n", '"\n"', 1).replace("é\n", 'é"\n'),
        "tabs": text.replace(",", "\t"), "spaces": text.replace(",", ", "),
        "long": text.replace("panoid", "panoid,note").replace("é\n", "é," + "x" * 3_000_000 + "\n"),
    }[how]  # fmt: skip
    root = folder(tmp_path, [], {"PRS_0000001_2015_01_000_48.50_2.5_p_é.jpg": b"1"})
    (root / "Dataframes" / "PRS.csv").write_bytes(text.encode())
    assert gsv_cities.read(root).table["size"].to_pylist() == [1]


def test_other_encodings_and_damaged_archives_are_named(tmp_path: Path) -> None:
    text = (HEADER + "1,2015,1,0,PRS,48.5,2.5,é\n").encode("utf-16")
    packed = gzip.compress(HEADER.encode())
    root = folder(tmp_path, [], {})
    (root / "Dataframes" / "PRS.csv").unlink()
    bad = {"a.csv": text, "b.csv": text.decode("utf-16").encode("latin-1"), "c.csv.gz": packed[:-9], "d.csv.gz": b"csv"}
    for name, data in bad.items():
        (root / "Dataframes" / name).write_bytes(data)
        with pytest.raises(DataError, match=rf"{name}: ") as caught:
            gsv_cities.read(root)
        assert str(caught.value).isprintable()
        (root / "Dataframes" / name).unlink()


@pytest.mark.parametrize("where", [".", "one/level/up", "lower"])
def test_the_layout_is_found_in_any_case_and_one_level_down(where: str, gsv: Callable[..., Path]) -> None:
    """A copy made on a Mac has `._PRS.csv` beside `PRS.csv`, and so on in every folder."""
    root = gsv({"PRS": [4]})
    (root / "Dataframes" / "._PRS.csv").write_bytes(b"\0\5\x16\7Mac OS X")
    (root / "Images" / "PRS" / "._x.jpg").write_bytes(b"1")
    (root / "Images" / ".DS_Store").write_bytes(b"1")
    (root / "__MACOSX" / "Images").mkdir(parents=True)
    if where == "lower":
        for name in ("Images", "Dataframes"):
            (root / name).rename(root / name.lower())
    found = read_source(root.parent if where == "one/level/up" else root)
    assert (found.kind, found.images, found.unlisted, len(found.left_out)) == ("gsv_cities", 4, 0, 0)
    assert bool(found.remarks) == (where == "one/level/up")


def test_parts_of_the_layout_are_refused_by_name(gsv: Callable[..., Path], tmp_path: Path) -> None:
    root = gsv({"PRS": [4], "OSL": [4]})
    for part in ("Images", "Dataframes"):
        with pytest.raises(UsageError, match=rf"is GSV-Cities' {part}/ alone; give .*source"):
            detect(root / part)
    with pytest.raises(UsageError, match="named as GSV-Cities'"):
        detect(root / "Images" / "PRS")
    (root / "Images").rename(tmp_path / "photos")
    with pytest.raises(UsageError, match=r"named as GSV-Cities', but there is no Dataframes/"):
        detect(tmp_path / "photos")
    assert read_source(tmp_path / "photos", SourceRule(kind="folders")).listed.num_rows == 2
    other = gsv({"PRS": [4]}, "another")
    (root / "Dataframes").rename(other / "dataframes2")
    gsv({"PRS": [4]}, "third")
    with pytest.raises(UsageError, match=r"several data sets \(another, third\)"):
        detect(tmp_path)


def test_a_citys_folder_that_may_not_be_read_is_named(
    gsv: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The tests may run as root, whom no permission stops: the system's answer is made."""
    root, scan = gsv({"PRS": [4], "OSL": [4]}), os.scandir

    def no_scan(path: object) -> object:
        if str(path).endswith("OSL"):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return scan(path)  # type: ignore[call-overload]

    monkeypatch.setattr(os, "scandir", no_scan)
    found = gsv_cities.read(root)
    assert found.table.num_rows == 4 and found.images == 8
    assert {(x.city, x.reason) for x in found.left_out} == {("OSL", "cannot be read")}


def test_half_a_layout_is_refused(tmp_path: Path) -> None:
    (tmp_path / "Dataframes").mkdir()
    with pytest.raises(UsageError, match="no Images/"):
        detect(tmp_path)
    (tmp_path / "Images").mkdir()
    with pytest.raises(DataError, match=r"no \.csv"):
        read_source(tmp_path)
    with pytest.raises(UsageError, match="no such folder"):
        read_source(tmp_path / "nowhere")


def test_real_photos_are_all_found(shared_dir: Path) -> None:
    root = shared_dir / "data" / "ie_tower_gsv"
    if not root.is_dir():
        pytest.skip("no real photos beside this checkout")
    found = read_source(root)
    assert (found.kind, found.images, found.listed.num_rows, found.unlisted) == ("gsv_cities", 2016, 336, 0)
    assert not found.left_out
