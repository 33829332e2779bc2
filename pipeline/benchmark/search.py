"""What approximate search and PCA cost and keep: recall against exact, bytes, seconds; on made or stored descriptors.

Invariant: each measurement runs in a process of its own, so that its peak memory is its own. Seconds of CPU tell what a
machine that others use as well would need alone.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from pipeline.benchmark.own_process import Measured, alone
from pipeline.common.errors import DataError, UsageError

BLOCK = 2_048  # rows made or read at a time


def searches(
    store: str | None, rows: int, dim: int, queries: int, kinds: Sequence[str], refine: int, recalls: Sequence[int],
    timeout: float, seed: int,
) -> Iterator[str]:  # fmt: skip
    """A line for each kind of search.

    Args:
        store: folder of stored descriptors (it holds database/ and queries/); none: made ones, [rows, dim].
        rows, dim, queries: sizes of made descriptors.
        kinds: `exact` and faiss's approximations.
        refine: candidates of the kinds of codes that float descriptors order anew.
        recalls: the n of "percent of the n exact neighbours that were found".
        timeout: seconds after which one measurement is given up, and said so.
        seed: of made descriptors.
    """
    with tempfile.TemporaryDirectory() as scratch:
        database, asked, counts, dim = descriptors(store, rows, dim, queries, seed, Path(scratch))
        yield f"{counts[1]:,} queries in {counts[0]:,} x {dim} descriptors, threads: {_threads()}"
        for kind in kinds:
            yield f"{kind:<8}{_line(alone(_search, timeout, kind, refine, database, asked, dim, tuple(recalls)))}"


def projections(rows: int, dim: int, dims: int, beside_sklearn: bool, timeout: float, seed: int) -> Iterator[str]:
    """A line of our PCA of made descriptors [rows, dim] to `dims`, and one of scikit-learn's where asked."""
    with tempfile.TemporaryDirectory() as scratch:
        yield f"PCA of {rows:,} x {dim:,} to {dims:,}, threads: {_threads()}"
        file = Path(scratch) / "rows.bin"
        make(file, rows, dim, seed, spectrum=True)
        for kind in ("ours", "scikit-learn") if beside_sklearn else ("ours",):
            yield f"{kind:<14}{_line(alone(_pca, timeout, kind, str(file), rows, dim, dims))}"


def make(file: Path, rows: int, dim: int, seed: int, spectrum: bool = False, centres: int = 5_000) -> None:
    """Writes float32 [rows, dim] of unit length to `file`, a block at a time.

    Clusters (places seen several times) by default; with `spectrum` a variance that falls as 1/i along directions that
    two reflections mix, like that of descriptors.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    fixed = np.random.Generator(np.random.PCG64(12_345))  # places and directions are the same for every seed
    middle = np.zeros((1, dim)) if spectrum else fixed.normal(size=(centres, dim)).astype(np.float32)
    mirrors = fixed.normal(size=(2, dim))
    mirrors /= np.linalg.norm(mirrors, axis=1, keepdims=True)
    with file.open("wb") as out:
        for first in range(0, rows, BLOCK):
            noise = rng.standard_normal((min(BLOCK, rows - first), dim), np.float32)
            if spectrum:
                part = noise / np.sqrt(np.arange(1, dim + 1, dtype=np.float32))
                for mirror in mirrors.astype(np.float32):
                    part -= 2 * np.outer(part @ mirror, mirror)
            else:
                part = middle[rng.integers(0, centres, len(noise))] + 0.8 * noise
            part /= np.linalg.norm(part, axis=1, keepdims=True)
            out.write(part.astype(np.float32).tobytes())


def descriptors(
    folder: str | None, rows: int, dim: int, queries: int, seed: int, scratch: Path
) -> tuple[str, str, tuple[int, int], int]:
    """(database, queries, their numbers, dimensions): raw float32 files, made or copied out of a store."""
    files = scratch / "database.bin", scratch / "queries.bin"
    if folder is None:
        make(files[0], rows, dim, seed)
        make(files[1], queries, dim, seed + 1)
        return str(files[0]), str(files[1]), (rows, queries), dim
    from pipeline.evaluation.describe.store import DescriptorStore

    stores = [DescriptorStore(Path(folder) / side) for side in ("database", "queries")]
    for store, file in zip(stores, files, strict=True):
        whole = np.memmap(file, np.float32, "w+", shape=(len(store), store.dim))
        for numbers, block in store.blocks():
            whole[numbers] = block
        whole.flush()
    if stores[0].dim != stores[1].dim:
        raise DataError(f"{folder}: database and queries have descriptors of different lengths; evaluate again")
    return str(files[0]), str(files[1]), (len(stores[0]), len(stores[1])), stores[0].dim


def _threads() -> str:
    return os.environ.get("OMP_NUM_THREADS", "all")


def _line(got: Measured) -> str:
    """What `alone` measured."""
    return got.problem or f"{got.answer}  peak {got.peak / 1e9:.2f} GB"


def _search(kind: str, refine: int, database: str, queries: str, dim: int, ks: tuple[int, ...]) -> str:
    from pipeline.evaluation.search.approximate import agreement, build_index, index_bytes, search_index
    from pipeline.evaluation.search.exact import search, slices

    rows = np.memmap(database, np.float32, "r").reshape(-1, dim)
    asked = np.fromfile(queries, np.float32).reshape(-1, dim)
    k = max(ks)
    start = time.perf_counter()
    index = build_index(lambda: slices(rows), kind, refine > 0)
    built = time.perf_counter() - start
    start = time.perf_counter()
    found = search_index(index, asked, k, refine)[1]
    seconds = time.perf_counter() - start
    exact = found if kind == "exact" else search(asked, slices(rows), k)[1]
    kept = "  ".join(f"{n} of {n}: {agreement(found[:, :n], exact[:, :n]):5.1f} %" for n in ks)
    size, speed = index_bytes(index) / 1e6, 1e3 * seconds / len(asked)
    return f"exact neighbours found {kept}  index {size:8.1f} MB  built {built:6.1f} s  {speed:7.3f} ms a query"


def _pca(kind: str, file: str, rows: int, dim: int, dims: int) -> str:
    def blocks() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        with Path(file).open("rb") as source:
            for first in range(0, rows, BLOCK):
                block = np.fromfile(source, np.float32, min(BLOCK, rows - first) * dim).reshape(-1, dim)
                yield np.arange(first, first + len(block)), block

    if kind == "ours":
        from pipeline.evaluation.search.projection import fit_rows

        start, busy = time.perf_counter(), time.process_time()
        explained = fit_rows(blocks, np.arange(rows), dims).explained
    else:
        try:
            from sklearn.decomposition import PCA
        except ImportError:
            raise UsageError("scikit-learn is not installed; leave out --sklearn") from None

        start, busy = time.perf_counter(), time.process_time()
        explained = float(PCA(dims).fit(np.concatenate([b for _, b in blocks()])).explained_variance_ratio_.sum())
    seconds = f"{time.perf_counter() - start:7.1f} s  {time.process_time() - busy:7.1f} s of CPU"
    return f"{seconds}  variance kept {explained:.5f}"
