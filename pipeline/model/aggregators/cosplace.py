"""CosPlace's aggregation (Berton et al., CVPR 2022; EigenPlaces uses the same): normalise, GeM, linear layer.

Invariant: GeM's powers and means are float32 at least; the order of the patches does not matter.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pipeline.config.baselines import CosPlaceConfig
from pipeline.model.pooling import Grid, at_least_float32


class CosPlace(nn.Module):
    """Tokens [b, 1 + N, D] -> [b, 1, dim]."""

    least = 1

    def __init__(self, config: CosPlaceConfig, channels: int, p: float) -> None:
        super().__init__()
        self.regions, self.dim = 1, config.dim
        self.p = nn.Parameter(torch.full((1,), float(p)))
        self.fc = nn.Linear(channels, config.dim)

    def forward(self, tokens: Tensor, grid: Grid | None = None) -> Tensor:
        """[b, 1 + N, D] -> [b, 1, dim]."""
        with torch.autocast(tokens.device.type, enabled=False):
            p = at_least_float32(self.p)
            x = F.normalize(at_least_float32(tokens[:, 1:]), dim=-1)
            pooled = x.clamp(min=1e-6).pow(p).mean(1, keepdim=True).pow(1.0 / p)
        projected: Tensor = self.fc(pooled)
        return projected
