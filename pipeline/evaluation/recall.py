"""Recall@N: the share of queries with a correct database image among their N best predictions.

Invariant: only predictions and positives enter here, never a distance, a model or a file, so every figure of the
project, and every figure of other tools made from the same predictions, comes from these lines. What makes a
database image correct is decided in `ground_truth`; which images shared a batch is the protocol's business.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from pipeline.common.errors import DataError, UsageError


def first_hits(predictions: ArrayLike, positives: Sequence[ArrayLike]) -> np.ndarray:
    """The rank, from 0, of each query's first correct prediction; -1 where none of them is correct.

    `predictions` [Q, K] holds database rows, best first; negative entries (the padding of a search that found fewer
    than K) are never correct. `positives`: Q lists of correct database rows. Returns int64 [Q]; recall@n for any
    n <= K is the mean of `(0 <= ranks) & (ranks < n)`, which is all that curves and the bootstrap need. Raises
    `UsageError` when the two do not describe the same queries.
    """
    rows = _as_rows(predictions)
    if len(rows) != len(positives):
        raise UsageError(
            f"predictions of {len(rows):,} queries but positives of {len(positives):,}: give both for the same"
        )
    lengths = np.fromiter((np.size(p) for p in positives), np.int64, len(positives))
    correct = np.concatenate([np.asarray(p, np.int64).ravel() for p in positives] or [np.zeros(0, np.int64)])
    # one number a (query, row) pair turns Q small membership tests into a single sorted search
    span = 1 + max(int(rows.max(initial=-1)), int(correct.max(initial=-1)))
    query = np.arange(len(rows), dtype=np.int64)
    wanted = np.sort(np.repeat(query, lengths) * span + correct)
    given = query[:, None] * span + rows
    at = np.searchsorted(wanted, given)
    found = np.zeros(rows.shape, bool)
    inside = (at < len(wanted)) & (rows >= 0)
    found[inside] = wanted[at[inside]] == given[inside]
    if rows.shape[1] == 0:
        return np.full(len(rows), -1, np.int64)
    return np.where(found.any(axis=1), found.argmax(axis=1), -1).astype(np.int64)


def recall_at(
    predictions: ArrayLike,
    positives: Sequence[ArrayLike],
    ks: Iterable[int],
    without_positives: Literal["miss", "drop"] = "miss",
) -> dict[int, float]:
    """Recall@k in percent for every k of `ks`.

    `predictions` [Q, at least max(ks)] holds database rows, best first (pad with -1 where the database is smaller);
    `positives`: Q lists of correct rows. A query without positives counts as a miss, or is left out with `drop`
    (MSLS's own tool). Raises `UsageError` for too few predictions or mismatched lengths, `DataError` when no query
    is left to count.
    """
    rows = _as_rows(predictions)
    wanted = [int(k) for k in ks]
    if any(k < 1 for k in wanted):
        raise UsageError(f"recall@{min(wanted)} is not defined: the N of recall@N starts at 1")
    if wanted and max(wanted) > rows.shape[1]:
        raise UsageError(f"recall@{max(wanted)} needs that many predictions a query; only {rows.shape[1]} were given")
    ranks = first_hits(rows, positives)
    if without_positives == "drop":
        ranks = ranks[np.fromiter((np.size(p) > 0 for p in positives), bool, len(positives))]
    elif without_positives != "miss":
        raise UsageError(f"without_positives is '{without_positives}'; it can be miss or drop")
    if len(ranks) == 0:
        raise DataError("no query has a positive, so there is no recall: check the set's positions and radius")
    return {k: 100.0 * float(np.count_nonzero((ranks >= 0) & (ranks < k))) / len(ranks) for k in wanted}


def _as_rows(predictions: ArrayLike) -> np.ndarray:
    rows = np.asarray(predictions)
    if rows.ndim != 2 or (rows.size and not np.issubdtype(rows.dtype, np.integer)):
        raise UsageError(f"predictions must be whole database rows [queries, N]; these are {rows.dtype} {rows.shape}")
    return rows.astype(np.int64, copy=False)
