"""Which database descriptors lie nearest to a query: exact L2 search with faiss in blocks.

Invariant: the exact answer does not depend on how much memory there is: the database may come in blocks from a file,
and the best k of all blocks are merged by (distance, row). Equal distances are therefore ordered by the lower row
number, which is file order; descriptors that differ by less than float32 rounding count as faiss computes them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from pipeline.common.errors import DataError

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
    check_finite(queries, "query")
    for numbers, block in database:
        check_finite(block, "database")
        for first in range(0, len(queries), QUERIES):
            part = slice(first, first + QUERIES)
            distances, found = _nearest(float32(queries[part]), float32(block), min(k, len(block)), gpu)
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


def _nearest(queries: np.ndarray, block: np.ndarray, k: int, gpu: bool) -> tuple[np.ndarray, np.ndarray]:
    import faiss

    if gpu and getattr(faiss, "get_num_gpus", lambda: 0)() > 0:
        distances, found = faiss.knn_gpu(faiss.StandardGpuResources(), queries, block, k)
    else:
        index = faiss.IndexFlatL2(block.shape[1])
        index.add(block)
        distances, found = index.search(queries, k)
    return distances, found


def float32(array: np.ndarray) -> np.ndarray:
    """An array as faiss takes it: float32, rows one after the other; copied only where it is not so already."""
    return np.ascontiguousarray(array, dtype=np.float32)


def check_finite(array: np.ndarray, side: str) -> None:
    """Raises `DataError` for descriptors that are not finite; `side`: query or database."""
    for first in range(0, len(array), ROWS):
        bad = ~np.isfinite(array[first : first + ROWS].astype(np.float32, copy=False).sum(axis=1))
        if bad.any():
            raise DataError(
                f"{side} descriptor {first + int(np.argmax(bad))} is not finite ({int(bad.sum())} of them): "
                "the model has diverged or its precision is too low; evaluate in fp32 or take an earlier checkpoint"
            )
