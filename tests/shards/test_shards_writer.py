"""A written shard set against its source: read back by webdataset, by offsets, and by counting."""

from __future__ import annotations

import csv
import io
import json
import multiprocessing
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import webdataset

from pipeline.common.errors import DataError, UsageError
from shards import groups, index, schema
from shards.images import ImageRule
from shards.report import Summary
from shards.sources.registry import read_source
from shards.writer import WriteRule, check_writable, remove_shards, write_shards

Gsv = Callable[..., Path]
CITIES = {"PRS": [4, 5, 3, 37, 2, 8], "OSL": [6, 4, 1, 9]}
SMALL = 0.02  # MB of a shard: several groups


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def samples(out: Path) -> Iterator[dict[str, Any]]:
    """All samples as webdataset's own reader sees them."""
    urls = [str(path) for path in sorted(out.glob("*.tar"))]
    yield from webdataset.WebDataset(urls, shardshuffle=False, empty_check=False)


@pytest.fixture
def written(gsv: Gsv, tmp_path: Path) -> tuple[Path, Path, Summary]:
    source, out = gsv(CITIES), tmp_path / "out"
    return source, out, write_shards(read_source(source), out, WriteRule(rounds=3, workers=1, shard_mb=SMALL))


def test_webdataset_reads_the_source_bytes(written: tuple[Path, Path, Summary]) -> None:
    source, out, _ = written
    seen: Counter[str] = Counter()
    places: list[tuple[int, str, str]] = []
    for sample in samples(out):
        told = json.loads(sample["json"])
        names = [image["source"] for image in told["images"]]
        assert len(set(names)) == 4
        for k, name in enumerate(names):
            assert sample[f"{k}.jpg"] == (source / name).read_bytes()
            assert Path(name).name.startswith(f"{told['city']}_{int(told['place_id']) % 100_000:07d}_")
        seen.update(names)
        places.append((told["round"], told["city"], told["place_id"]))
    assert len(places) == len(set(places)) == 3 * 7  # no round holds a place twice; seven places have four images
    with_four = {(city, str(p * 100_001 + 7)): n for city, ns in CITIES.items() for p, n in enumerate(ns) if n >= 4}
    shown = Counter((name.split("/")[1], str(_place(name))) for name in seen)
    assert shown == Counter({key: min(n, 12) for key, n in with_four.items()})


def _place(name: str) -> int:
    within = int(Path(name).name.split("_")[1])
    return next(p for p in (i * 100_001 + 7 for i in range(10)) if p % 100_000 == within)


def test_values_of_a_photo_are_its_rows(written: tuple[Path, Path, Summary]) -> None:
    source, out, _ = written
    rows = {}
    for frame in (source / "Dataframes").iterdir():
        with frame.open() as stream:
            rows.update({row["panoid"]: row for row in csv.DictReader(stream)})
    for sample in samples(out):
        told = json.loads(sample["json"])
        for image in told["images"]:
            row = next(row for pano, row in rows.items() if Path(image["source"]).stem.endswith(f"_{pano}"))
            assert (told["city"], told["place_id"]) == (row["city_id"], row["place_id"])
            assert (image["lat"], image["lon"]) == (float(row["lat"]), float(row["lon"]))
            assert (image["year"], image["month"]) == (int(row["year"]), int(row["month"]))
            assert image["bearing"] == int(row["northdeg"]) % 360


def test_the_index_points_at_the_bytes(written: tuple[Path, Path, Summary]) -> None:
    source, out, _ = written
    opened = index.read_index(str(out))
    table = opened.table
    assert table.schema.equals(schema.SCHEMA)
    tars = {path.name: path.read_bytes() for path in out.glob("*.tar")}
    by_key = {sample["__key__"]: sample for sample in samples(out)}
    assert len(by_key) == table.num_rows == len(set(table["sample"].to_pylist()))
    for row in table.to_pylist():
        data = tars[row["shard"]]
        told = json.loads(data[row["json_offset"] : row["json_offset"] + row["json_size"]])
        assert (told["city"], told["place_id"], told["round"]) == (row["city"], row["place_id"], row["round"])
        for k, (offset, size) in enumerate(zip(row["offsets"], row["sizes"], strict=True)):
            jpeg = data[offset : offset + size]
            assert jpeg == by_key[row["sample"]][f"{k}.jpg"] == (source / told["images"][k]["source"]).read_bytes()


