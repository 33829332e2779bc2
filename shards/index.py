"""The index and manifest of a shard set: what is in it, where each byte lies, and whether it is still so.

`index.parquet` has one row a sample (a place in a round); `manifest.json` has every file's size and sha256, the
settings, the counts and what was left out. Invariant: the manifest is written last and atomically, so a folder with a
manifest is a complete shard set; every byte of the set is covered by a hash in it, and the manifest by its own.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.common.errors import DataError
from pipeline.common.progress import track

FORMAT_VERSION = 2
_WITHOUT_POSITIONS = 1  # the format before it, without `lat` and `lon`: still read
IMAGES_A_SAMPLE = 4
INDEX, MANIFEST, REPORT, UNFINISHED = "index.parquet", "manifest.json", "report.csv", "unfinished"
SCHEMA = pa.schema(
    [
        ("sample", pa.string()),  # "000123": prefix of the sample's members, unique in the set
        ("round", pa.int32()),
        ("city", pa.string()),
        ("place_id", pa.string()),
        ("place", pa.int32()),  # 0..P-1 in the order of (city, place_id); the same in all rounds
        ("shard", pa.string()),  # file name
        ("offsets", pa.list_(pa.int64(), IMAGES_A_SAMPLE)),  # byte position of each JPEG in the shard
        ("sizes", pa.list_(pa.int64(), IMAGES_A_SAMPLE)),  # its length in bytes
        ("json_offset", pa.int64()),
        ("json_size", pa.int64()),
        ("lat", pa.float64()),  # degrees: mean of the place's images, the same in all rounds; null where unknown
        ("lon", pa.float64()),
    ]
)
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
        if self.manifest["format_version"] == _WITHOUT_POSITIONS:
            raise DataError(
                f"{self.root}/{INDEX} was written without positions (lat, lon) by an earlier version: "
                f"prepare the shards again with --overwrite"
            )
        found = np.full((self.places, 2), np.nan)
        found[self.table["place"].to_numpy()] = np.stack([self.table[n].to_numpy() for n in ("lat", "lon")], axis=1)
        return found


def read_index(root: str) -> ShardIndex:
    """Opens a shard set at a folder or any fsspec URL; reads index and manifest only, checks both by hash.

    Raises:
        DataError: no shard set there, an unfinished one, another format, or an index or manifest that was changed.
    """
    files = _Files(root)
    try:
        raw = files.read(MANIFEST)
    except FileNotFoundError:
        hint = "unfinished: run the same jobs.prepare command again" if files.has(UNFINISHED) else "not a shard set"
        raise DataError(f"{root}: no {MANIFEST} there ({hint}; shard sets are made by jobs.prepare)") from None
    manifest, problems = _read_manifest(raw)
    if problems:
        raise DataError(f"{root}/{problems[0]}")
    try:
        index = files.read(INDEX)
    except FileNotFoundError:
        raise DataError(f"{root}/{INDEX} is missing: prepare the shards again") from None
    table, problems = _read_table(index, manifest)
    if table is None or problems:
        raise DataError(f"{root}/{problems[0]}")
    return ShardIndex(root, table, manifest, manifest["index_sha256"])


def verify(root: str) -> list[str]:
    """Reads every byte of a shard set and names what is not as its manifest says; empty when all is well.

    Found are: a changed, truncated, missing or extra file, down to one flipped bit anywhere, also in the index, the
    report and the manifest itself.
    """
    files = _Files(root)
    if not files.is_folder():
        return ["no such folder"]
    present = files.names()
    if MANIFEST not in present:
        extra = "; the set is unfinished: run the same jobs.prepare command again" if UNFINISHED in present else ""
        return [f"{MANIFEST} is missing{extra}"]
    manifest, problems = _read_manifest(files.read(MANIFEST))
    if problems:
        return problems
    listed = {shard["name"]: shard for shard in manifest["shards"]}
    expected = {MANIFEST, INDEX, REPORT, *listed}
    problems += [f"{name} is missing" for name in sorted(expected - present)]
    problems += [f"{name} is not part of the set" for name in sorted(present - expected)]
    if INDEX in present:
        problems += _read_table(files.read(INDEX), manifest)[1]
    if REPORT in present and sha256(files.read(REPORT)) != manifest["report_sha256"]:
        problems.append(f"{REPORT} has changed: its sha256 is not the manifest's")
    check = partial(_check_shard, files)
    with ThreadPoolExecutor() as pool:  # hashing and reading release the interpreter lock
        shards = [listed[name] for name in sorted(listed) if name in present]
        for problem in track(pool.map(check, shards), "verifying", len(shards), "shards"):
            problems += [problem] if problem else []
    return problems


def sealed_manifest(manifest: dict[str, Any]) -> bytes:
    """The bytes of manifest.json: canonical JSON with the sha256 of all the rest inside."""
    rest = {key: value for key, value in manifest.items() if key != "manifest_sha256"}
    return canonical({**rest, "manifest_sha256": sha256(canonical(rest))})


def index_bytes(table: pa.Table) -> bytes:
    """The bytes of index.parquet for a table with the columns of `SCHEMA`; equal tables give equal bytes."""
    sink = io.BytesIO()
    pq.write_table(table.cast(SCHEMA), sink, compression="zstd", store_schema=True)
    return sink.getvalue()


def canonical(value: Any) -> bytes:
    """JSON with sorted keys: equal values give equal bytes."""
    return (json.dumps(value, indent=1, sort_keys=True, ensure_ascii=False) + "\n").encode()


def sha256(data: bytes) -> str:
    """Hex digest."""
    return hashlib.sha256(data).hexdigest()


class _Files:
    """The files of one folder, local or at any fsspec URL."""

    def __init__(self, root: str) -> None:
        from fsspec.core import url_to_fs

        self.fs, self.path = url_to_fs(str(root))

    def _at(self, name: str) -> str:
        return f"{self.path.rstrip('/')}/{name}"

    def is_folder(self) -> bool:
        return bool(self.fs.isdir(self.path))

    def has(self, name: str) -> bool:
        return bool(self.fs.exists(self._at(name)))

    def names(self) -> set[str]:
        return {entry.rstrip("/").rsplit("/", 1)[-1] for entry in self.fs.ls(self.path, detail=False)}

    def read(self, name: str) -> bytes:
        return bytes(self.fs.cat_file(self._at(name)))

    def blocks(self, name: str) -> Iterator[bytes]:
        with self.fs.open(self._at(name), "rb") as stream:
            while block := stream.read(_BLOCK):
                yield block


def _check_shard(files: _Files, shard: dict[str, Any]) -> str | None:
    digest, size = hashlib.sha256(), 0
    try:
        for block in files.blocks(shard["name"]):
            digest.update(block)
            size += len(block)
    except OSError as error:
        return f"{shard['name']} cannot be read: {error}"
    if size != shard["bytes"]:
        return f"{shard['name']} has {size:,} bytes, the manifest says {shard['bytes']:,}"
    if digest.hexdigest() != shard["sha256"]:
        return f"{shard['name']} has changed: its sha256 is not the manifest's"
    return None


def _read_manifest(raw: bytes) -> tuple[dict[str, Any], list[str]]:
    try:
        manifest = json.loads(raw)
    except ValueError as error:
        return {}, [f"{MANIFEST} is not valid JSON: {error}"]
    version = manifest.get("format_version") if isinstance(manifest, dict) else None
    if not isinstance(manifest, dict) or raw != sealed_manifest(manifest):
        return {}, [f"{MANIFEST} has changed: it does not agree with the sha256 inside it"]
    if version not in (_WITHOUT_POSITIONS, FORMAT_VERSION):
        return {}, [f"{MANIFEST} has format version {version}, this program reads {FORMAT_VERSION}: prepare again"]
    return manifest, []


def _read_table(raw: bytes, manifest: dict[str, Any]) -> tuple[pa.Table | None, list[str]]:
    if sha256(raw) != manifest["index_sha256"]:
        return None, [f"{INDEX} has changed: its sha256 is not the manifest's"]
    try:
        table = pq.read_table(io.BytesIO(raw))
    except (pa.ArrowInvalid, OSError) as error:
        return None, [f"{INDEX} cannot be read: {error}"]
    if manifest["format_version"] == _WITHOUT_POSITIONS:
        for name in ("lat", "lon"):
            table = table.append_column(name, pa.nulls(table.num_rows, pa.float64()))
    if table.schema.names != SCHEMA.names:
        return None, [f"{INDEX} has columns {table.schema.names}, expected {SCHEMA.names}"]
    if table.num_rows != manifest["counts"]["samples"]:
        return None, [f"{INDEX} has {table.num_rows:,} rows, the manifest says {manifest['counts']['samples']:,}"]
    return table.cast(SCHEMA), []
