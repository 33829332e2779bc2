"""The index and manifest of a shard set: what is in it, where each byte lies, and whether it is still so.

`index.parquet` has one row a sample (a place in a round); `manifest.json` has every file's size and sha256, the
settings, the counts and what was left out. Invariant: the manifest is written last and atomically, so a folder with a
manifest is a complete shard set; every byte of the set is covered by a hash in it, and the manifest by its own.
Both are checked whole, once, when the set is opened (`shards.schema`).
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from pipeline.common.errors import DataError, UsageError
from pipeline.common.progress import track
from pipeline.common.text import shown
from shards.schema import (
    HEADER,
    INDEX,
    MANIFEST,
    REPORT,
    SCHEMA,
    UNFINISHED,
    WITHOUT_POSITIONS,
    check_index,
    check_manifest,
    sha256,
)

_LARGEST = {MANIFEST: 1 << 28, INDEX: 1 << 32, REPORT: 1 << 34}  # bytes read into memory
_BLOCK = 1 << 22


@dataclass(frozen=True)
class ShardIndex:
    """An opened shard set.

    `table` has the columns of `SCHEMA`, ordered by round and then as written (city by city, places shuffled within
    their city); `digest` is the sha256 of `index.parquet`, which names the set in checkpoints.
    """

    root: str
    table: pa.Table
    manifest: dict[str, Any]
    digest: str

    @property
    def places(self) -> int:
        """Number of places P, each once in every round."""
        return int(self.manifest["counts"]["places"])

    @property
    def rounds(self) -> int:
        """Number of rounds R; epoch e reads round e mod R."""
        return int(self.manifest["counts"]["rounds"])

    def positions(self) -> np.ndarray:
        """Latitude and longitude of each place in degrees, float64 [P, 2]; NaN where the source gave none.

        Raises:
            DataError: the set was made before the index had positions.
        """
        if self.manifest["format_version"] == WITHOUT_POSITIONS:
            raise DataError(
                f"{self.root}/{INDEX} was written without positions (lat, lon) by an earlier version: "
                f"prepare the shards again with --overwrite"
            )
        found = np.full((self.places, 2), np.nan)
        found[self.table["place"].to_numpy()] = np.stack([self.table[n].to_numpy() for n in ("lat", "lon")], axis=1)
        return found


def read_index(root: str) -> ShardIndex:
    """Opens a shard set at a folder or any fsspec URL; reads index and manifest only, and checks both completely.

    Raises:
        DataError: no shard set there, an unfinished one, another format, or an index or manifest that was changed or
            that contradicts itself.
        UsageError: a URL whose file system is unknown or not installed.
    """
    files = _Files(root)
    try:
        raw = files.read(MANIFEST)
    except FileNotFoundError as error:
        hint = "unfinished: run the same jobs.prepare command again" if files.has(UNFINISHED) else "not a shard set"
        if isinstance(error.__cause__, Exception):  # how a URL that cannot be reached is told
            hint += f", or {_line(error.__cause__)}"
        raise DataError(f"{root}: no {MANIFEST} there ({hint}; shard sets are made by jobs.prepare)") from None
    try:
        index = files.read(INDEX)
    except FileNotFoundError:
        raise DataError(f"{root}/{INDEX} is missing: prepare the shards again") from None
    try:
        manifest = check_manifest(raw)
        return ShardIndex(root, check_index(index, manifest), manifest, manifest["index_sha256"])
    except DataError as error:
        raise DataError(f"{root}/{error}") from None


def verify(root: str) -> list[str]:
    """Reads every byte of a shard set and names what is not as its manifest says; empty when all is well.

    Found are: a changed, truncated, missing or extra file, down to one flipped bit anywhere, also in the index, the
    report and the manifest itself; and an index that does not lead to the members it names.

    Raises:
        DataError, UsageError: the folder or one of its small files cannot be read at all.
    """
    files = _Files(root)
    if not files.is_folder():
        return ["no such folder"]
    present = files.names()
    if MANIFEST not in present:
        extra = "; the set is unfinished: run the same jobs.prepare command again" if UNFINISHED in present else ""
        return [f"{MANIFEST} is missing{extra}"]
    try:
        manifest = check_manifest(files.read(MANIFEST))
    except DataError as error:
        return [str(error)]
    listed = {shard["name"]: shard for shard in manifest["shards"]}
    expected = {MANIFEST, INDEX, REPORT, *listed}
    problems = [f"{name} is missing" for name in sorted(expected - present)]
    problems += [f"{shown(name)} is not part of the set" for name in sorted(present - expected)]
    table = None
    if INDEX in present:
        try:
            table = check_index(files.read(INDEX), manifest)
        except DataError as error:
            problems.append(str(error))
    if REPORT in present and sha256(files.read(REPORT)) != manifest["report_sha256"]:
        problems.append(f"{REPORT} has changed: its sha256 is not the manifest's")
    check = partial(_check_shard, files, table)
    with ThreadPoolExecutor() as pool:  # hashing and reading release the interpreter lock
        shards = [listed[name] for name in sorted(listed) if name in present]
        for problem in track(pool.map(check, shards), "verifying", len(shards), "shards"):
            problems += [problem] if problem else []
    return problems


def index_bytes(table: pa.Table) -> bytes:
    """The bytes of index.parquet for a table with the columns of `SCHEMA`; equal tables give equal bytes."""
    sink = io.BytesIO()
    pq.write_table(table.cast(SCHEMA), sink, compression="zstd", store_schema=True)
    return sink.getvalue()


class _Files:
    """The files of one folder, local or at any fsspec URL. What it cannot read is a `DataError`, what is not there a
    `FileNotFoundError`."""

    def __init__(self, root: str) -> None:
        from fsspec.core import url_to_fs

        self.root = root
        try:
            self.fs, self.path = url_to_fs(str(root))
        except (ImportError, ValueError, OSError) as error:  # the package of a file system; an unknown one
            raise UsageError(f"{shown(root)}: cannot be opened ({_line(error)})") from None

    def _at(self, name: str) -> str:
        return f"{self.path.rstrip('/')}/{name}"

    @contextmanager
    def _told(self, name: str) -> Iterator[None]:
        try:
            yield
        except (FileNotFoundError, DataError):
            raise
        except Exception as error:  # each file system has errors of its own
            raise DataError(f"{shown(self.root)}/{name} cannot be read ({_line(error)})") from None

    def is_folder(self) -> bool:
        with self._told(""):
            return bool(self.fs.isdir(self.path))

    def has(self, name: str) -> bool:
        with self._told(name):
            return bool(self.fs.exists(self._at(name)))

    def names(self) -> set[str]:
        with self._told(""):
            return {entry.rstrip("/").rsplit("/", 1)[-1] for entry in self.fs.ls(self.path, detail=False)}

    def read(self, name: str) -> bytes:
        with self._told(name):
            if self._size(name) > _LARGEST[name]:
                raise DataError(f"{self.root}/{name} has {self._size(name):,} bytes, which no real one has")
            return bytes(self.fs.cat_file(self._at(name)))

    def blocks(self, name: str) -> Iterator[bytes]:
        with self._told(name):
            self._size(name)
            with self.fs.open(self._at(name), "rb") as stream:
                while block := stream.read(_BLOCK):
                    while len(block) < _BLOCK and (more := stream.read(_BLOCK - len(block))):
                        block += more  # a connection gives what it has: whole tar blocks are wanted
                    yield block

    def _size(self, name: str) -> int:
        """Bytes of a file, 0 where the file system does not say. Refuses what is no file: reading a pipe never ends."""
        told = self.fs.info(self._at(name))
        if told.get("type") != "file":
            raise DataError(f"{self.root}/{name} is not an ordinary file ({shown(told.get('type'))})")
        return int(told.get("size") or 0)


def _line(error: Exception) -> str:
    return shown(f"{type(error).__name__}: {error}".splitlines()[0])


def _check_shard(files: _Files, table: pa.Table | None, shard: dict[str, Any]) -> str | None:
    digest, size, problem = hashlib.sha256(), 0, None
    headers = _headers(table, shard["name"]) if table is not None else {}
    expected = sorted(headers, reverse=True)
    try:
        for block in files.blocks(shard["name"]):
            digest.update(block)
            while expected and expected[-1] < size + len(block):
                at = expected.pop()
                found = block[at - size : at - size + HEADER]
                if (found[:100].rstrip(b"\0"), found[124:135]) != headers[at]:
                    name, long = headers[at][0].decode(), int(headers[at][1], 8)
                    problem = problem or f"{INDEX} leads to {name} ({long:,} bytes), which is not there"
            size += len(block)
    except FileNotFoundError:
        return f"{shard['name']} is missing"
    except DataError as error:
        return str(error)
    if size != shard["bytes"]:
        return f"{shard['name']} has {size:,} bytes, the manifest says {shard['bytes']:,}"
    if digest.hexdigest() != shard["sha256"]:
        return f"{shard['name']} has changed: its sha256 is not the manifest's"
    return f"{shard['name']}: {problem}" if problem else None


def _headers(table: pa.Table, shard: str) -> dict[int, tuple[bytes, bytes]]:
    """Name and size, as a tar header spells them, by the header's position, of each member that the index names."""
    mine = table.filter(pc.equal(table["shard"], shard))
    headers = {}
    for sample, offsets, sizes, json_offset, json_size in zip(
        *(mine[name].to_pylist() for name in ("sample", "offsets", "sizes", "json_offset", "json_size")), strict=True
    ):
        names = (*(f"{sample}.{k}.jpg" for k in range(len(offsets))), f"{sample}.json")
        for name, offset, size in zip(names, (*offsets, json_offset), (*sizes, json_size), strict=True):
            headers[offset - HEADER] = (name.encode(), b"%011o" % size)
    return headers
