"""Which database descriptors lie nearest to a query: exact L2 search with faiss in blocks, and measured approximations.

Invariant: the exact answer does not depend on how much memory there is: the database may come in blocks from a file,
and the best k of all blocks are merged by (distance, row). Equal distances are therefore ordered by the lower row
number, which is file order; descriptors that differ by less than float32 rounding count as faiss computes them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.common.errors import DataError, UsageError

ROWS = 65_536  # database rows searched at once: their norms and faiss's temporaries, not the result, depend on it
SLICE_BYTES = 2**28  # and the bytes of an array that are taken at once
QUERIES = 4_096  # queries searched at once
QUERY_BYTES = 2**28  # and the bytes of queries in memory; each time so many the database is read once
Blocks = Callable[[], Iterable[tuple[np.ndarray, np.ndarray]]]
"""Gives the blocks (row numbers [n], descriptors [n, dim]) of a store or array afresh at each call."""


def slices(array: np.ndarray, rows: int = ROWS) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The blocks (row numbers [n], descriptors [n, dim]) of an array or memory map, at most `SLICE_BYTES` each."""
    rows = max(1, min(rows, SLICE_BYTES // max(1, array[:1].nbytes)))
    for first in range(0, len(array), rows):
        yield np.arange(first, min(first + rows, len(array))), array[first : first + rows]


def batches(queries: Blocks) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(row numbers [n], descriptors [n, dim]) of all queries as they come, some `QUERY_BYTES` at a time."""
    rows: list[np.ndarray] = []
    parts: list[np.ndarray] = []
    for numbers, block in queries():
        rows.append(numbers)
        parts.append(block)
        if sum(part.nbytes for part in parts) >= QUERY_BYTES:
            yield np.concatenate(rows), np.concatenate(parts)
            rows, parts = [], []
    if rows:
        yield np.concatenate(rows), np.concatenate(parts)


def search(
    queries: np.ndarray, database: Iterable[tuple[np.ndarray, np.ndarray]], k: int, gpu: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Exact nearest neighbours by squared L2.

    Args:
        queries: [Q, dim], converted to float32 block by block.
        database: blocks of (row numbers [n], descriptors [n, dim]), in any order, read once.
        k: neighbours a query.
        gpu: use a GPU where this faiss can; distances then differ by rounding.

    Returns:
        (squared distances float32 [Q, k], database rows int64 [Q, k]), best first; a database of fewer than k images
        pads with infinity and -1.

    Raises:
        DataError: descriptors that are not finite: their ranks would mean nothing.
    """
    best = np.full((len(queries), k), np.inf, np.float32)
    rows = np.full((len(queries), k), -1, np.int64)
    _finite(queries, "query")
    for numbers, block in database:
        _finite(block, "database")
        for first in range(0, len(queries), QUERIES):
            part = slice(first, first + QUERIES)
            distances, found = _nearest(_float32(queries[part]), _float32(block), min(k, len(block)), gpu)
            both = np.concatenate([best[part], distances], axis=1)
            candidates = np.concatenate([rows[part], numbers[found]], axis=1)
            order = np.lexsort((np.where(candidates < 0, np.iinfo(np.int64).max, candidates), both), axis=1)[:, :k]
            best[part] = np.take_along_axis(both, order, 1)
            rows[part] = np.take_along_axis(candidates, order, 1)
    return best, rows


def search_within(
    queries: np.ndarray, query_part: np.ndarray, database: Blocks, database_part: np.ndarray, k: int
) -> tuple[np.ndarray, np.ndarray]:
    """As `search`, each query among the database images of its own part alone (MSLS-challenge: its city)."""
    best = np.full((len(queries), k), np.inf, np.float32)
    rows = np.full((len(queries), k), -1, np.int64)
    for part in np.unique(query_part):
        own = np.flatnonzero(query_part == part)
        inside = ((numbers, block, database_part[numbers] == part) for numbers, block in database())
        best[own], rows[own] = search(queries[own], ((n[i], b[i]) for n, b, i in inside if i.any()), k)
    return best, rows


def build_index(blocks: Blocks, kind: str, seed: int = 0) -> Any:
    """A faiss index over the descriptors of `blocks`, answering with their row numbers, to be kept and searched often.

    ivfpq: about sqrt(n) lists of product-quantised residuals of at most 64 bytes, a tenth of the lists probed: some
    hundred times smaller than the descriptors. hnsw: a graph of 32 links a node over the full descriptors: no smaller,
    but far fewer distances a query. Training is seeded, so the same descriptors give the same index.
    """
    import faiss

    n, dim = 0, 0
    for _, block in blocks():
        n, dim = n + len(block), block.shape[1]
    if kind == "exact":
        inner: Any = faiss.IndexFlatL2(dim)
    elif kind == "hnsw":
        inner = faiss.IndexHNSWFlat(dim, 32)
        inner.hnsw.efConstruction, inner.hnsw.efSearch = 80, 128
    elif kind == "ivfpq":
        lists = max(1, round(n**0.5))
        codes = next(m for m in (64, 56, 48, 32, 16, 8, 4, 2, 1) if dim % m == 0)
        bits = 8 if n >= 256 else max(1, n.bit_length() - 1)
        inner = faiss.IndexIVFPQ(faiss.IndexFlatL2(dim), dim, lists, codes, bits)
        inner.cp.seed, inner.pq.cp.seed, inner.nprobe = seed, seed, max(1, lists // 10)
        inner.cp.min_points_per_centroid = inner.pq.cp.min_points_per_centroid = 1  # small sets warn otherwise
        every = max(1, n // max(64 * lists, 16_384))  # 64 points a centroid are enough to train on
        inner.train(np.concatenate([_float32(block[::every]) for _, block in blocks()]))
    else:
        raise UsageError(f"search is '{kind}'; it can be exact, ivfpq or hnsw")
    index = faiss.IndexIDMap(inner)
    for numbers, block in blocks():
        index.add_with_ids(_float32(block), numbers.astype(np.int64))
    return index


def search_index(index: Any, queries: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """(squared distances [Q, k], rows [Q, k]) of an index; -1 where it found fewer."""
    parts = [index.search(_float32(queries[first : first + QUERIES]), k) for first in range(0, len(queries), QUERIES)]
    return np.concatenate([d for d, _ in parts]), np.concatenate([r for _, r in parts]).astype(np.int64)


def agreement(approximate: np.ndarray, exact: np.ndarray) -> float:
    """Percent of the exact neighbours [Q, k] that an approximation [Q, k] also found: recall against exact."""
    hits = sum(len(np.intersect1d(a[a >= 0], e[e >= 0])) for a, e in zip(approximate, exact, strict=True))
    return 100.0 * hits / max(1, int((exact >= 0).sum()))


def index_bytes(index: Any) -> int:
    """Size of the index when saved, and about its size in memory, counted without a copy of it."""
    import faiss

    total = 0

    def count(piece: bytes) -> None:
        nonlocal total
        total += len(piece)

    faiss.write_index(index, faiss.PyCallbackIOWriter(count))  # type: ignore[attr-defined]
    return total


def save_index(index: Any, path: Path) -> None:
    """Writes an index so that a reader never sees half of it."""
    import faiss

    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_name(path.name + ".tmp")
    faiss.write_index(index, str(fresh))
    fresh.replace(path)


def load_index(path: Path) -> Any:
    """Opens an index of `save_index`. Raises `DataError` for a file that is none.

    Exact and hnsw vectors stay in the file, mapped, so that an index larger than memory answers from the disk.
    """
    import faiss

    try:
        return faiss.read_index(str(path), getattr(faiss, "IO_FLAG_MMAP_IFC", 0))  # older faiss reads all of it
    except RuntimeError as error:
        reason = str(error).splitlines()[0]
        raise DataError(f"{path}: not a readable faiss index ({reason}); build it again") from None


def _nearest(queries: np.ndarray, block: np.ndarray, k: int, gpu: bool) -> tuple[np.ndarray, np.ndarray]:
    import faiss

    if gpu and getattr(faiss, "get_num_gpus", lambda: 0)() > 0:
        distances, found = faiss.knn_gpu(faiss.StandardGpuResources(), queries, block, k)
    else:
        index = faiss.IndexFlatL2(block.shape[1])
        index.add(block)
        distances, found = index.search(queries, k)
    return distances, found


def _float32(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array, dtype=np.float32)


def _finite(array: np.ndarray, side: str) -> None:
    for first in range(0, len(array), ROWS):
        bad = ~np.isfinite(array[first : first + ROWS].astype(np.float32, copy=False).sum(axis=1))
        if bad.any():
            raise DataError(
                f"{side} descriptor {first + int(np.argmax(bad))} is not finite ({int(bad.sum())} of them): "
                "the model has diverged or its precision is too low; evaluate in fp32 or take an earlier checkpoint"
            )
