"""Matches between the patches of two images, and how many of them agree in space: what all second stages build on.

Invariant: an answer depends on its arguments alone; where chance is needed, its seed is given or fixed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from pipeline.common.errors import UsageError

PROPOSALS = 256  # pairs of matches tried; all pairs where there are fewer
TOLERANCE = 1.5  # patches: half a patch each of two roundings to the grid, and one of distortion
SCALES = (0.5, 2.0)  # enlargement between two photographs of a place
TURN = np.pi / 6  # cameras are held upright


def mutual_matches(a: Tensor, b: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Rows of a [n, D] and b [m, D] that are each other's nearest by inner product: two int64 arrays of one length.

    The rows of `a` ascend.
    """
    similarities = a @ b.T
    forward, backward = similarities.argmax(1), similarities.argmax(0)
    rows = torch.arange(len(a), device=a.device)
    mutual = backward[forward] == rows
    return rows[mutual].cpu().numpy(), forward[mutual].cpu().numpy()


def positions(rows: np.ndarray, width: int) -> np.ndarray:
    """Row numbers of a grid of `width` columns, row by row -> int64 [n, 2] of (column, row)."""
    return np.stack((rows % width, rows // width), axis=1)


def similarity_inliers(left: np.ndarray, right: np.ndarray, seed: tuple[int, int] = (0, 0)) -> int:
    """The largest number of matches that agree with one similarity transform.

    Args:
        left, right: complex [n], matched positions (column + i row, in patches): right = s * left + t.
        seed: names the pair of images; decides which pairs of matches are tried where there are too many for all.
    """
    n = len(left)
    if n < 2:
        return n
    first, second = np.triu_indices(n, 1)
    if len(first) > PROPOSALS:
        # the raw stream of Philox is fixed for ever, where numpy's own samplers may change between versions
        bits = np.random.Philox(key=np.array(seed, np.uint64)).random_raw(len(first))
        chosen = np.argpartition(bits, PROPOSALS)[:PROPOSALS]
        first, second = first[chosen], second[chosen]
    step = left[first] - left[second]  # never 0: no patch is matched twice
    s = (right[first] - right[second]) / step
    plausible = (np.abs(s) >= SCALES[0]) & (np.abs(s) <= SCALES[1]) & (np.abs(np.angle(s)) <= TURN)
    s, first = s[plausible], first[plausible]
    if not len(s):
        return 1
    t = right[first] - s * left[first]
    errors = np.abs(s[:, None] * left + t[:, None] - right)  # [proposals, n]
    return int((errors <= TOLERANCE).sum(1).max())


def opencv() -> Any:
    """The OpenCV module, whose RANSAC fits homographies.

    Raises:
        UsageError: it is not installed.
    """
    try:
        import cv2
    except ImportError:
        raise UsageError(
            "rerank_by: RANSAC needs OpenCV: pip install 'place-recognition-training[rerank]' (patches and "
            "patch-netvlad-rss do without)"
        ) from None
    return cv2


def homography_inliers(left: np.ndarray, right: np.ndarray, tolerance: float) -> int:
    """The number of matches that agree with one homography, fitted by OpenCV's RANSAC with its fixed seed.

    Args:
        left, right: [n, 2], matched positions in pixels: (x, y).
        tolerance: largest distance in pixels between a position in `right` and where `left` is mapped to.
    """
    if len(left) < 4:
        return 0
    cv2 = opencv()
    _, kept = cv2.findHomography(left.astype(np.float64), right.astype(np.float64), cv2.RANSAC, tolerance)
    return 0 if kept is None else int(kept.sum())


def rapid_score(left: np.ndarray, right: np.ndarray, farthest: tuple[int, int]) -> float:
    """Rapid spatial scoring (Patch-NetVLAD, section 3.4): matches count for how near they move to the mean movement.

    Args:
        left, right: [n, 2], matched positions in patches: (column, row).
        farthest: largest column and largest row.

    Returns:
        The sum over matches of (farthest - distance from the mean movement)^2, over columns and rows.
    """
    if not len(left):
        return 0.0
    moved = (left - right).astype(np.float64)
    return float(((np.array(farthest) - np.abs(moved - moved.mean(0))) ** 2).sum())
