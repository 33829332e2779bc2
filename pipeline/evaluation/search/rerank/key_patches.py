"""TransVPR's second stage (Wang et al., CVPR 2022): patches that its attention finds worth matching, and RANSAC.

Block, threshold and tolerance are those of the public code (RuotongWANG/TransVPR-model-implementation). There a pair
whose first patches are both no key patches has one match more: two rows of zeros, each the other's nearest. Here only
key patches are matched.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pipeline.common.errors import UsageError
from pipeline.config import EvaluationConfig
from pipeline.evaluation.search.rerank.matches import homography_inliers, mutual_matches, opencv, positions
from pipeline.evaluation.search.rerank.reranker import Features, Reranker
from pipeline.model.aggregators.transvpr import AttentionMaps
from pipeline.model.backbones.transvpr import PATCH, TransVPR

LAYER = 4  # of six blocks
LEAST = 0.02  # of the attention of the three levels together, from 0 to 1 over an image


def spread(values: Tensor) -> Tensor:
    """Each row [.., N] moved and scaled to 0..1; a row of one value becomes 0."""
    low, high = values.amin(-1, keepdim=True), values.amax(-1, keepdim=True)
    return (values - low) / (high - low).clamp(min=torch.finfo(values.dtype).tiny)


class KeyPatches(Reranker):
    """The score is the number of mutual matches between key patches that agree with one homography.

    Features: patches [K, D] of `rerank_layer` (block 4) under the final norm, their row numbers [K] in the grid,
    and [h, w].

    Raises:
        UsageError: another model, no such block, no OpenCV.
    """

    def __init__(self, model: Any, config: EvaluationConfig, device: torch.device | str) -> None:
        pooling, backbone = getattr(model, "pooling", None), getattr(model, "backbone", None)
        if not (isinstance(pooling, AttentionMaps) and isinstance(backbone, TransVPR)):
            raise UsageError("rerank_by transvpr needs a TransVPR, such as its release")
        self.layer = config.rerank_layer or LAYER
        if self.layer > backbone.depth:
            raise UsageError(f"rerank_layer {self.layer}: the backbone's blocks are 1 to {backbone.depth}")
        opencv()
        super().__init__(model, config, device)

    def describe(self, image: Tensor) -> Features:
        """[3, H, W] -> ([K, D], int64 [K], [h, w])."""
        grid = torch.tensor(self.model.backbone.grid_of(*image.shape[1:]))
        with torch.no_grad():
            every = self.model.backbone.every_block(image[None])
            maps = self.model.pooling.maps(self.model.backbone.joined(every))[0]  # [L, N]
            rows = (spread(spread(maps).sum(0)) > LEAST).nonzero().flatten()
            return every[self.layer - 1][0, 1:][rows], rows, grid

    def compare(self, query: Features, candidate: Features, seed: tuple[int, int]) -> tuple[float, ...]:
        """The number of matches in agreement."""
        (a, a_rows, a_grid), (b, b_rows, b_grid) = query, candidate
        if not len(a) or not len(b):
            return (0,)
        left, right = mutual_matches(a, b)
        of_query, of_candidate = (
            positions(rows.cpu().numpy()[which], int(grid[1])) * PATCH + PATCH // 2
            for rows, grid, which in ((a_rows, a_grid, left), (b_rows, b_grid, right))
        )
        return (homography_inliers(of_query, of_candidate, 1.5 * PATCH),)
