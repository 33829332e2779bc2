"""SALAD (Izquierdo and Civera, CVPR 2024): patches go to clusters by optimal transport, useless ones to a dustbin.

Invariant: the transport plan is computed in float32 at least; each patch gives away mass 1 in all, the dustbin's share
included. Parameters are named and the descriptor is ordered as in the release (class token first, then channel by
channel over the clusters).
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pipeline.common.errors import UsageError
from pipeline.config.baselines import SALADConfig
from pipeline.model.pooling import Grid, at_least_float32


def transport(scores: Tensor, dustbin: Tensor, iterations: int) -> Tensor:
    """Sinkhorn in the log domain: scores [b, m, n] of clusters and patches -> plan [b, m + 1, n], dustbin last.

    Columns sum to 1 (each patch's mass); rows tend to 1 for the clusters and n - m for the dustbin.
    """
    b, m, n = scores.shape
    augmented = torch.cat((scores, dustbin.expand(b, 1, n)), dim=1)
    rows = scores.new_zeros(m + 1)
    rows[m] = math.log(n - m)
    u, v = scores.new_zeros(b, m + 1), scores.new_zeros(b, n)
    for _ in range(iterations):
        u = rows - torch.logsumexp(augmented + v.unsqueeze(1), dim=2)
        v = -torch.logsumexp(augmented + u.unsqueeze(2), dim=1)
    return (augmented + u.unsqueeze(2) + v.unsqueeze(1)).exp()


class SALAD(nn.Module):
    """Tokens [b, 1 + h*w, D] -> [b, 1, token + channels * clusters].

    Raises:
        UsageError: not fewer clusters than patches: the dustbin would have nothing to take.
    """

    def __init__(self, config: SALADConfig, dim: int, grid: Grid) -> None:
        super().__init__()
        patches = grid[0] * grid[1]
        if config.clusters >= patches:
            raise UsageError(
                f"pooling.salad.clusters {config.clusters} must be fewer than the {patches} patches of an image; "
                "take fewer clusters or a larger image_size"
            )
        self.least = math.isqrt(config.clusters) + 1
        self.regions, self.dim, self.iterations = 1, config.token + config.channels * config.clusters, config.iterations
        self.token_features = nn.Sequential(
            nn.Linear(dim, config.hidden), nn.ReLU(), nn.Linear(config.hidden, config.token)
        )
        self.cluster_features = self._per_patch(dim, config.channels, config)
        self.score = self._per_patch(dim, config.clusters, config)
        # released as a single number; a vector here, since FSDP2 shards no parameter without a dimension
        self.dust_bin = nn.Parameter(torch.ones(1))

    @staticmethod
    def _per_patch(dim: int, out: int, config: SALADConfig) -> nn.Sequential:
        dropout = nn.Dropout(config.dropout) if config.dropout > 0 else nn.Identity()
        return nn.Sequential(nn.Conv2d(dim, config.hidden, 1), dropout, nn.ReLU(), nn.Conv2d(config.hidden, out, 1))

    def forward(self, tokens: Tensor, grid: Grid | None = None) -> Tensor:
        """[b, 1 + h*w, D] -> [b, 1, token + channels * clusters]."""
        patches = tokens[:, 1:].transpose(1, 2).unsqueeze(-1)  # [b, D, N, 1]: 1x1 convolutions need no grid
        features = at_least_float32(self.cluster_features(patches).squeeze(-1))  # [b, channels, N]
        scores = at_least_float32(self.score(patches).squeeze(-1))  # [b, clusters, N]
        token = at_least_float32(self.token_features(tokens[:, 0]))
        with torch.autocast(tokens.device.type, enabled=False):
            plan = transport(scores, self.dust_bin.to(scores.dtype), self.iterations)[:, :-1]
            gathered = F.normalize(features @ plan.transpose(1, 2), dim=1)  # [b, channels, clusters]
            return torch.cat((F.normalize(token, dim=-1), gathered.flatten(1)), dim=-1).unsqueeze(1)
