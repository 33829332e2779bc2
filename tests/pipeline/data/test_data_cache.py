"""The cache of remote shards: complete or absent, within its bound, shared by processes, and safe from kills."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import http.server
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import ClassVar

import fsspec
import numpy as np
import pytest

from pipeline.common.errors import DataError, UsageError
from pipeline.config import DataConfig
from pipeline.data.cache import ShardCache
from pipeline.data.places import build_loader
from pipeline.data.prefetch import FetchAhead
from shards.index import ShardIndex, read_index
from shards.schema import sealed_manifest

Make = Callable[..., ShardIndex]
SIZE = 100_000
NAMES = [f"{i}.tar" for i in range(6)]


@pytest.fixture()
def remote(make_table: Make, request: pytest.FixtureRequest) -> ShardIndex:
    """Six random shards of 100 kB at memory://."""
    root = f"memory://{request.node.name}"
    rng, shards = np.random.default_rng(0), []
    for name in NAMES:
        raw = rng.bytes(SIZE)
        with fsspec.open(f"{root}/{name}", "wb") as file:
            file.write(raw)
        shards.append({"name": name, "bytes": SIZE, "sha256": hashlib.sha256(raw).hexdigest(), "samples": 1})
    index = make_table([4])
    return dataclasses.replace(index, root=root, manifest={**index.manifest, "shards": shards})


@pytest.mark.parametrize("name", ["../../x.pth", "../x.tar", "/tmp/x.tar", "a/b.tar", "x\0.tar", "x.tar.lock", ".tar"])
def test_a_shard_name_that_leads_elsewhere_is_refused_before_anything_is_made(
    name: str, remote: ShardIndex, tmp_path: Path
) -> None:
    """In a manifest sealed with good hashes: when the set is opened, and where a cache is made of it otherwise."""
    shard = {**remote.manifest["shards"][0], "name": name, "bytes": 10_240}
    ones = ("places", "places_named", "rounds", "samples", "shards")
    others = "places_under_four places_fallen images_named images_used images_bad images_unused duplicates unlisted"
    counts = {**dict.fromkeys(ones, 1), **dict.fromkeys([*others.split(), "made_again"], 0), "bytes": 10_240}
    digests = dict.fromkeys(("index_sha256", "report_sha256"), "0" * 64)
    told = {"format_version": 2, "settings": {"rounds": 1}, "counts": counts, "left_out": {}, "shards": [shard]}
    sealed = sealed_manifest({**told, **digests})
    for file, raw in (("manifest.json", sealed), ("index.parquet", b"")):
        with fsspec.open(f"{remote.root}/{file}", "wb") as target:
            target.write(raw)
    with pytest.raises(DataError, match=r"manifest\.json shards\[0\]\.name is .*, not the plain") as caught:
        read_index(remote.root)
    assert str(caught.value).isprintable()
    cache = tmp_path / "deep" / "cache"
    with pytest.raises(DataError, match="not a plain file name"):
        ShardCache(dataclasses.replace(remote, manifest={**remote.manifest, "shards": [shard]}), cache, 9 * SIZE)
    assert not list(tmp_path.iterdir())


def content(index: ShardIndex, name: str) -> bytes:
    with fsspec.open(f"{index.root}/{name}", "rb") as file:
        data: bytes = file.read()
        return data


def cached(folder: Path) -> set[str]:
    return {path.name for path in folder.rglob("*.tar")}


def test_least_recently_used_shards_make_room(remote: ShardIndex, tmp_path: Path) -> None:
    cache = ShardCache(remote, tmp_path, int(3.5 * SIZE))
    for name in ("0.tar", "1.tar", "2.tar", "0.tar", "3.tar"):
        descriptor = cache.open(name)
        assert os.pread(descriptor, SIZE + 1, 0) == content(remote, name)
        os.close(descriptor)
        time.sleep(0.01)  # file times must differ
    assert cached(tmp_path) == {"0.tar", "2.tar", "3.tar"}
    cache.wanted = frozenset({"2.tar", "0.tar"})
    cache.fetch("4.tar")
    assert cached(tmp_path) == {"0.tar", "2.tar", "4.tar"}


