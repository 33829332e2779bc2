"""Patch-NetVLAD (Hausler et al., CVPR 2021): NetVLAD descriptors of all square patches, matched at three sizes.

Sizes, strides, weights and tolerances are those of the published performance configuration (public code:
QVPR/Patch-NetVLAD). Scores of a size are brought to mean 0 and deviation 1 over the candidates of a query, then
summed with the sizes' weights.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from pipeline.common.errors import UsageError
from pipeline.config import EvaluationConfig
from pipeline.evaluation.search.rerank.matches import (
    homography_inliers,
    mutual_matches,
    opencv,
    positions,
    rapid_score,
)
from pipeline.evaluation.search.rerank.reranker import Features, Reranker
from pipeline.model.aggregators.netvlad import NetVLAD

SIZES = (2, 5, 8)  # tokens on a side of a square patch; patches are one token apart
WEIGHTS = (0.45, 0.15, 0.4)


class PatchNetVLAD(Reranker):
    """The score of a size: the part of the patches that are mutual matches and agree with one homography.

    Needs a model with NetVLAD, such as Patch-NetVLAD's release, whose WPCA then shortens the patches' descriptors too.
    Features: for each size p [(G-p+1)^2, D'], of unit length; overlapping patches are too alike for float16.

    Raises:
        UsageError: no NetVLAD, too coarse a grid of tokens, a layer asked for, no OpenCV.
    """

    columns = len(SIZES)

    ransac = True

    def __init__(self, model: Any, config: EvaluationConfig, device: torch.device | str) -> None:
        asked = f"rerank_by {config.rerank_by}"
        if not isinstance(getattr(model, "pooling", None), NetVLAD):
            raise UsageError(f"{asked} needs a model with NetVLAD, such as its release")
        if config.rerank_layer is not None:
            raise UsageError(f"{asked} takes the patches that NetVLAD pools: leave rerank_layer out")
        side, least = model.backbone.grid, max(SIZES)
        if side < least:
            raise UsageError(
                f"{asked}: an image has {side} x {side} tokens and needs at least {least} x {least}; use a larger "
                "image_size"
            )
        if self.ransac:
            opencv()
        super().__init__(model, config, device)

    def describe(self, image: Tensor) -> Features:
        """[3, S, S] -> for each size [P, D']."""
        with torch.no_grad():
            tokens = self.model.backbone(image[None])
            side = self.grid(tokens.shape[1] - 1)
            return tuple(found[0] for found in self.model.pooling.of_patches(tokens, (side, side), SIZES))

    def compare(self, query: Features, candidate: Features, seed: tuple[int, int]) -> tuple[float, ...]:
        """For each size, agreement in the matches divided by the number of patches."""
        scores = []
        for size, a, b in zip(SIZES, query, candidate, strict=True):
            # candidate first: RANSAC draws from the matches in their order, which is the published one
            right, left = mutual_matches(b, a)
            side = self.grid(len(a))
            scores.append(self.agreement(positions(left, side), positions(right, side), size, side) / len(a))
        return tuple(scores)

    def agreement(self, left: np.ndarray, right: np.ndarray, size: int, side: int) -> float:
        """Matches [n, 2] of a query's (left) and a candidate's patches, in patches -> how far they agree."""
        stride = self.model.image_size // self.model.backbone.grid
        middle = size * stride // 2 - 1  # of a patch's pixels, rounded down as published
        return homography_inliers(right * stride + middle, left * stride + middle, 1.5 * stride)

    def combine(self, scores: np.ndarray) -> np.ndarray:
        """[n, 3] -> [n]; a size that scores all candidates alike tells nothing."""
        deviation = scores.std(0)
        spread = (scores - scores.mean(0)) / np.where(deviation > 0, deviation, 1)
        return np.asarray(spread @ np.array(WEIGHTS))


class PatchNetVLADRapid(PatchNetVLAD):
    """The same with rapid spatial scoring instead of RANSAC: needs no library."""

    ransac = False

    def agreement(self, left: np.ndarray, right: np.ndarray, size: int, side: int) -> float:
        """As `rapid_score`."""
        return rapid_score(right, left, (side - 1, side - 1))
