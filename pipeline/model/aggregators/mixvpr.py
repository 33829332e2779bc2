"""MixVPR (Ali-bey et al., WACV 2023): every channel's map is mixed over positions, then projected twice.

Invariant: unlike the other aggregators its weights belong to one grid of positions, so to one input size.
Parameters are named as in the release.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pipeline.config.baselines import MixVPRConfig
from pipeline.model.pooling import Grid


class Mixer(nn.Module):
    """`x + Linear(ReLU(Linear(LayerNorm(x))))` over the positions."""

    def __init__(self, positions: int, ratio: float) -> None:
        super().__init__()
        hidden = int(positions * ratio)
        self.mix = nn.Sequential(
            nn.LayerNorm(positions), nn.Linear(positions, hidden), nn.ReLU(), nn.Linear(hidden, positions)
        )
        for module in self.mix:
            if isinstance(module, nn.Linear):
                nn.init.trunc_normal_(module.weight, std=0.02)
                nn.init.zeros_(module.bias)

    def forward(self, x: Tensor) -> Tensor:
        """[b, D, N] -> [b, D, N]."""
        out: Tensor = x + self.mix(x)
        return out


class MixVPR(nn.Module):
    """Tokens [b, 1 + h*w, D] -> [b, 1, channels * rows]."""

    least = None

    def __init__(self, config: MixVPRConfig, channels: int, grid: Grid) -> None:
        super().__init__()
        positions = grid[0] * grid[1]
        self.regions, self.dim = 1, config.channels * config.rows
        self.mix = nn.Sequential(*(Mixer(positions, config.mlp_ratio) for _ in range(config.depth)))
        self.channel_proj = nn.Linear(channels, config.channels)
        self.row_proj = nn.Linear(positions, config.rows)

    def forward(self, tokens: Tensor, grid: Grid | None = None) -> Tensor:
        """[b, 1 + h*w, D] -> [b, 1, channels * rows]."""
        mixed = self.mix(tokens[:, 1:].transpose(1, 2))  # [b, D, N]
        projected = self.channel_proj(mixed.transpose(1, 2)).transpose(1, 2)
        rows: Tensor = self.row_proj(projected)
        return torch.flatten(rows, 1).unsqueeze(1)