def test_an_open_shard_survives_its_eviction(remote: ShardIndex, tmp_path: Path) -> None:
    cache = ShardCache(remote, tmp_path, SIZE)
    descriptor = cache.open("0.tar")
    cache.fetch("1.tar")
    assert cached(tmp_path) == {"1.tar"}
    assert os.pread(descriptor, SIZE, 0) == content(remote, "0.tar")
    os.close(descriptor)


def test_a_damaged_or_missing_shard_never_enters(remote: ShardIndex, tmp_path: Path) -> None:
    cache = ShardCache(remote, tmp_path, 10 * SIZE)
    raw = bytearray(content(remote, "1.tar"))
    raw[500] ^= 1
    for damaged in (bytes(raw), bytes(raw[:-1]), bytes(raw) * 3):
        with fsspec.open(f"{remote.root}/1.tar", "wb") as file:
            file.write(damaged)
        cache.attempts = 1
        with pytest.raises(DataError, match=r"1\.tar: cannot be fetched after 1 attempts \(its SHA-256"):
            cache.fetch("1.tar")
    fsspec.filesystem("memory").rm(f"{remote.root}/2.tar")
    with pytest.raises(DataError, match=r"2\.tar: missing"):
        cache.fetch("2.tar")
    with pytest.raises(DataError, match=r"names shard 9\.tar, which the manifest does not"):
        cache.fetch("9.tar")
    with pytest.raises(UsageError, match=r"0\.tar has 100,000: raise it"):
        ShardCache(remote, tmp_path, SIZE - 1).fetch("0.tar")
    assert not cached(tmp_path) and not list(tmp_path.rglob("*.part"))


def test_fetching_ahead_follows_the_cursor_within_half_of_the_cache(remote: ShardIndex, tmp_path: Path) -> None:
    cache = ShardCache(remote, tmp_path, 4 * SIZE)
    ahead = FetchAhead(cache, [[name] for name in NAMES], 0)
    ahead.start()

    def until(expected: set[str]) -> None:
        limit = time.monotonic() + 5
        while not expected <= cached(tmp_path) and time.monotonic() < limit:
            time.sleep(0.01)
        time.sleep(0.05)  # and no more than these
        assert expected <= cached(tmp_path)

    until({"0.tar", "1.tar"})
    assert cached(tmp_path) == {"0.tar", "1.tar"}
    ahead.advance(3)
    until({"3.tar", "4.tar"})
    fsspec.filesystem("memory").rm(f"{remote.root}/5.tar")
    ahead.advance(5)
    ahead.join(5)
    with pytest.raises(DataError, match=r"5\.tar: missing"):
        ahead.advance(6)


class _Server(http.server.SimpleHTTPRequestHandler):
    counts: ClassVar[Counter[str]] = Counter()
    delay = 0.0

    def do_GET(self) -> None:
        self.counts[Path(self.path).name] += 1
        time.sleep(self.delay)
        super().do_GET()

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture()
def served(make_set: Make, tmp_path: Path) -> Iterator[ShardIndex]:
    """A real set of seven shards behind HTTP on loopback; its local twin is at `tmp_path/set`."""
    local = make_set(tmp_path / "set", [11, 8, 7])
    _Server.counts, _Server.delay = Counter(), 0.0
    handler = functools.partial(_Server, directory=str(tmp_path / "set"))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield dataclasses.replace(local, root=f"http://127.0.0.1:{server.server_port}")
    server.shutdown()


@pytest.mark.parametrize(("workers", "order"), [(0, "city"), (2, "blocked")])
def test_a_remote_set_gives_the_pixels_of_its_local_twin(
    served: ShardIndex, tmp_path: Path, workers: int, order: str
) -> None:
    local = dataclasses.replace(served, root=f"file://{tmp_path / 'set'}")
    bound = (4.2 if workers else 8) * max(shard["bytes"] for shard in served.manifest["shards"])
    config = DataConfig(places_per_batch=4, image_size=28, workers=workers, order=order, window_shards=1)  # type: ignore[arg-type]
    config = dataclasses.replace(config, cache=str(tmp_path / "cache"), cache_gb=bound / 1e9)
    pairs = zip(build_loader(served, config, 0, 0, 0, 0, 1), build_loader(local, config, 0, 0, 0, 0, 1), strict=True)
    for far, near in pairs:
        assert far.keys == near.keys and (far.images == near.images).all()
        assert sum(p.stat().st_size for p in (tmp_path / "cache").rglob("*.tar")) <= bound
    if workers == 0:  # all fitted: each was fetched once
        assert set(_Server.counts.values()) == {1} and len(_Server.counts) == 7


