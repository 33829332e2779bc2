"""Precision and recall over a distance, against scikit-learn's, with equal distances and queries without positives."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.metrics import precision_recall_curve

from pipeline.evaluation.report.precision import first_answers, precision_recall, summary


@pytest.mark.parametrize("seed", range(5))
def test_numbers_are_scikit_learns(seed: int) -> None:
    rng = np.random.default_rng(seed)
    distances = rng.integers(0, 30, 80) / 10  # many are equal
    right = rng.random(80) < np.exp(-distances)
    positives = int(right.sum()) + 7  # seven queries have a right answer that is not the first
    precision, recall, threshold = precision_recall(distances, right, positives)
    theirs, their_recall, their_threshold = precision_recall_curve(right, -distances)
    np.testing.assert_allclose(precision, theirs[:-1][::-1])  # without the point that is drawn at recall 0
    np.testing.assert_allclose(recall * positives / right.sum(), their_recall[:-1][::-1])
    np.testing.assert_allclose(threshold, -their_threshold[::-1])
    assert recall[-1] == right.sum() / positives


def test_from_results_and_in_words() -> None:
    rows = np.array([[0, 1], [3, 2], [2, 0], [-1, -1]])
    far = np.array([[0.25, 1], [4, 5], [1, 2], [np.inf, np.inf]])
    squared, right, positives = first_answers(
        rows, far, [np.array([0]), np.array([2]), np.array([2]), np.array([], int)]
    )
    assert right.tolist() == [True, False, True, False] and positives == 3
    curve = precision_recall(np.sqrt(squared), right, positives)
    assert summary(*curve) == "no wrong answer up to L2 1.000: recall 66.7 %"
    assert summary(*precision_recall(np.array([1.0]), np.array([False]), 1)) == "no threshold without a wrong answer"
    assert [len(a) for a in precision_recall(np.zeros(0), np.zeros(0, bool), 0)] == [0, 0, 0]
