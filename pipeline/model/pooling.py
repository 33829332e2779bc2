"""From patch tokens to regional features: the spatial pyramid, GeM, or the class token (paper, section 3.2).

Invariant: regions come level by level, each level row by row; patch tokens are L2-normalised over channels before
pooling (unless `normalise` is off), the class token is taken as it is; GeM's powers and means are float32 at least,
also under autocast.
"""

from __future__ import annotations

import itertools

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pipeline.common.errors import UsageError
from pipeline.config import PoolingConfig

Grid = tuple[int, int]
"""Rows h and columns w of patch tokens."""


def cell_edges(grid: int, cells: int) -> list[int]:
    """Edges of `cells` intervals that cover `grid` tokens: floor(i * grid / cells + 0.5); 16 in 3 gives 0 5 11 16."""
    return [(2 * i * grid + cells) // (2 * cells) for i in range(cells + 1)]


def cell_members(grid: Grid, levels: tuple[int, ...]) -> Tensor:
    """Which tokens each cell holds, as 0 and 1 (exact in any precision): [sum of n*n over levels, h*w]."""
    rows = []
    for n in levels:
        down, across = (list(itertools.pairwise(cell_edges(side, n))) for side in grid)
        for (top, bottom), (left, right) in itertools.product(down, across):
            cell = torch.zeros(grid, device="cpu")  # also where the model is only shapes so far
            cell[top:bottom, left:right] = 1.0
            rows.append(cell.flatten())
    return torch.stack(rows)


def at_least_float32(x: Tensor) -> Tensor:
    """x, in float32 where it came in half precision."""
    return x if x.dtype == torch.float64 else x.float()


class Pooling(nn.Module):
    """Tokens [b, 1 + h*w, D] -> regional features [b, R, D].

    spm takes the class token for level 1 and GeM for the other levels (R = 14 for levels 1, 2, 3); spmg takes GeM
    for all; gem is one GeM over all patches; cls is the class token. GeM is (mean of max(x, 1e-6)^p)^(1/p) with one
    learnable p shared by all regions. The exponent exists only where a region uses it, so none is ever idle.

    Attributes:
        least: tokens that each side of the grid needs.

    Raises:
        UsageError: no level, or a level with more cells than tokens.
    """

    members: Tensor

    def __init__(self, config: PoolingConfig, grid: Grid, dim: int = 0) -> None:
        super().__init__()
        self.dim, self.normalise, self.grid = dim, config.normalise, grid
        levels = {"gem": (1,), "cls": ()}.get(config.kind, config.levels)
        if config.kind in ("spm", "spmg") and (not levels or min(levels) < 1 or max(levels) > min(grid)):
            raise UsageError(f"pooling.levels {levels} must be numbers between 1 and the token grid's side {min(grid)}")
        self.least = max(levels, default=1)
        # the class token stands where level 1 stands in the list of levels
        self.class_at: int | None = 0 if config.kind == "cls" else None
        if config.kind == "spm" and 1 in levels:
            first = levels.index(1)
            self.class_at = sum(n * n for n in levels[:first])
            levels = levels[:first] + levels[first + 1 :]
        self.regions = sum(n * n for n in levels) + (self.class_at is not None)
        self.p = nn.Parameter(torch.full((1,), float(config.p))) if levels else None
        self.levels = levels
        members = cell_members(grid, levels) if levels else torch.zeros(0, grid[0] * grid[1], device="cpu")
        self.register_buffer("members", members, persistent=False)  # follows from the config, so it is never stored

    def forward(self, tokens: Tensor, grid: Grid | None = None) -> Tensor:
        """[b, 1 + h*w, D] -> [b, R, D]; `grid`: where it is another than the one it was built for."""
        tokens = at_least_float32(tokens)
        if self.p is None:
            return tokens[:, :1]
        with torch.autocast(tokens.device.type, enabled=False):
            p = at_least_float32(self.p)
            patches = F.normalize(tokens[:, 1:], dim=-1, eps=1e-12) if self.normalise else tokens[:, 1:]
            powers = patches.clamp(min=1e-6).pow(p)  # [b, h*w, D]
            known = self.members if grid in (None, self.grid) else cell_members(grid, self.levels).to(powers.device)
            members = known.to(powers.dtype)  # one product for all cells: no backward pass per cell
            pooled = ((members @ powers) / members.sum(1, keepdim=True)).pow(1.0 / p)
        if self.class_at is None:
            return pooled
        return torch.cat((pooled[:, : self.class_at], tokens[:, :1], pooled[:, self.class_at :]), dim=1)
