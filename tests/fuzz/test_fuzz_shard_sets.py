"""Edited manifests, indexes and tars: one line with code 3, never a traceback, a hang or an acceptance in silence.

An edited file is sealed again, so that no hash betrays it: what is tried is the check of what it says.
"""

from __future__ import annotations

import io
import json
import os
import random
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import simplejpeg

from pipeline.common.errors import DataError
from shards import index, schema
from shards.sources.registry import read_source
from shards.writer import WriteRule, write_shards
from tests.support.mutations import Tally

ODD: list[Any] = [
    None, True, -1, 0, 1, 3, 1.5, 1 << 70, 10**400, "", "x", "../x.tar", "/etc/x", "a/b.tar", "a\\b.tar", "..", ".",
    "x\0.tar", "x\n.tar", "\x1b[31m.tar", "memory::x.tar", "x.pth", "x" * 300 + ".tar", [], {}, [[]], {"a": {}},
    "round-00-00000.tar", "\u202e", "0" * 64,
]  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("fuzz")
    noise = np.random.default_rng(0).integers(0, 256, (99, 24, 32, 3), dtype=np.uint8)
    for place in range(9):
        (root / "source" / "ab"[place % 2] / str(place)).mkdir(parents=True)
        for n in range(4 + place % 3):
            (root / "source" / "ab"[place % 2] / str(place) / f"{n}.jpg").write_bytes(
                simplejpeg.encode_jpeg(noise[10 * place + n])
            )
    write_shards(read_source(root / "source"), root / "set", WriteRule(2, workers=1, shard_mb=0.03))
    return root / "set"


