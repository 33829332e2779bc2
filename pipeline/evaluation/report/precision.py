"""Precision and recall over a distance threshold: what accepting only near first answers costs, and brings.

Invariant: at a threshold, the first answers at that distance or nearer are accepted. Precision is the share of the
accepted that are right; recall is the share of the queries with positives whose first answer is accepted and right, so
that it ends at Recall@1 (of those queries).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def precision_recall(
    distances: np.ndarray, right: np.ndarray, positives: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Precision, recall in 0 ... 1 and threshold, float64 [t] each, thresholds ascending.

    Args:
        distances: of the first answers, float [Q].
        right: whether they are right, bool [Q].
        positives: how many of the Q queries have a right answer at all.
    """
    order = np.argsort(distances, kind="stable")
    near, hits = np.asarray(distances, np.float64)[order], np.cumsum(np.asarray(right, np.float64)[order])
    last = np.flatnonzero(np.append(np.diff(near) > 0, True)) if len(near) else np.zeros(0, np.int64)  # of equal ones
    return hits[last] / (last + 1), hits[last] / max(1, positives), near[last]


def first_answers(
    predictions: np.ndarray, distances: np.ndarray, positives: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, int]:
    """(Squared distances [Q], right [Q], queries with positives) of results, for `precision_recall`."""
    right = np.fromiter(
        (bool(np.isin(p[0], own)) for p, own in zip(predictions, positives, strict=True)), bool, len(predictions)
    )
    return distances[:, 0], right, sum(len(own) > 0 for own in positives)


def summary(precision: np.ndarray, recall: np.ndarray, threshold: np.ndarray) -> str:
    """Recall at full precision, and the threshold of it, in words."""
    whole = np.flatnonzero(precision == 1)
    if len(whole) == 0:
        return "no threshold without a wrong answer"
    at = whole[-1]
    return f"no wrong answer up to L2 {threshold[at]:.3f}: recall {100 * recall[at]:.1f} %"