def test_the_order_of_the_index(written: tuple[Path, Path, Summary]) -> None:
    """By round, then city by city; places shuffled in their city, alike in all rounds; numbers sorted by name."""
    table = index.read_index(str(written[1])).table.to_pylist()
    rounds = [[row for row in table if row["round"] == r] for r in range(3)]
    assert [row["round"] for row in table] == sorted(row["round"] for row in table)
    assert [row["place"] for row in rounds[0]] == [row["place"] for row in rounds[1]] == [x["place"] for x in rounds[2]]
    assert [row["city"] for row in rounds[0]] == sorted(row["city"] for row in rounds[0])
    by_name = sorted({(row["city"], row["place_id"], row["place"]) for row in table})
    assert [place for _, _, place in by_name] == list(range(7))
    assert [row["sample"] for row in table] == sorted(row["sample"] for row in table)


def test_the_index_has_the_mean_position_of_each_place(written: tuple[Path, Path, Summary]) -> None:
    """Of all its images, not of the four of a round; the same in all rounds."""
    source, out, _ = written
    told: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for frame in (source / "Dataframes").iterdir():
        with frame.open() as stream:
            for row in csv.DictReader(stream):
                told.setdefault((row["city_id"], row["place_id"]), []).append((float(row["lat"]), float(row["lon"])))
    opened = index.read_index(str(out))
    positions = opened.positions()
    assert positions.shape == (7, 2)
    for row in opened.table.to_pylist():
        mean = np.mean(told[row["city"], row["place_id"]], axis=0)
        assert np.abs(mean - (row["lat"], row["lon"])).max() < 1e-12
        assert positions[row["place"]].tolist() == [row["lat"], row["lon"]]


@pytest.mark.parametrize(
    ("photos", "mean"),
    [
        ([(10.0, 20.0), (12.0, 22.0), (None, None), (5.0, None)], (11.0, 21.0)),
        ([(0.0, 179.5), (0.0, -179.0)], (0.0, -179.75)),  # across the 180th meridian
        ([(None, None)] * 4, (None, None)),
    ],
)
def test_the_mean_position(photos: list[tuple[float | None, float | None]], mean: tuple[object, object]) -> None:
    assert groups._mean_position([{"lat": lat, "lon": lon} for lat, lon in photos]) == mean


def test_a_set_made_before_the_index_had_positions_is_read(written: tuple[Path, Path, Summary]) -> None:
    """Training needs none; what does need them says how to get them."""
    out = written[1]
    now = index.read_index(str(out))
    sink = io.BytesIO()
    pq.write_table(now.table.drop_columns(["lat", "lon"]), sink)
    manifest = {**now.manifest, "format_version": 1, "index_sha256": schema.sha256(sink.getvalue())}
    (out / schema.INDEX).write_bytes(sink.getvalue())
    (out / schema.MANIFEST).write_bytes(schema.sealed_manifest(manifest))
    old = index.read_index(str(out))
    assert old.table.schema.equals(schema.SCHEMA) and index.verify(str(out)) == []
    assert old.table.drop_columns(["lat", "lon"]).equals(now.table.drop_columns(["lat", "lon"]))
    with pytest.raises(DataError, match=r"without positions .* --overwrite"):
        old.positions()


def test_nothing_disappears_from_the_counts(written: tuple[Path, Path, Summary]) -> None:
    _, out, summary = written
    c = index.read_index(str(out)).manifest["counts"]
    assert (
        c["images_named"] == sum(map(sum, CITIES.values())) == c["images_used"] + c["images_unused"] + c["images_bad"]
    )
    assert c["images_used"] == 4 + 5 + 12 + 8 + 6 + 4 + 9
    assert c["places_named"] == 10 == c["places"] + c["places_under_four"] + c["places_fallen"]
    assert (c["places"], c["places_under_four"], c["places_fallen"], c["samples"]) == (7, 3, 0, 21)
    assert c["bytes"] == sum(path.stat().st_size for path in out.glob("*.tar"))
    assert dict(summary.counts) == c and "under four images" in str(summary)
    told = (out / schema.REPORT).read_text().splitlines()
    assert ",PRS,200009,only 3 images are named" in told and len(told) == 1 + 3


