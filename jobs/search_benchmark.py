"""What approximate search and PCA cost and keep: recall against exact, bytes, seconds; on made or stored descriptors.

    python -m jobs.search_benchmark                                  100,000 x 256, made of clusters
    python -m jobs.search_benchmark --store outputs/RUN/evaluation/descriptors/SET/single
    python -m jobs.search_benchmark --pca 4096 --rows 16384 --dim 10752      PCA instead; --sklearn for its own beside

Each measurement runs in a process of its own, so that its peak memory is its own. Seconds of CPU tell what a machine
that others use as well would need alone.
"""

from __future__ import annotations

import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jobs.cli import parse, run_job
from pipeline.common.errors import DataError, UsageError

BLOCK = 2_048  # rows made or read at a time


@dataclass(frozen=True)
class SearchBenchmarkJob:
    """Measure search, or PCA where `pca` is given."""

    rows: int = 100_000
    """Database descriptors."""
    dim: int = 256
    """Numbers a descriptor."""
    queries: int = 1_000
    """Queries; of a store all of its own."""
    recalls: tuple[int, ...] = (1, 10)
    """Neighbours looked at: percent of the exact ones that were also found."""
    kinds: tuple[str, ...] = ("exact", "hnsw", "ivfpq")
    """What is measured."""
    store: str | None = None
    """A folder of stored descriptors (it holds database/ and queries/) instead of made ones."""
    pca: int | None = None
    """Measure PCA to so many dimensions instead of search."""
    sklearn: bool = False
    """Measure scikit-learn's PCA beside ours."""
    timeout: float = 600.0
    """Seconds after which one measurement is given up, and said so."""
    seed: int = 0
    """Of the made descriptors."""


def main() -> None:
    """Makes or opens the descriptors, measures, prints a table."""
    job = parse(SearchBenchmarkJob, __doc__ or "")
    from pipeline.benchmark.own_process import alone

    threads = os.environ.get("OMP_NUM_THREADS", "all")
    with tempfile.TemporaryDirectory() as scratch:
        if job.pca:
            print(f"PCA of {job.rows:,} x {job.dim:,} to {job.pca:,}, threads: {threads}", flush=True)
            file = Path(scratch) / "rows.bin"
            make(file, job.rows, job.dim, job.seed, spectrum=True)
            for kind in ("ours", "scikit-learn") if job.sklearn else ("ours",):
                print(
                    f"{kind:<14}{_line(alone(_pca, job.timeout, kind, str(file), job.rows, job.dim, job.pca))}",
                    flush=True,
                )
            return
        database, queries, n, asked, dim = descriptors(job, Path(scratch))
        print(f"{asked:,} queries in {n:,} x {dim} descriptors, threads: {threads}", flush=True)
        for kind in job.kinds:
            print(
                f"{kind:<8}{_line(alone(_search, job.timeout, kind, database, queries, dim, job.recalls))}", flush=True
            )


def make(file: Path, rows: int, dim: int, seed: int, spectrum: bool = False, centres: int = 5_000) -> None:
    """Writes float32 [rows, dim] of unit length to `file`, a block at a time.

    Clusters (places seen several times) by default; with `spectrum` a variance that falls as 1/i along directions that
    two reflections mix, like that of descriptors.
    """
    import numpy as np

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


def descriptors(job: SearchBenchmarkJob, scratch: Path) -> tuple[str, str, int, int, int]:
    """(database, queries, their numbers, dimensions): raw float32 files, made or copied out of a store."""
    files = scratch / "database.bin", scratch / "queries.bin"
    if job.store is None:
        make(files[0], job.rows, job.dim, job.seed)
        make(files[1], job.queries, job.dim, job.seed + 1)
        return str(files[0]), str(files[1]), job.rows, job.queries, job.dim
    import numpy as np

    from pipeline.evaluation.describe.store import DescriptorStore

    stores = [DescriptorStore(Path(job.store) / side) for side in ("database", "queries")]
    for store, file in zip(stores, files, strict=True):
        whole = np.memmap(file, np.float32, "w+", shape=(len(store), store.dim))
        for rows, block in store.blocks():
            whole[rows] = block
        whole.flush()
    if stores[0].dim != stores[1].dim:
        raise DataError(f"{job.store}: database and queries have descriptors of different lengths; evaluate again")
    return str(files[0]), str(files[1]), len(stores[0]), len(stores[1]), stores[0].dim


def _line(got: Any) -> str:
    """What `alone` measured."""
    return got.problem or f"{got.answer}  peak {got.peak / 1e9:.2f} GB"


def _search(kind: str, database: str, queries: str, dim: int, ks: tuple[int, ...]) -> str:
    import numpy as np

    from pipeline.evaluation.search.exact import agreement, build_index, index_bytes, search, search_index, slices

    rows = np.memmap(database, np.float32, "r").reshape(-1, dim)
    asked = np.fromfile(queries, np.float32).reshape(-1, dim)
    k = max(ks)
    start = time.perf_counter()
    index = build_index(lambda: slices(rows), kind)
    built = time.perf_counter() - start
    start = time.perf_counter()
    found = search_index(index, asked, k)[1]
    seconds = time.perf_counter() - start
    exact = found if kind == "exact" else search(asked, slices(rows), k)[1]
    kept = "  ".join(f"{n} of {n}: {agreement(found[:, :n], exact[:, :n]):5.1f} %" for n in ks)
    size, speed = index_bytes(index) / 1e6, 1e3 * seconds / len(asked)
    return f"exact neighbours found {kept}  index {size:8.1f} MB  built {built:6.1f} s  {speed:7.3f} ms a query"


def _pca(kind: str, file: str, rows: int, dim: int, dims: int) -> str:
    import numpy as np

    def blocks() -> Any:
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


if __name__ == "__main__":
    run_job(main)
