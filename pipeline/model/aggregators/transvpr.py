"""TransVPR's pooling (Wang et al., CVPR 2022): an attention map over the patches for each level of tokens.

Invariant: a token is L levels side by side; each map sums its own level alone, though it looks at all of them. The
order of the patches does not matter.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pipeline.common.errors import UsageError
from pipeline.config.baselines import AttentionMapsConfig
from pipeline.model.pooling import Grid, at_least_float32


class AttentionMaps(nn.Module):
    """Tokens [b, 1 + N, L * D] -> [b, 1, D].

    Raises:
        UsageError: a token does not have so many levels.
    """

    least = 1

    def __init__(self, config: AttentionMapsConfig, channels: int) -> None:
        super().__init__()
        if channels % config.levels:
            raise UsageError(f"pooling.transvpr.levels {config.levels}: tokens of {channels} channels do not have them")
        self.levels, self.regions, self.dim = config.levels, 1, channels // config.levels
        self.attention_pool = nn.Linear(channels, config.levels)
        self.fc = nn.Linear(channels, self.dim)

    def maps(self, tokens: Tensor) -> Tensor:
        """[b, 1 + N, L * D] -> the levels' attention over the patches [b, L, N], each summing to 1."""
        x = at_least_float32(tokens[:, 1:])
        scores: Tensor = F.linear(x, self.attention_pool.weight.to(x.dtype), self.attention_pool.bias.to(x.dtype))
        return scores.softmax(1).transpose(1, 2)

    def forward(self, tokens: Tensor, grid: Grid | None = None) -> Tensor:
        """[b, 1 + N, L * D] -> [b, 1, D]."""
        with torch.autocast(tokens.device.type, enabled=False):
            levels = at_least_float32(tokens[:, 1:]).unflatten(-1, (self.levels, self.dim))
            pooled = torch.einsum("bln,bnld->bld", self.maps(tokens), levels).flatten(1)
            projected: Tensor = self.fc(F.normalize(pooled, dim=-1).to(self.fc.weight.dtype))
        return projected.unsqueeze(1)
