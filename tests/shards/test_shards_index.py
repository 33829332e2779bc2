"""Verification finds every kind of damage, and an index is never read from a set that is not whole."""

from __future__ import annotations

import json
import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import fsspec
import pyarrow as pa
import pytest

from pipeline.common.errors import DataError, UsageError
from shards import index, schema
from shards.sources.registry import read_source
from shards.writer import WriteRule, write_shards


@pytest.fixture
def shard_set(gsv: Callable[..., Path], tmp_path: Path) -> Path:
    out = tmp_path / "out"
    write_shards(read_source(gsv({"PRS": [4, 5, 6, 2], "OSL": [4]})), out, WriteRule(2, workers=1, shard_mb=0.03))
    return out


def flip(path: Path, bit: int) -> None:
    data = bytearray(path.read_bytes())
    data[bit // 8] ^= 1 << bit % 8
    path.write_bytes(data)


def test_a_whole_set_has_no_problems(shard_set: Path) -> None:
    assert index.verify(str(shard_set)) == []


@pytest.mark.parametrize("pattern", ["round-*.tar", schema.INDEX, schema.MANIFEST, schema.REPORT])
def test_one_flipped_bit_anywhere_is_found(pattern: str, shard_set: Path) -> None:
    """Twenty bits spread over each kind of file, the first and the last among them, one at a time."""
    path = sorted(shard_set.glob(pattern))[-1]
    bits = path.stat().st_size * 8
    for bit in [0, bits - 1, *random.Random(1).sample(range(bits), 18)]:
        flip(path, bit)
        problems = index.verify(str(shard_set))
        assert problems and path.name in problems[0], f"bit {bit} of {path.name}: {problems}"
        flip(path, bit)
    assert index.verify(str(shard_set)) == []


def test_truncated_missing_and_extra_files_are_each_named(shard_set: Path) -> None:
    first, second, third = sorted(shard_set.glob("*.tar"))[:3]
    first.write_bytes(first.read_bytes()[:-512])
    second.unlink()
    (shard_set / "round-00-99999.tar").write_bytes(third.read_bytes())
    (shard_set / "unfinished").mkdir()
    problems = index.verify(str(shard_set))
    assert len(problems) == 4
    for name, what in (
        (first.name, "bytes, the manifest says"),
        (second.name, "missing"),
        ("round-00-99999.tar", "not part of the set"),
        ("unfinished", "not part of the set"),
    ):
        assert any(problem.startswith(name) and what in problem for problem in problems), problems


def test_exchanged_shards_are_found(shard_set: Path) -> None:
    first, second = sorted(shard_set.glob("*.tar"))[:2]
    one, two = first.read_bytes(), second.read_bytes()
    first.write_bytes(two)
    second.write_bytes(one)
    assert len(index.verify(str(shard_set))) == 2


@pytest.mark.parametrize(
    ("name", "message"),
    [(schema.MANIFEST, "no manifest.json there .not a shard set"), (schema.INDEX, "index.parquet is missing")],
)
def test_an_incomplete_set_is_not_opened(name: str, message: str, shard_set: Path) -> None:
    (shard_set / name).unlink()
    assert any(name in problem for problem in index.verify(str(shard_set)))
    with pytest.raises(DataError, match=message):
        index.read_index(str(shard_set))


def test_a_changed_index_is_not_opened(shard_set: Path) -> None:
    flip(shard_set / schema.INDEX, 999)
    with pytest.raises(DataError, match=r"index\.parquet has changed"):
        index.read_index(str(shard_set))


def test_an_edited_manifest_is_not_opened(shard_set: Path) -> None:
    path = shard_set / schema.MANIFEST
    manifest = json.loads(path.read_bytes())
    manifest["counts"]["places"] += 1
    path.write_bytes(schema.canonical(manifest))
    with pytest.raises(DataError, match=r"manifest\.json has changed"):
        index.read_index(str(shard_set))


def test_another_format_version_is_told(shard_set: Path) -> None:
    path = shard_set / schema.MANIFEST
    path.write_bytes(schema.sealed_manifest({**json.loads(path.read_bytes()), "format_version": 99}))
    with pytest.raises(DataError, match="format version 99"):
        index.read_index(str(shard_set))


def test_no_folder_and_nonsense_are_told(tmp_path: Path) -> None:
    assert index.verify(str(tmp_path / "nowhere")) == ["no such folder"]
    with pytest.raises(DataError, match="not a shard set"):
        index.read_index(str(tmp_path / "nowhere"))
    for nonsense in (b"", b"[]", b"null", b"{", b"\xff\xfe"):
        (tmp_path / schema.MANIFEST).write_bytes(nonsense)
        assert index.verify(str(tmp_path))
        with pytest.raises(DataError):
            index.read_index(str(tmp_path))


def test_what_cannot_be_opened_is_one_line(tmp_path: Path) -> None:
    """A file system that nobody knows, a pipe in the place of a file (reading it would never end)."""
    with pytest.raises(UsageError, match="nosuch://bucket/set: cannot be opened"):
        index.read_index("nosuch://bucket/set")
    os.mkfifo(tmp_path / schema.MANIFEST)
    with pytest.raises(DataError, match="is not an ordinary file"):
        index.read_index(str(tmp_path))
    assert "is not an ordinary file" in index.verify(str(tmp_path))[0]


def test_verify_finds_an_index_that_leads_to_other_members(shard_set: Path) -> None:
    """Sealed again with good hashes: two samples of a shard exchange their places, and nothing else is wrong."""
    opened = index.read_index(str(shard_set))
    rows = opened.table.to_pylist()
    first, second = [row for row in rows if row["shard"] == rows[0]["shard"]][:2]
    for name in ("offsets", "sizes", "json_offset", "json_size"):
        first[name], second[name] = second[name], first[name]
    raw = index.index_bytes(pa.Table.from_pylist(rows, schema=schema.SCHEMA))
    (shard_set / schema.INDEX).write_bytes(raw)
    sealed = schema.sealed_manifest({**opened.manifest, "index_sha256": schema.sha256(raw)})
    (shard_set / schema.MANIFEST).write_bytes(sealed)
    (problem,) = index.verify(str(shard_set))
    assert problem.startswith(f"{rows[0]['shard']}: index.parquet leads to 00000")


def test_a_set_behind_a_url_is_read_and_verified(shard_set: Path) -> None:
    memory = fsspec.filesystem("memory")
    memory.put(str(shard_set), "/bucket/set", recursive=True)
    url = "memory://bucket/set"
    local, remote = index.read_index(str(shard_set)), index.read_index(url)
    assert remote.table.equals(local.table) and remote.digest == local.digest and remote.root == url
    assert index.verify(url) == []
    memory.pipe("/bucket/set/extra.tar", b"1")
    assert index.verify(url) == ["extra.tar is not part of the set"]
    memory.rm("/bucket", recursive=True)


def test_a_moved_set_is_the_same_set(shard_set: Path, tmp_path: Path) -> None:
    moved = tmp_path / "elsewhere"
    before = index.read_index(str(shard_set)).digest
    shutil.move(shard_set, moved)
    assert index.verify(str(moved)) == [] and index.read_index(str(moved)).digest == before
