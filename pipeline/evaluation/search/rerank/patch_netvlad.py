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
    Features: for each size p [(h-p+1) * (w-p+1), D'], of unit length (overlapping patches are too alike for float16);
    and [h, w].

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
        if self.ransac:
            opencv()
        super().__init__(model, config, device)

    def describe(self, image: Tensor) -> Features:
        """[3, H, W] -> for each size [P, D'], and [h, w].

        Raises:
            UsageError: too few tokens for the largest size.
        """
        (h, w), least = self.model.backbone.grid_of(*image.shape[1:]), max(SIZES)
        if min(h, w) < least:
            raise UsageError(
                f"rerank_by {self.config.rerank_by}: an image has {h} x {w} tokens and needs at least {least} x "
                f"{least}; use a larger image_size"
            )
        with torch.no_grad():
            tokens = self.model.backbone(image[None])
            found = self.model.pooling.of_patches(tokens, (h, w), SIZES)
        return (*(each[0] for each in found), torch.tensor((h, w)))

    def compare(self, query: Features, candidate: Features, seed: tuple[int, int]) -> tuple[float, ...]:
        """For each size, agreement in the matches divided by the number of patches."""
        scores = []
        (h, w), (h2, w2) = query[-1].tolist(), candidate[-1].tolist()
        for size, a, b in zip(SIZES, query[:-1], candidate[:-1], strict=True):
            # candidate first: RANSAC draws from the matches in their order, which is the published one
            right, left = mutual_matches(b, a)
            farthest = max(w, w2) - size, max(h, h2) - size
            at = positions(left, w - size + 1), positions(right, w2 - size + 1)
            scores.append(self.agreement(*at, size, farthest) / len(a))
        return tuple(scores)

    def agreement(self, left: np.ndarray, right: np.ndarray, size: int, farthest: tuple[int, int]) -> float:
        """Matches [n, 2] of a query's (left) and a candidate's patches, in patches -> how far they agree.

        `farthest`: the largest column and row of either.
        """
        stride = self.model.backbone.stride
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

    def agreement(self, left: np.ndarray, right: np.ndarray, size: int, farthest: tuple[int, int]) -> float:
        """As `rapid_score`."""
        return rapid_score(right, left, farthest)
