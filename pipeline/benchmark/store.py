"""What a descriptor store costs at size: each step in a process of its own, with made descriptors in a real store.

Invariant: rows are a pure function of their number, so that no step ever needs them all: row i belongs to place
i mod `PLACES`, and query j is another view of database row j * `APART`, which alone is its positive. A step's peak
memory is that of its process; `baseline` is that of one that only loads what the steps load.
"""

from __future__ import annotations

import dataclasses
import os
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np

from pipeline.benchmark.own_process import alone
from pipeline.common.errors import DataError, UsageError
from pipeline.config import EvaluationConfig
from pipeline.evaluation.describe.encode import BLOCK_BYTES
from pipeline.evaluation.describe.store import DescriptorStore, StoreWriter, store_folder
from pipeline.evaluation.describe.stored import evaluate_stores
from pipeline.evaluation.identity import Identity
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
        under = protocol(stored)
        blocks = list(parts(count, dim))
        writer = StoreWriter(
            store_folder(output, NAME, under, side), Identity(side, "made", "made", under),
            Numbered(side, count), None, len(blocks),  # type: ignore[arg-type]
        )  # fmt: skip
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
    results = evaluate_stores(output, [evaluated], config, (dims,))
    return time.perf_counter() - start, [result.recalls[1] for result in results]


def measure(
    sizes: Sequence[tuple[int, int]], queries: int, stored: str, dims: int, recall: int, folder: str | None,
    timeout: float,
) -> Iterator[str]:  # fmt: skip
    """Writes a store of each size and measures every step in a process of its own; a line a step.

    Args:
        sizes: (rows, dimensions) of the database.
        queries: each another view of a known row.
        stored: fp16 or fp32.
        dims: dimensions that PCA keeps.
        recall: neighbours searched.
        folder: where stores are written and removed again; none: the temporary folder.
        timeout: seconds after which a step is given up, and said so.

    Raises:
        UsageError: more queries than the rows allow; DataError: not enough room on the disk.
    """
    for rows, _ in sizes:
        if (queries - 1) * APART >= rows:
            raise UsageError(f"--queries {queries} needs more than {(queries - 1) * APART:,} rows")
    base = alone(baseline, timeout).peak
    threads = os.environ.get("OMP_NUM_THREADS", "all")
    yield f"threads {threads}, {queries} queries, stored {stored}, PCA to {dims}; libraries alone {base / 1e6:,.0f} MB"
    yield f"\n{'rows x dim':>18}  {'step':<14}{'peak MB':>9}{'above libraries':>17}{'seconds':>10}"
    for rows, dim in sizes:
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            need = rows * (dim * (2 if stored == "fp16" else 4) + 200)
            if shutil.disk_usage(scratch).free < 1.1 * need:
                raise DataError(f"{scratch}: {rows} x {dim} need {need / 1e9:.1f} GB; give another --folder")
            for name, work, arguments in steps(Path(scratch), rows, dim, queries, stored, dims, recall):
                got = alone(work, timeout, *arguments)
                seconds, note = (got.answer, "") if isinstance(got.answer, float) else (got.answer or (0.0, ""))
                if note:
                    note = "  R@1 " + " / ".join(f"{value:.1f}" for value in note)
                if name == "write" and not got.problem:
                    size = sum(f.stat().st_size for f in Path(scratch).rglob("*.parquet"))
                    note = f"  {size / 1e6:,.0f} MB on disk"
                figures = f"{got.peak / 1e6:9,.0f}{(got.peak - base) / 1e6:17,.0f}{seconds:10,.1f}{note}"
                yield f"{f'{rows:,} x {dim:,}':>18}  {name:<14}{got.problem or figures}"
                if got.problem and name == "write":
                    break


def steps(
    folder: Path, rows: int, dim: int, queries: int, stored: str, dims: int, recall: int
) -> list[tuple[str, Callable[..., Any], tuple[Any, ...]]]:
    """(Name, work, its arguments) of every step."""
    return [
        ("write", write, (folder, rows, queries, dim, stored)),
        ("read", read, (folder,)),
        ("exact search", find, (folder, recall)),
        ("PCA, sample", fit, (folder, dims, False)),
        ("PCA, all rows", fit, (folder, dims, True)),
        ("project", project, (folder, dims)),
        ("recalls", recalls, (folder, dims, recall)),
    ]


def parse_size(text: str) -> tuple[int, int]:
    """(rows, dimensions) of `100000x256`. Raises `UsageError`."""
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    if found is None:
        raise UsageError(f"--sizes {text}: give rows x dimensions, such as 100000x256")
    return int(found[1]), int(found[2])


def _store(output: Path, side: Side) -> DescriptorStore:
    folders = sorted(output.glob(f"descriptors/{NAME}/*/{side}"))
    return DescriptorStore(folders[0])
