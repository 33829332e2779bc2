"""Bag of learnable Queries (Ali-bey et al., CVPR 2024): queries, the same for all images, attend to the patches.

Invariant: layers work in sequence on the patches; each layer's queries read its output; all answers are projected
together. Parameters are named as in the release.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pipeline.common.errors import UsageError
from pipeline.config.baselines import BoQConfig
from pipeline.model.pooling import Grid


class Block(nn.Module):
    """One encoder layer over the patches, and the queries that read it."""

    def __init__(self, dim: int, queries: int, heads: int) -> None:
        super().__init__()
        self.encoder = nn.TransformerEncoderLayer(dim, heads, 4 * dim, dropout=0.0, batch_first=True)
        self.queries = nn.Parameter(torch.randn(1, queries, dim))
        self.self_attn = nn.MultiheadAttention(dim, heads, batch_first=True)
        self.norm_q = nn.LayerNorm(dim)
        self.cross_attn = nn.MultiheadAttention(dim, heads, batch_first=True)
        self.norm_out = nn.LayerNorm(dim)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Patches [b, N, C] -> (patches [b, N, C], answers [b, queries, C])."""
        x = self.encoder(x)
        q = self.queries.expand(len(x), -1, -1)
        q = self.norm_q(q + self.self_attn(q, q, q, need_weights=False)[0])
        answers: Tensor = self.norm_out(self.cross_attn(q, x, x, need_weights=False)[0])
        return x, answers


class BoQ(nn.Module):
    """Tokens [b, 1 + h*w, D] -> [b, 1, channels * rows].

    Raises:
        UsageError: channels that heads of 64 do not divide.
    """

    least = 1

    def __init__(self, config: BoQConfig, dim: int, grid: Grid) -> None:
        super().__init__()
        if config.channels % 64:
            raise UsageError(f"pooling.boq.channels {config.channels} is not a multiple of 64, the width of a head")
        self.regions, self.dim, self.grid = 1, config.channels * config.rows, grid
        self.proj_c = nn.Conv2d(dim, config.channels, 3, padding=1)
        self.norm_input = nn.LayerNorm(config.channels)
        self.boqs = nn.ModuleList(
            Block(config.channels, config.queries, config.channels // 64) for _ in range(config.layers)
        )
        self.fc = nn.Linear(config.layers * config.queries, config.rows)

    def forward(self, tokens: Tensor, grid: Grid | None = None) -> Tensor:
        """[b, 1 + h*w, D] -> [b, 1, channels * rows]; `grid`: where it is another than the one it was built for."""
        patches = tokens[:, 1:].transpose(1, 2).unflatten(2, grid or self.grid)
        x = self.norm_input(self.proj_c(patches).flatten(2).transpose(1, 2))
        answers = []
        for block in self.boqs:
            x, answer = block(x)
            answers.append(answer)
        rows: Tensor = self.fc(torch.cat(answers, dim=1).transpose(1, 2))  # [b, channels, rows]
        return rows.flatten(1).unsqueeze(1)