def nodes(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path of every value inside a JSON document."""
    for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield (*path, key)
        yield from nodes(value[key], (*path, key))


def edited_manifest(manifest: dict[str, Any], rng: random.Random) -> tuple[str, bytes]:
    manifest = json.loads(json.dumps(manifest))
    checked = [p for p in nodes(manifest) if p[0] != "settings" and p != ("report_sha256",)]
    where = rng.choice(checked)
    parent = manifest
    for key in where[:-1]:
        parent = parent[key]
    before, how = parent[where[-1]], rng.choice(["value", "value", "value", "delete", "add", "text", "raw"])
    if how == "delete" or (how == "add" and not isinstance(before, int)):
        del parent[where[-1]]
    elif how == "add":
        parent[where[-1]] = before + rng.choice([-1, 1, 1000])
    elif how == "text":
        parent[where[-1]] = str(before) + rng.choice("x/ \0\n")
    else:
        parent[where[-1]] = rng.choice([odd for odd in ODD if odd != before])
    raw = schema.sealed_manifest(manifest)
    if how == "raw":  # what no JSON writer writes
        at = rng.randrange(len(raw))
        raw = rng.choice([
            raw[:at], raw[:at] + bytes([rng.randrange(256)]) + raw[at + 1 :], b"[" * 100_000, b'{"a":' * 100_000,
            raw.decode().encode("utf-16"), b"\xef\xbb\xbf" + raw, raw.replace(b"2", b"NaN", 1), b"9" * 5000, b"null",
            raw.replace(b'"counts"', b'"counts": {}, "counts"', 1), raw.replace(b'"left_out"', b'"\\ud800"', 1),
            raw.replace(b" 2", b" 1e999", 1),
        ])  # fmt: skip
    return f"{how} at {where}", raw


def edited_index(table: pa.Table, rng: random.Random) -> tuple[str, bytes]:
    columns = {name: table[name].to_pylist() for name in table.schema.names}
    types, n = {field.name: field.type for field in table.schema}, table.num_rows
    name, row, other = rng.choice(table.schema.names), rng.randrange(n), rng.randrange(1, n)
    other = (row + other) % n
    how = rng.choice(
        ["null", "null", "same", "half", "swap", "copy", "odd", "odd", "odd", "type", "drop", "order", "raw"]
    )
    if how == "null":
        columns[name][row] = None if name not in ("offsets", "sizes") or rng.random() < 0.5 else [1, None, 2, 3]
        if columns[name] == table[name].to_pylist():  # positions of this set are null anyway
            columns["sample"] = [None] * n
    elif how == "same":
        name = rng.choice([name for name in columns if name not in ("lat", "lon")])
        columns[name] = [columns[name][row]] * n
    elif how == "half":
        keep = sorted(rng.sample(range(n), rng.choice([n // 2, n - 1, 1, 0])))
        columns = {name: [values[i] for i in keep] for name, values in columns.items()}
    elif how in ("swap", "copy"):
        name = rng.choice(["sample", "round", "place", "city", "place_id", "shard", "offsets"])
        if columns[name][row] == columns[name][other]:
            name = "sample"
        former = columns[name][row]
        columns[name][row] = columns[name][other]
        columns[name][other] = former if how == "swap" else columns[name][other]
    elif how == "odd":
        number = rng.choice([-1, 1 << 30, 2, -(1 << 31)])
        big = rng.choice([-1, 0, 1 << 40, (1 << 63) - 1, -(1 << 63), 513])
        text = rng.choice(["", "../x", "x\0", "\x1b[0m", "x" * 5000, "000001\n", "é", "7"])
        degrees = rng.choice([float("nan"), float("inf"), 91.0, -200.0, 1.0])
        values = {pa.string(): text, pa.int32(): number, pa.int64(): big, pa.float64(): degrees}
        columns[name][row] = values.get(types[name], [512, big, big, big])
    elif how == "type":
        kinds = [pa.string(), pa.int64(), pa.float64(), pa.binary(), pa.list_(pa.int64()), pa.null(), pa.bool_()]
        types[name] = rng.choice([kind for kind in kinds if kind != types[name]])
        filler = {pa.string(): "1", pa.int64(): 1, pa.float64(): 1.0, pa.binary(): b"1", pa.bool_(): True}
        columns[name] = [filler.get(types[name])] * n
    elif how == "drop":
        if rng.random() < 0.5:
            renamed = "extra" if rng.random() < 0.5 else name + "\n"
            columns[renamed], types[renamed] = columns.pop(name), types[name]
        else:
            del columns[name]
    elif how == "order":
        keep = [*range(n)]
        rng.shuffle(keep)
        columns = {name: [values[i] for i in keep] for name, values in columns.items()}
    kept = pa.table({name: pa.array(values, types[name]) for name, values in columns.items()})
    sink = io.BytesIO()
    pq.write_table(kept, sink)
    raw = sink.getvalue()
    if how == "raw":
        at = rng.choice([rng.randrange(len(raw)), len(raw) - 1 - rng.randrange(400)])
        raw = rng.choice(
            [raw[:at], raw[:at] + bytes([raw[at] ^ 1 << rng.randrange(8)]) + raw[at + 1 :], b"PAR1PAR1", b""]
        )
    return f"{how} {name} row {row}", raw


def same_table(raw: bytes, whole: Path) -> bool:
    """Whether an edit changed nothing: a value set to itself, a bit that no reader looks at."""
    try:
        return bool(pq.read_table(io.BytesIO(raw)).equals(index.read_index(str(whole)).table))
    except Exception:
        return False


def mutate(whole: Path, folder: Path, rng: random.Random) -> tuple[str, bool]:
    """Makes an edited copy of a set in `folder`; says what was edited, and whether that changes nothing of account."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(whole, folder)
    manifest = json.loads((whole / schema.MANIFEST).read_bytes())
    kind = rng.choice(["manifest", "manifest", "index", "index", "tar"])
    if kind == "manifest":
        what, raw = edited_manifest(manifest, rng)
        (folder / schema.MANIFEST).write_bytes(raw)
        told_only = any(
            f"'{name}'" in what for name in ("unlisted", "duplicates", "made_again")
        )  # nothing adds them up
        return f"manifest: {what}", told_only or raw == schema.sealed_manifest(manifest)
    if kind == "index":
        what, raw = edited_index(index.read_index(str(whole)).table, rng)
        manifest["index_sha256"] = schema.sha256(raw)
        (folder / schema.INDEX).write_bytes(raw)
        (folder / schema.MANIFEST).write_bytes(schema.sealed_manifest(manifest))
        return f"index: {what}", same_table(raw, whole)
    tar = rng.choice(sorted(folder.glob("*.tar")))
    raw = tar.read_bytes()
    at = rng.randrange(len(raw))
    how = rng.choice(["cut", "bit", "gone", "longer", "exchanged", "empty", "pipe"])
    other = rng.choice([path for path in sorted(folder.glob("*.tar")) if path != tar]).read_bytes()
    edited = {"cut": raw[:at], "bit": raw[:at] + bytes([raw[at] ^ 4]) + raw[at + 1 :], "longer": raw + b"x" * 512,
              "exchanged": other, "empty": b""}  # fmt: skip
    tar.unlink()
    if how == "pipe":
        os.mkfifo(tar)
    elif how != "gone":
        tar.write_bytes(edited[how])
    return f"tar: {how} {tar.name} at {at}", False


@pytest.mark.parametrize("cases", [60, pytest.param(400, marks=pytest.mark.slow)])
def test_edited_shard_sets(cases: int, whole: Path, tmp_path: Path) -> None:
    """Most are refused when the set is opened; edits that lead to other bytes of a shard only by --verify, and by
    training when it reads them."""
    tally, late = Tally(), 0

    def open_and_verify() -> None:
        nonlocal late
        index.read_index(str(tmp_path / "edited"))
        problems = index.verify(str(tmp_path / "edited"))
        late += bool(problems)
        if problems:
            raise DataError(problems[0])

    for seed in range(cases):
        what, harmless = mutate(whole, tmp_path / "edited", random.Random(f"{cases} {seed}"))
        tally.run(f"case {seed}: {what}", open_and_verify, (3,), harmless)
    print(f"\nedited shard sets: {tally} ({late} of the lines by --verify)")
    assert not tally.faults, "\n".join(tally.faults)
