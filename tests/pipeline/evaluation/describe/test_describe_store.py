"""The descriptor store: what any Parquet reader sees, resuming, staleness, bounded memory."""

from __future__ import annotations

import dataclasses
import json
import tracemalloc
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline.common.errors import DataError
from pipeline.config import EvaluationConfig
from pipeline.evaluation.describe.encode import blocks_of
from pipeline.evaluation.describe.store import DescriptorStore, StoreWriter, store_folder
from pipeline.evaluation.identity import Identity, files_digest
from pipeline.evaluation.protocol import protocols

PROTOCOL = protocols(EvaluationConfig(group_size=4, groups=("shuffled",), pca=8), 64, "25 m")[0].grouping
KEY = Identity("database", "abcd", "files", PROTOCOL)
PATHS = [Path(f"photos/{i:04d}.jpg") for i in range(50)]
BLOCKS = blocks_of(PROTOCOL.form(50, "database"), 10, limit=12 * 10 * 4)
VALUES = np.random.Generator(np.random.PCG64(0)).normal(size=(50, 10)).astype(np.float32)
PLACES = np.stack([np.arange(50) * 10.0, np.arange(50) * 20.0], axis=1)


def at(folder: Path) -> Path:
    return store_folder(folder, "city", PROTOCOL, "database")


def write(folder: Path, key: Identity = KEY, parts: int | None = None) -> StoreWriter:
    writer = StoreWriter(at(folder), key, PATHS, PLACES, len(BLOCKS), {"dim": 768})
    for number, block in list(enumerate(BLOCKS))[:parts]:
        if number not in writer.done:
            positions = np.concatenate(block)
            writer.put(number, positions, VALUES[positions])
    return writer


def test_any_parquet_reader_opens_it_and_finds_the_protocol(tmp_path: Path) -> None:
    folder = write(tmp_path).folder
    assert folder == tmp_path / "descriptors" / "city" / "shuffled4_64px" / "database" and len(BLOCKS) == 5
    table = pa.concat_tables(pq.read_table(f) for f in sorted(folder.glob("*.parquet"))).sort_by("row")
    assert table["key"].to_pylist() == [str(p) for p in PATHS]
    assert (np.array(table["descriptor"].to_pylist(), np.float32) == VALUES).all()
    assert table["utm_north"].to_pylist() == PLACES[:, 1].tolist()
    about = json.loads(pq.read_schema(folder / "part-00000.parquet").metadata[b"place_recognition"])
    assert about["model"] == "abcd" and about["model_config"] == {"dim": 768}
    assert about["protocol"]["groups"] == "shuffled" and about["protocol"]["group_size"] == 4


def test_reading_back(tmp_path: Path) -> None:
    store = DescriptorStore(write(tmp_path).folder)
    assert (store.array() == VALUES).all() and len(store) == 50 and store.dim == 10 and store.protocol == PROTOCOL
    assert store.keys() == [str(p) for p in PATHS]
    positions = store.positions()
    assert positions is not None and (positions == PLACES).all()
    seen = np.concatenate([rows for rows, _ in store.blocks()])
    assert sorted(seen) == list(range(50)) and seen.tolist() != list(range(50))


def test_half_precision_is_half_the_size_and_close(tmp_path: Path) -> None:
    half = dataclasses.replace(KEY, protocol=dataclasses.replace(PROTOCOL, stored="fp16"))
    store = DescriptorStore(write(tmp_path, half).folder)
    assert store.array().dtype == np.float16 and (store.array() == VALUES.astype(np.float16)).all()


def test_a_killed_run_continues_behind_its_last_part(tmp_path: Path) -> None:
    folder = write(tmp_path, parts=2).folder
    (folder / ".part-00002.parquet.partial").write_bytes(b"half a part")
    with pytest.raises(DataError, match="2 of 5 parts"):
        DescriptorStore(folder)
    before = {f.name: f.stat().st_mtime_ns for f in folder.glob("*.parquet")}
    writer = StoreWriter(at(tmp_path), KEY, PATHS, PLACES, len(BLOCKS))
    assert writer.done == {0, 1} and not writer.complete and not list(folder.glob(".*"))
    assert write(tmp_path).complete
    assert all((folder / name).stat().st_mtime_ns == when for name, when in before.items())
    assert (DescriptorStore(folder).array() == VALUES).all()


@pytest.mark.parametrize("change", [{"model": "other"}, {"files": "other"}])
def test_parts_of_another_key_are_removed(tmp_path: Path, change: dict[str, str]) -> None:
    write(tmp_path)
    writer = StoreWriter(at(tmp_path), dataclasses.replace(KEY, **change), PATHS, PLACES, len(BLOCKS))
    assert writer.done == frozenset() and not list(writer.folder.glob("part-*"))


def test_the_digest_of_files_sees_a_rewritten_photo(tmp_path: Path) -> None:
    photos = [tmp_path / "a.jpg", tmp_path / "b.jpg"]
    for photo in photos:
        photo.write_bytes(b"one")
    before = files_digest(photos)
    assert files_digest(photos) == before
    photos[1].write_bytes(b"three")
    assert files_digest(photos) != before
    photos[1].unlink()
    with pytest.raises(DataError, match=r"b\.jpg"):
        files_digest(photos)


def test_reading_holds_a_part_at_a_time(tmp_path: Path) -> None:
    paths = [Path("x.jpg")] * 8000
    writer = StoreWriter(at(tmp_path), KEY, paths, None, 40)
    values = np.zeros((200, 500), np.float32)
    for number in range(40):
        writer.put(number, np.arange(200 * number, 200 * number + 200), values + number)
    store = DescriptorStore(writer.folder)
    assert store.positions() is None
    tracemalloc.start()
    highest = 0
    base = pa.total_allocated_bytes()
    for rows, block in store.blocks():
        assert (block == rows[0] // 200).all()
        highest = max(highest, pa.total_allocated_bytes() - base)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert highest + peak < 8000 * 500 * 4 / 5  # of 16 MB
