"""A shard's bytes against webdataset's own writer, and its appearance only when whole."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path

import pytest
import webdataset

from pipeline.common.files import write_atomically
from shards.shard_file import ShardFile

SAMPLES = [
    (f"{n:06d}", {**{f"{k}.jpg": bytes([k, n]) * (n * 311 + k) for k in range(4)}, "json": b'{"n": %d}' % n})
    for n in range(0, 40, 3)
]


def test_the_bytes_are_webdatasets(tmp_path: Path) -> None:
    truth = io.BytesIO()
    writer = webdataset.TarWriter(truth, encoder=False, mtime=0)
    for key, members in SAMPLES:
        writer.write({"__key__": key, **members})
    writer.close()
    with ShardFile(tmp_path / "x.tmp") as shard:
        places = {(key, name): at for key, members in SAMPLES for name, at in shard.add(key, members).items()}
        shard.finish(tmp_path / "x.tar")
    data = (tmp_path / "x.tar").read_bytes()
    assert data == truth.getvalue()
    assert (len(data), hashlib.sha256(data).hexdigest()) == (shard.size, shard.sha256)
    for key, members in SAMPLES:
        for name, content in members.items():
            at = places[key, name]
            assert data[at.offset : at.offset + at.size] == content


def test_an_unfinished_shard_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), ShardFile(tmp_path / "x.tmp") as shard:
        shard.add(*SAMPLES[1])
        raise RuntimeError
    assert not list(tmp_path.iterdir())


def test_small_files_appear_whole(tmp_path: Path) -> None:
    write_atomically(tmp_path / "a.json", b"one")
    write_atomically(tmp_path / "a.json", b"two")
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("a.json", b"two")]
