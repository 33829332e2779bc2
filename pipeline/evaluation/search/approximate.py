"""Indexes of descriptors that are built once and searched often: exact ones, and approximations whose loss is measured.

Invariant: an index answers with the row numbers of its descriptors; an approximate search never passes for an exact
one: `agreement` says how many of the exact neighbours it found, and the protocol carries its name.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.common.errors import DataError, UsageError
from pipeline.common.files import replacing
from pipeline.evaluation.search.exact import QUERIES, Blocks, float32

CODES = ("int8", "binary", "ivfpq")  # kinds that keep codes instead of floats: floats beside them can order anew


def build_index(blocks: Blocks, kind: str, refine: bool = False, seed: int = 0) -> Any:
    """A faiss index over the descriptors of `blocks`, answering with their row numbers, to be kept and searched often.

    int8: a byte a dimension, its range cut into 256 steps. binary: a bit a dimension, whether it is above its mean;
    distances are numbers of differing bits. ivfpq: about sqrt(n) lists of product-quantised residuals of at most 64
    bytes, a tenth of the lists probed: some hundred times smaller than the descriptors. hnsw: a graph of 32 links a
    node over the full descriptors: no smaller, but far fewer distances a query. Training is seeded, so the same
    descriptors give the same index.

    `refine`: an index of `CODES` also keeps the float descriptors, which order the candidates of a search anew
    (`search_index`).
    """
    import faiss

    n, dim = 0, 0
    total, low, high = np.zeros(0), np.full(1, np.inf, np.float32), np.full(1, -np.inf, np.float32)
    for _, block in blocks():
        n, dim = n + len(block), block.shape[1]
        if kind == "int8":
            low, high = np.minimum(low, block.min(axis=0)), np.maximum(high, block.max(axis=0))
        elif kind == "binary":
            total = (total if len(total) else np.zeros(dim)) + block.sum(axis=0, dtype=np.float64)
    if kind == "exact":
        inner: Any = faiss.IndexFlatL2(dim)
    elif kind == "hnsw":
        inner = faiss.IndexHNSWFlat(dim, 32)
        inner.hnsw.efConstruction, inner.hnsw.efSearch = 80, 128
    elif kind == "int8":
        inner = faiss.IndexScalarQuantizer(dim, faiss.ScalarQuantizer.QT_8bit)
        inner.train(float32(np.stack([low, high])))  # of all rows it would learn the same two numbers a dimension
    elif kind == "binary":
        inner = faiss.IndexLSH(dim, dim, False, True)  # no rotation, a threshold a dimension: the median of one row
        inner.train(float32(total[None] / max(1, n)))
    elif kind == "ivfpq":
        lists = max(1, round(n**0.5))
        codes = next(m for m in (64, 56, 48, 32, 16, 8, 4, 2, 1) if dim % m == 0)
        bits = 8 if n >= 256 else max(1, n.bit_length() - 1)
        inner = faiss.IndexIVFPQ(faiss.IndexFlatL2(dim), dim, lists, codes, bits)
        inner.cp.seed, inner.pq.cp.seed, inner.nprobe = seed, seed, max(1, lists // 10)
        inner.cp.min_points_per_centroid = inner.pq.cp.min_points_per_centroid = 1  # small sets warn otherwise
        every = max(1, n // max(64 * lists, 16_384))  # 64 points a centroid are enough to train on
        inner.train(np.concatenate([float32(block[::every]) for _, block in blocks()]))
    else:
        raise UsageError(f"search is '{kind}'; it can be exact, int8, binary, ivfpq or hnsw")
    if refine and kind in CODES:
        inner = faiss.IndexRefineFlat(inner)
    index = faiss.IndexIDMap(inner)
    for numbers, block in blocks():
        index.add_with_ids(float32(block), numbers.astype(np.int64))
    return index


def search_index(index: Any, queries: np.ndarray, k: int, refine: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """(distances [Q, k], rows [Q, k]) of an index; -1 where it found fewer.

    Distances are squared L2; of codes as decoded, of binary codes the number of differing bits.

    Args:
        refine: of an index made with `refine`: the candidates that its floats order, where that is more than k.
    """
    batches = [float32(queries[first : first + QUERIES]) for first in range(0, len(queries), QUERIES)]
    parts = [index.search(batch, max(k, refine)) for batch in batches]
    return np.concatenate([d[:, :k] for d, _ in parts]), np.concatenate([r[:, :k] for _, r in parts]).astype(np.int64)


def agreement(approximate: np.ndarray, exact: np.ndarray) -> float:
    """Percent of the exact neighbours [Q, k] that an approximation [Q, k] also found: recall against exact."""
    hits = sum(len(np.intersect1d(a[a >= 0], e[e >= 0])) for a, e in zip(approximate, exact, strict=True))
    return 100.0 * hits / max(1, int((exact >= 0).sum()))


def bytes_each(index: Any) -> tuple[int, int]:
    """(Bytes an image of what a search reads whole, of the floats that it reads of its candidates alone)."""
    import faiss

    inner: Any = faiss.downcast_index(index.index)
    refined = isinstance(inner, faiss.IndexRefineFlat)
    rows = max(1, index.ntotal)
    return round(index_bytes(inner.base_index if refined else inner) / rows), 4 * index.d * refined


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

    with replacing(path) as fresh:
        try:
            faiss.write_index(index, str(fresh))
        except RuntimeError as error:
            reason = str(error).splitlines()[0].rpartition(": ")[2]
            raise DataError(f"{path}: the search index cannot be written ({reason})") from error


def load_index(path: Path) -> Any:
    """Opens an index of `save_index`. Raises `DataError` for a file that is none.

    Vectors, but those of ivfpq, stay in the file, mapped: an index larger than memory answers from the disk.
    """
    import faiss

    try:
        return faiss.read_index(str(path), getattr(faiss, "IO_FLAG_MMAP_IFC", 0))  # older faiss reads all of it
    except RuntimeError as error:
        reason = str(error).splitlines()[0]
        raise DataError(f"{path}: not a readable faiss index ({reason}); build it again") from None