def test_a_cache_too_small_for_the_order_is_refused(served: ShardIndex, tmp_path: Path) -> None:
    config = DataConfig(places_per_batch=4, cache=str(tmp_path), cache_gb=1e-5)
    with pytest.raises(UsageError, match=r"data.order=city reads .* set data.order to blocked"):
        build_loader(served, config, 0, 0, 0, 0, 1)
    with pytest.raises(UsageError, match=r"lower data.window_shards"):
        build_loader(served, dataclasses.replace(config, order="blocked"), 0, 0, 0, 0, 1)


READER = """
import json, os, random, sys
from pathlib import Path
from types import SimpleNamespace
from pipeline.data.cache import ShardCache
index, folder, limit, seed, reads = json.loads(sys.argv[1])
cache = ShardCache(SimpleNamespace(**index), Path(folder), limit)
names = sorted(cache.shards)
print("ready", flush=True)
for _ in range(reads):
    name = random.Random(f"{seed}{_}").choice(names)
    descriptor = cache.open(name)
    size = os.fstat(descriptor).st_size
    import hashlib
    assert hashlib.sha256(os.pread(descriptor, size, 0)).hexdigest() == cache.shards[name]["sha256"]
    os.close(descriptor)
    used = 0
    for path in Path(folder).glob("*/*"):
        try:
            used += path.stat().st_size
        except FileNotFoundError:
            pass
    assert used <= limit + size, (used, limit)  # not a snapshot: one file may be renamed while we count
"""


def reader(index: ShardIndex, folder: Path, limit: int, seed: int, reads: int) -> subprocess.Popen[str]:
    plain = {"root": index.root, "manifest": index.manifest, "digest": index.digest}
    argument = json.dumps([plain, str(folder), limit, seed, reads])
    return subprocess.Popen([sys.executable, "-c", READER, argument], stdout=subprocess.PIPE, text=True)


def test_processes_share_a_cache_that_holds_two_of_seven_shards(served: ShardIndex, tmp_path: Path) -> None:
    limit = int(2.5 * max(shard["bytes"] for shard in served.manifest["shards"]))
    processes = [reader(served, tmp_path / "cache", limit, seed, 25) for seed in range(3)]
    assert [process.wait(60) for process in processes] == [0, 0, 0]
    assert sum(p.stat().st_size for p in (tmp_path / "cache").rglob("*.tar")) <= limit


def test_processes_that_want_one_shard_fetch_it_once(served: ShardIndex, tmp_path: Path) -> None:
    _Server.delay = 0.3
    shard = served.manifest["shards"][0]
    one = dataclasses.replace(served, manifest={**served.manifest, "shards": [shard]})
    processes = [reader(one, tmp_path / "cache", 10**9, seed, 2) for seed in range(3)]
    assert [process.wait(60) for process in processes] == [0, 0, 0]
    assert _Server.counts[shard["name"]] == 1


def test_a_kill_while_fetching_leaves_nothing_wrong(served: ShardIndex, tmp_path: Path) -> None:
    _Server.delay = 30.0
    limit = int(1.5 * max(shard["bytes"] for shard in served.manifest["shards"]))
    process = reader(served, tmp_path / "cache", limit, 0, 1)
    deadline = time.monotonic() + 20
    while not list((tmp_path / "cache").rglob("*.part")) and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    (left,) = (tmp_path / "cache").rglob("*.part")
    _Server.delay = 0.0
    # the room it had taken is free again, for the same shard and for any other
    cache = ShardCache(served, tmp_path / "cache", limit)
    assert cache.fetch(left.stem).read_bytes() == (tmp_path / "set" / left.stem).read_bytes()
    other = next(name for name in cache.shards if name != left.stem)
    assert cache.fetch(other).read_bytes() == (tmp_path / "set" / other).read_bytes()
    assert not left.exists()