@pytest.mark.parametrize("workers", [3])
def test_the_bytes_do_not_depend_on_the_workers(
    written: tuple[Path, Path, Summary], workers: int, tmp_path: Path
) -> None:
    source, out, summary = written
    other = tmp_path / "other"
    write_shards(read_source(source), other, WriteRule(rounds=3, workers=workers, shard_mb=SMALL))
    assert contents(other) == contents(out)
    assert summary.counts["shards"] >= 9, "one group only: nothing was parallel"
    assert not multiprocessing.active_children()


def test_another_seed_gives_another_draw_of_the_same_places(
    written: tuple[Path, Path, Summary], tmp_path: Path
) -> None:
    source, out, _ = written
    write_shards(read_source(source), tmp_path / "other", WriteRule(rounds=3, seed=1, workers=1, shard_mb=SMALL))
    one, two = (index.read_index(str(folder)).table for folder in (out, tmp_path / "other"))
    assert one["place"].to_pylist() != two["place"].to_pylist()
    assert sorted(one["place"].to_pylist()) == sorted(two["place"].to_pylist())
    drawn = [{tuple(i["source"] for i in json.loads(s["json"])["images"]) for s in samples(f)} for f in (out, tmp_path / "other")]  # fmt: skip  # noqa: E501
    assert drawn[0] != drawn[1]


