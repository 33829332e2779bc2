"""t-SNE (van der Maaten and Hinton, 2008), exact, for some hundred points: the map of the paper's supplement.

Invariant: the same points give the same map: it starts from their two principal directions, and nothing is drawn at
random. Time and memory grow with n * n; a few thousand points are the limit. A map shows neighbourhoods: distances
between clusters and their sizes mean nothing, so a figure should tell a number of the original space beside it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.common.errors import UsageError

Points = NDArray[np.float64]
TINY = 1e-12
EXAGGERATION, EARLY = 12.0, 250  # the first steps pull neighbours together more strongly, so that clusters form


def squared_distances(x: Points) -> Points:
    """Squared Euclidean distances of rows [n, d] -> [n, n], zero on the diagonal."""
    squares = (x * x).sum(1)
    distances = np.maximum(squares[:, None] + squares[None, :] - 2.0 * x @ x.T, 0.0)
    np.fill_diagonal(distances, 0.0)
    return distances


def affinities(distances: Points, perplexity: float) -> Points:
    """Joint probabilities [n, n] of neighbourhood: rows of the given perplexity (their entropy is its logarithm),
    made symmetric; they sum to 1.

    Raises:
        UsageError: fewer than three times the perplexity of points.
    """
    n = len(distances)
    if not 1 <= perplexity <= n / 3:
        raise UsageError(
            f"perplexity {perplexity:g} wants at least {int(3 * max(perplexity, 1))} photos, there are {n}"
        )
    low, high = np.zeros(n), np.full(n, np.inf)
    beta = 1.0 / np.maximum(np.median(distances, axis=1), TINY)
    others = ~np.eye(n, dtype=bool)
    nearest = np.where(others, distances, np.inf).min(1, keepdims=True)
    rows = np.zeros((n, n))
    for _ in range(100):
        rows = np.where(others, np.exp(-(distances - nearest) * beta[:, None]), 0.0)
        rows /= rows.sum(1, keepdims=True)
        entropy = -(rows * np.log(np.maximum(rows, TINY))).sum(1)
        flat = entropy > np.log(perplexity)
        low, high = np.where(flat, beta, low), np.where(flat, high, beta)
        beta = np.where(np.isinf(high), beta * 2.0, (low + high) / 2.0)
        if np.abs(entropy - np.log(perplexity)).max() < 1e-6:
            break
    return (rows + rows.T) / (2.0 * n)


def gradient(joint: Points, y: Points) -> tuple[Points, float]:
    """Gradient [n, 2] of the divergence of the map `y` [n, 2] from `joint`, and that divergence (nats)."""
    kernel = 1.0 / (1.0 + squared_distances(y))
    np.fill_diagonal(kernel, 0.0)
    q = np.maximum(kernel / kernel.sum(), TINY)
    pull = (joint - q) * kernel
    divergence = float((joint * np.log(np.maximum(joint, TINY) / q)).sum())
    return 4.0 * (pull.sum(1)[:, None] * y - pull @ y), divergence


def tsne(x: NDArray[np.floating], perplexity: float = 30.0, steps: int = 750) -> tuple[Points, float]:
    """The map of points.

    Args:
        x: rows [n, d], for example descriptors; n of some hundreds.
        perplexity: about how many neighbours count, at most n / 3.
        steps: gradient steps; the first 250 exaggerate.

    Returns:
        Positions [n, 2] and their divergence (nats).

    Raises:
        UsageError: too few points for the perplexity.
    """
    points = np.asarray(x, np.float64)
    points = points - points.mean(0)
    joint = affinities(squared_distances(points), perplexity)
    left, scales, _ = np.linalg.svd(points, full_matrices=False)
    y = left[:, :2] * scales[:2]
    y *= np.sign(y[np.abs(y).argmax(0), [0, 1]])  # a principal direction has no sign of its own
    y *= 1e-4 / max(float(y[:, 0].std()), TINY)
    rate = max(len(points) / EXAGGERATION / 4.0, 50.0)
    speed, gains = np.zeros_like(y), np.ones_like(y)
    for step in range(steps):
        early = step < min(EARLY, steps // 2)
        slope, _ = gradient(joint * (EXAGGERATION if early else 1.0), y)
        same = np.sign(slope) == np.sign(speed)
        gains = np.maximum(np.where(same, gains * 0.8, gains + 0.2), 0.01)
        speed = (0.5 if early else 0.8) * speed - rate * gains * slope
        y = y + speed
        y -= y.mean(0)
    return y, gradient(joint, y)[1]
