"""What a descriptor store costs at size: each step in a process of its own, with made descriptors in a real store.

Invariant: rows are a pure function of their number, so that no step ever needs them all: row i belongs to place
i mod `PLACES`, and query j is another view of database row j * `APART`, which alone is its positive. A step's peak
memory is that of its process; `baseline` is that of one that only loads what the steps load.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import overload

import numpy as np

from pipeline.config import EvaluationConfig
from pipeline.evaluation.describe.encode import BLOCK_BYTES
from pipeline.evaluation.describe.store import DescriptorStore, StoreKey, StoreWriter
from pipeline.evaluation.describe.stored import evaluate_stores
from pipeline.evaluation.protocol import Protocol, Side, protocols
from pipeline.evaluation.search.exact import batches, search
from pipeline.evaluation.search.projection import fit_rows, projected, sample_rows
from pipeline.evaluation.sets.evaluation_set import EvaluationSet

PLACES, APART = 4_096, 97
NAME = "made"


class Numbered(Sequence[Path]):
    """n file names that are made when they are asked for: the files of a set, without the memory of their list."""

    def __init__(self, side: Side, rows: int) -> None:
        self.side, self.rows = side, rows

    def __len__(self) -> int:
        return self.rows

    @overload
    def __getitem__(self, index: int) -> Path: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Path]: ...
    def __getitem__(self, index: int | slice) -> Path | Sequence[Path]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(self.rows))]
        if not 0 <= index < self.rows:
            raise IndexError(index)
        return Path(f"data/{NAME}/images/test/{self.side}/@{500_000 + index:010.2f}@4400000.00@30@T@@@@@.jpg")


def protocol(stored: str) -> Protocol:
    """Each image alone, kept as `stored` (fp16, fp32)."""
    config = EvaluationConfig(groups=("single",), store=stored)  # type: ignore[arg-type]
    return protocols(config, 224, "pairs")[0].grouping


def made(rows: np.ndarray, dim: int, view: int) -> np.ndarray:
    """float32 [n, dim] of unit length: a place, the row's own part, and a little noise of the `view`."""
    places = np.random.Generator(np.random.PCG64(1)).standard_normal((PLACES, dim), np.float32)
    values = places[rows % PLACES]
    for at, row in enumerate(rows.tolist()):
        values[at] += 0.7 * np.random.Generator(np.random.SFC64(row)).standard_normal(dim, np.float32)
    noise = np.random.Generator(np.random.PCG64([view, int(rows[0])]))
    values += 0.2 * noise.standard_normal(values.shape, np.float32)
    return values / np.linalg.norm(values, axis=1, keepdims=True)


def parts(rows: int, dim: int) -> Iterator[np.ndarray]:
    """The row numbers of each part, as many as the evaluation puts in one."""
    size = max(1, BLOCK_BYTES // (4 * dim))
    for first in range(0, rows, size):
        yield np.arange(first, min(first + size, rows))


def write(output: Path, rows: int, queries: int, dim: int, stored: str) -> float:
    """Seconds to make and write both sides."""
    start = time.perf_counter()
    for side, count in (("database", rows), ("queries", queries)):
        key = StoreKey(NAME, side, "made", "made", protocol(stored))  # type: ignore[arg-type]
        blocks = list(parts(count, dim))
        writer = StoreWriter(output, key, Numbered(side, count), None, len(blocks))  # type: ignore[arg-type]
        for number, block in enumerate(blocks):
            of_database = block if side == "database" else block * APART
            writer.put(number, block, made(of_database, dim, int(side == "queries")))
    return time.perf_counter() - start


def baseline() -> float:
    """Nothing but loading the libraries, and one small product, search and decomposition."""
    blocks = np.eye(8, 4, dtype=np.float32)
    search(blocks, [(np.arange(8), blocks)], 1)
    fit_rows(lambda: [(np.arange(8), blocks)], np.arange(8), 2)
    return 0.0


def read(output: Path) -> float:
    """Seconds to read all descriptors of the database, and to compare the names of its images."""
    store, start = _store(output, "database"), time.perf_counter()
    rows = sum(len(numbers) for numbers, _ in store.blocks())
    if rows != len(store) or not store.holds(Numbered("database", rows)):
        raise AssertionError(f"{rows} rows of {len(store)}, or other images")
    return time.perf_counter() - start


def find(output: Path, k: int) -> float:
    """Seconds of the exact search of all queries in the store."""
    database, queries, start = _store(output, "database"), _store(output, "queries"), time.perf_counter()
    for _, asked in batches(queries.blocks):
        search(asked, database.blocks(), k)
    return time.perf_counter() - start


def fit(output: Path, dims: int, everything: bool) -> float:
    """Seconds of a PCA of the sample that evaluations take, or of all rows."""
    store, start = _store(output, "database"), time.perf_counter()
    fit_rows(store.blocks, np.arange(len(store)) if everything else sample_rows(len(store)), dims)
    return time.perf_counter() - start


def project(output: Path, dims: int) -> float:
    """Seconds to project all rows, read from the store, beside the fit."""
    store = _store(output, "database")
    fitted = fit_rows(store.blocks, sample_rows(len(store), 2_048), min(dims, 1_024))
    start = time.perf_counter()
    for _, block in projected(store.blocks, fitted)():
        block.sum()
    return time.perf_counter() - start


def recalls(output: Path, dims: int, k: int) -> tuple[float, list[float]]:
    """(Seconds, R@1 without and with PCA) of `evaluate_stores`."""
    rows, queries = len(_store(output, "database")), len(_store(output, "queries"))
    positives = [np.array([query * APART], np.int64) for query in range(queries)]
    files = [Numbered("database", rows), Numbered("queries", queries)]
    evaluated = EvaluationSet(NAME, files[0], files[1], positives, "pairs")  # type: ignore[arg-type]
    config = dataclasses.replace(EvaluationConfig(), recalls=(1, k), groups=("single",))
    start = time.perf_counter()
    results = evaluate_stores(output, [evaluated], config, (None, dims))
    return time.perf_counter() - start, [result.recalls[1] for result in results]


def _store(output: Path, side: Side) -> DescriptorStore:
    folders = sorted(output.glob(f"descriptors/{NAME}/*/{side}"))
    return DescriptorStore(folders[0])
