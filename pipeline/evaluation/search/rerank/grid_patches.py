"""Re-ranking by the patch tokens of any backbone.

Patches of query and candidate that are each other's nearest (cosine) are matches; a similarity transform (scale,
rotation, shift) between the two patch grids is proposed by pairs of matches; the score is the largest number of
matches that agree with one transform. (Patch-NetVLAD and TransVPR fit homographies by RANSAC to the same kind of
matches; a similarity needs two matches instead of four, and a grid of patches holds few.)
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from pipeline.common.errors import UsageError
from pipeline.evaluation.search.rerank.matches import mutual_matches, similarity_inliers
from pipeline.evaluation.search.rerank.reranker import Features, Reranker

SIDE = 4  # patches: a smaller grid tells too little


class GridPatches(Reranker):
    """Patch tokens of a layer, matched under a similarity transform. Features: [h*w, D] in float16, of unit length, and
    [h, w].

    Raises:
        UsageError: no such layer, or fewer than 4 x 4 patches; the same on all ranks.
    """

    def describe(self, image: Tensor) -> Features:
        """[3, H, W] -> ([h*w, D], [h, w]); the first of unit length but for float16's rounding."""
        backbone, layer = self.model.backbone, self.config.rerank_layer
        with torch.no_grad():
            tokens: Tensor = backbone.patches(image[None], layer)[0]
        if len(tokens) < SIDE * SIDE:
            raise UsageError(
                f"rerank: an image has {len(tokens)} patches and needs at least 16; use a larger image_size"
            )
        return F.normalize(tokens.float(), dim=-1).half(), torch.tensor(backbone.grid_of(*image.shape[1:], layer))

    def compare(self, query: Features, candidate: Features, seed: tuple[int, int]) -> tuple[float, ...]:
        """The number of matches in agreement."""
        a, b = int(query[1][1]), int(candidate[1][1])
        left, right = mutual_matches(query[0].float(), candidate[0].float())
        return (similarity_inliers(left % a + 1j * (left // a), right % b + 1j * (right // b), seed),)