def spoil(source: Path) -> dict[str, str]:
    """Breaks photos in each way a download does: {path: expected start of the reason}."""
    photos = sorted((source / "Images" / "PRS").glob("PRS_0000010_*"))  # place 300010 has 37 photos
    data = photos[1].read_bytes()
    photos[0].unlink()
    photos[1].write_bytes(data[: len(data) // 2])
    photos[2].write_bytes(b"<html>not found</html>")
    photos[3].write_bytes(b"")
    photos[4].write_bytes(data[:3] + b"\0" * 50)
    reasons = ["missing", "broken JPEG: Premature end", "not a JPEG (HTML", "empty file", "broken JPEG"]
    return {f"Images/PRS/{p.name}": why for p, why in zip(photos, reasons, strict=False)}


def test_bad_images_are_named_and_left_out(gsv: Gsv, tmp_path: Path) -> None:
    source, out = gsv(CITIES), tmp_path / "out"
    broken = spoil(source)
    (tiny,) = (p for p in sorted((source / "Images" / "OSL").glob("OSL_0000008_*_01_*")))  # place 100008 has four
    tiny.write_bytes(tiny.read_bytes()[:-40])
    broken[f"Images/OSL/{tiny.name}"] = "broken JPEG"
    summary = write_shards(read_source(source), out, WriteRule(rounds=10, max_bad=0.1, workers=1))
    with (out / schema.REPORT).open() as stream:
        told = list(csv.DictReader(stream))
    named = {row["file"].replace(".JPG", ".jpg"): row["reason"] for row in told if row["file"]}
    assert named.keys() == {name.replace(".JPG", ".jpg") for name in broken}
    for name, why in broken.items():
        assert named[name.replace(".JPG", ".jpg")].startswith(why), name
    assert {(r["city"], r["place"], r["reason"]) for r in told if not r["file"] and "good" in r["reason"]} == {
        ("OSL", "100008", "only 3 of 4 images are good")
    }
    c = summary.counts
    assert (c["images_bad"], c["places_fallen"], c["places"]) == (6, 1, 6)
    assert c["images_named"] == c["images_used"] + c["images_unused"] + c["images_bad"]
    used = {image["source"] for s in samples(out) for image in json.loads(s["json"])["images"]}
    assert not used & broken.keys() and len(used) == c["images_used"]
    assert sum(summary.reasons.values()) == 6
    assert index.verify(str(out)) == []


def test_too_many_bad_images_end_the_run_without_a_manifest(gsv: Gsv, tmp_path: Path) -> None:
    source, out = gsv(CITIES), tmp_path / "out"
    spoil(source)  # 5 of 79; 2 of them seen in the listing
    rule = WriteRule(rounds=1, max_bad=0.05, workers=1)
    with pytest.raises(DataError, match=r"report.csv: 5 of 79 images .* 6\.33 % and over --max_bad 0\.05"):
        write_shards(read_source(source), out, rule)
    assert not (out / schema.MANIFEST).exists() and not (out / schema.INDEX).exists()
    assert len((out / schema.REPORT).read_text().splitlines()) == 6
    with pytest.raises(DataError, match="unfinished"):
        index.read_index(str(out))
    summary = write_shards(read_source(source), out, WriteRule(rounds=1, max_bad=0.07, workers=1))  # goes on
    assert summary.counts["images_bad"] == 5 and index.verify(str(out)) == []


def test_too_many_missing_images_are_told_before_any_work(gsv: Gsv, tmp_path: Path) -> None:
    source, out = gsv({"PRS": [5, 5]}), tmp_path / "out"
    gone = next((source / "Images" / "PRS").iterdir())
    data = gone.read_bytes()
    gone.unlink()
    with pytest.raises(DataError, match="1 missing"):
        write_shards(read_source(source), out, WriteRule(workers=1))
    assert [path.name for path in out.iterdir()] == [schema.REPORT]
    gone.write_bytes(data)  # mended: the same folder can be used
    assert write_shards(read_source(source), out, WriteRule(workers=1)).counts["images_bad"] == 0


def test_a_source_without_four_images_of_any_place(gsv: Gsv, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no place has 4 images"):
        write_shards(read_source(gsv({"PRS": [3, 1]})), tmp_path / "out", WriteRule(workers=1))


def test_a_second_run_has_nothing_to_do(written: tuple[Path, Path, Summary]) -> None:
    source, out, summary = written
    before = {path.name: path.stat().st_mtime_ns for path in out.iterdir()}
    again = write_shards(read_source(source), out, WriteRule(rounds=3, workers=1, shard_mb=SMALL))
    assert again.seconds == 0 and again.counts == summary.counts
    assert {path.name: path.stat().st_mtime_ns for path in out.iterdir()} == before


@pytest.mark.parametrize(
    ("rule", "told"),
    [
        (WriteRule(rounds=2, shard_mb=SMALL), "rounds 3 -> 2"),
        (WriteRule(rounds=3, seed=5, shard_mb=SMALL), "seed 0 -> 5"),
        (WriteRule(rounds=3, shard_mb=SMALL, image=ImageRule("header", 20)), "check decode -> header, resize 0 -> 20"),
    ],
)
def test_other_settings_are_refused(rule: WriteRule, told: str, written: tuple[Path, Path, Summary]) -> None:
    source, out, _ = written
    before = contents(out)
    with pytest.raises(UsageError, match=told):
        write_shards(read_source(source), out, rule)
    assert contents(out) == before


def test_another_source_is_refused(written: tuple[Path, Path, Summary], gsv: Gsv) -> None:
    _, out, _ = written
    with pytest.raises(UsageError, match=r"source.digest \w+ -> \w+, source.images 79 -> 4, source.places 10 -> 1"):
        write_shards(read_source(gsv({"PRS": [4]}, "another")), out, WriteRule(rounds=3, shard_mb=SMALL))


def test_a_folder_with_other_files_is_refused_and_never_deleted(gsv: Gsv, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.tex").write_text("dear")
    (out / "round-00-00000.tar").write_bytes(b"ours")
    with pytest.raises(UsageError, match=r"thesis\.tex"):
        write_shards(read_source(gsv({"PRS": [4]})), out)
    remove_shards(out)
    assert contents(out) == {"thesis.tex": b"dear"}


@pytest.mark.parametrize(
    "rule", [WriteRule(rounds=0), WriteRule(rounds=999), WriteRule(max_bad=2), WriteRule(shard_mb=0)]
)
def test_impossible_settings_are_refused(rule: WriteRule, gsv: Gsv, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--"):
        write_shards(read_source(gsv({"PRS": [4]})), tmp_path / "out", rule)


def test_finished_groups_are_kept_only_while_their_shards_are_whole(
    written: tuple[Path, Path, Summary], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that stops after its third group continues; a shard that rotted meanwhile is written again."""
    source, whole, _ = written
    out, rule = tmp_path / "other", WriteRule(rounds=3, workers=1, shard_mb=SMALL)
    write, calls = groups.write_group, []

    def stop_early(task: groups.GroupTask) -> int:
        if len(calls) == 3:
            raise OSError(28, "No space left on device")
        calls.append(task.number)
        return write(task)

    monkeypatch.setattr(groups, "write_group", stop_early)
    with pytest.raises(DataError, match=r"No space left.*same command"):
        write_shards(read_source(source), out, rule)
    monkeypatch.undo()
    assert len(list(out.glob("round-00-*.tar"))) == 3 and not (out / schema.MANIFEST).exists()
    kept, rotten = out / groups.shard_name(1, 0), out / groups.shard_name(1, 1)
    kept_at = kept.stat().st_mtime_ns
    data = bytearray(rotten.read_bytes())
    data[700] ^= 1
    rotten.write_bytes(data)
    write_shards(read_source(source), out, rule)
    assert contents(out) == contents(whole)
    assert kept.stat().st_mtime_ns == kept_at


def test_resizing_and_conversion_are_counted(tmp_path: Path, photo: Callable[[int], bytes]) -> None:
    from PIL import Image

    source, out = tmp_path / "mine", tmp_path / "out"
    (source / "cafe").mkdir(parents=True)
    for n in range(4):
        (source / "cafe" / f"{n}.jpg").write_bytes(photo(n))
    Image.new("RGB", (50, 40), "red").save(source / "cafe" / "4.png")
    summary = write_shards(read_source(source), out, WriteRule(rounds=2, workers=1))
    assert summary.counts["made_again"] == 1 and summary.counts["images_used"] == 5
    assert index.read_index(str(out)).manifest["settings"]["png"] == "JPEG of quality 95"
    assert "made again" in str(summary)


def test_two_runs_at_once_are_refused(gsv: Gsv, tmp_path: Path) -> None:
    import fcntl

    out = tmp_path / "out"
    (out / schema.UNFINISHED).mkdir(parents=True)
    with (out / schema.UNFINISHED / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(UsageError, match="another run"):
            write_shards(read_source(gsv({"PRS": [4]})), out, WriteRule(workers=1))


def test_where_nothing_can_be_written_it_is_said_before_any_work(tmp_path: Path) -> None:
    for out in (Path("/proc/shards/out"), Path("/sys/shards"), tmp_path / "a\0b"):
        with pytest.raises(UsageError, match="cannot be written") as caught:
            check_writable(out)
        assert str(caught.value).isprintable()
    check_writable(tmp_path / "deep" / "out")
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(UsageError, match="cannot be written"):
        check_writable(tmp_path / "file" / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_part_does_not_take_the_folder_from_under_the_others(tmp_path: Path) -> None:
    """Parts start together: one that removed the folder it had made would end another that was about to write there."""
    out = tmp_path / "new" / "out"
    check_writable(out, shared=True)
    assert out.is_dir() and not list(out.iterdir())


def test_16_bit_photos_and_bombs_of_ones_own_folder(tmp_path: Path, photo: Callable[[int], bytes]) -> None:
    """Deep grey is scaled, what would decode to gigabytes is named; neither is clipped or left out in silence."""
    import struct
    import zlib

    from PIL import Image

    source, out = tmp_path / "mine", tmp_path / "out"
    (source / "cafe").mkdir(parents=True)
    for n in range(3):
        (source / "cafe" / f"{n}.jpg").write_bytes(photo(n))
    ramp = np.tile(np.arange(0, 65536, 1024, dtype=np.uint16), (64, 1))
    Image.fromarray(ramp).save(source / "cafe" / "deep.png")
    head = b"IHDR" + struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    bomb = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head))
    (source / "cafe" / "bomb.png").write_bytes(bomb + struct.pack(">I", 0) + b"IDAT" + struct.pack(">I", 0))
    summary = write_shards(read_source(source), out, WriteRule(rounds=1, max_bad=0.5, workers=1))
    assert summary.counts["images_used"] == 4 and summary.reasons == {"too large": 1}
    assert 'cafe/bomb.png,.,cafe,"too large: 3,600,000,000 pixels' in (out / "report.csv").read_text()
    (sample,) = samples(out)
    told = json.loads(sample["json"])["images"]
    deep = sample[f"{[image['source'] for image in told].index('cafe/deep.png')}.jpg"]
    stored = np.asarray(Image.open(io.BytesIO(deep)).convert("L")).astype(int)
    assert np.abs(stored - (ramp >> 8)).mean() < 3
