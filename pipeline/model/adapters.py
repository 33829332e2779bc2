"""Adapters: small trainable bottlenecks added to the frozen MLP of a block (paper, section 3.3).

Invariant: an adapter maps tokens [b, 1 + h*w, D] to the same shape; the class token skips the convolutions but
takes part in the skip sum (so under a skip it enters the last Linear doubled, as published). The last Linear
starts at zero: training starts from the released model's own output.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import torch
from torch import Tensor, nn

from pipeline.common.errors import UsageError
from pipeline.config import AdapterConfig
from pipeline.model.batch_norm import GlobalBatchNorm2d, normalised_together
from pipeline.model.pooling import Grid
from pipeline.model.products import linear

NORM_EPS = 1e-3  # published: BatchNorm2d(eps=0.001)


class AdaptedMLP(nn.Module):
    """`mlp(x) + s * adapter(x)`; the block applies its LayerScale to the sum, as published."""

    def __init__(self, mlp: nn.Module, adapter: nn.Module, scale: float) -> None:
        super().__init__()
        self.mlp = mlp
        self.adapter = adapter
        self.scale = scale

    def forward(self, x: Tensor) -> Tensor:
        """[b, T, D] -> [b, T, D]."""
        out: Tensor = self.mlp(x) + self.scale * self.adapter(x)
        return out


class ConvNorm(nn.Module):
    """A convolution of odd size that keeps height and width, and the normalisation behind it.

    Its adapter computes with them: parallel ones go together.
    """

    def __init__(self, channels: int, out: int, kernel: int, norm: str) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, out, kernel, padding=kernel // 2)
        self.norm = NORMS[norm](out)


def _group_norm(channels: int) -> nn.GroupNorm:
    groups = max(g for g in range(1, 9) if channels % g == 0)
    return nn.GroupNorm(groups, channels, eps=NORM_EPS)


NORMS: dict[str, Callable[[int], nn.Module]] = {
    "batch": lambda channels: GlobalBatchNorm2d(channels, eps=NORM_EPS, momentum=0.1),
    "group": _group_norm,
    "none": lambda channels: nn.Identity(),
}


class VanillaAdapter(nn.Module):
    """Linear -> ReLU -> Linear."""

    def __init__(self, dim: int, width: int) -> None:
        super().__init__()
        self.down = nn.Linear(dim, width)
        self.up = nn.Linear(width, dim)

    def forward(self, x: Tensor) -> Tensor:
        """[b, T, D] -> [b, T, D]."""
        out: Tensor = self.up(torch.relu(self.down(x)))
        return out


class ConvAdapter(nn.Module):
    """Linear -> ReLU -> parallel convolution paths over the patch map, concatenated (+ skip) -> Linear.

    Every path begins with a 1x1 convolution of the same map: together they are one product over tokens. At most one
    wider convolution follows. A normalisation and a ReLU come after each convolution; BatchNorms that stand side by
    side share their exchange between ranks. Maps lie in memory as tokens do, channels last.

    Args:
        dim: token width D.
        width: bottleneck width; the paths' output channels add up to it.
        paths: for each path its convolutions as (output channels, kernel): a 1x1, and perhaps one more.
        skip: whether the input of the paths is added to their output.
        norm: "batch", "group" or "none".
        grid: rows h and columns w of the patch map.
        others: tokens that are no patches and skip the convolutions: the class token, and registers behind it.
    """

    def __init__(
        self,
        dim: int,
        width: int,
        paths: list[list[tuple[int, int]]],
        skip: bool,
        norm: str,
        grid: Grid,
        others: int = 1,
    ) -> None:
        super().__init__()
        self.down = nn.Linear(dim, width)
        self.paths = nn.ModuleList(_path(width, path, norm) for path in paths)
        self.up = nn.Linear(width, dim)
        self.skip, self.grid, self.others = skip, grid, others

    def forward(self, x: Tensor) -> Tensor:
        """[b, others + h*w, D] -> [b, others + h*w, D]."""
        hidden = torch.relu(self.down(x))
        first, second = self.steps()
        weight = torch.cat([step.conv.weight.flatten(1) for step in first])
        products = linear(hidden, weight, torch.cat([cast(Tensor, step.conv.bias) for step in first]))
        grid = products[:, self.others :].contiguous().unflatten(1, self.grid).permute(0, 3, 1, 2)
        maps = _normalised(first, grid).split([step.conv.out_channels for step in first], dim=1)
        ends = [part for part, path in zip(maps, self.paths, strict=True) if isinstance(path, ConvNorm)]
        if second:
            reduced = [part for part, path in zip(maps, self.paths, strict=True) if not isinstance(path, ConvNorm)]
            wide = [step.conv(part) for step, part in zip(second, reduced, strict=True)]
            ends.append(_normalised(second, torch.cat(wide, dim=1)))
        patches = torch.cat([part.permute(0, 2, 3, 1).flatten(1, 2) for part in ends], dim=2)
        mixed = torch.cat((hidden[:, : self.others], patches.to(hidden.dtype)), dim=1)
        out: Tensor = self.up(mixed + hidden if self.skip else mixed)
        return out

    def steps(self) -> tuple[list[ConvNorm], list[ConvNorm]]:
        """The 1x1 convolutions of all paths; those that follow one. Each list is computed, and normalised, together."""
        convolutions = [[path] if isinstance(path, ConvNorm) else list(path) for path in self.paths]  # type: ignore[call-overload]
        return [path[0] for path in convolutions], [path[1] for path in convolutions if len(path) > 1]


def _normalised(steps: list[ConvNorm], x: Tensor) -> Tensor:
    """The normalisation of each step over its channels of x [b, C, H, W], then ReLU."""
    norms = [step.norm for step in steps]
    if isinstance(norms[0], GlobalBatchNorm2d):
        return torch.relu(normalised_together(cast(list[GlobalBatchNorm2d], norms), x))
    parts = x.split([step.conv.out_channels for step in steps], dim=1)
    return torch.relu(torch.cat([norm(part) for norm, part in zip(norms, parts, strict=True)], dim=1))


def _path(width: int, convolutions: list[tuple[int, int]], norm: str) -> nn.Module:
    channels = [width, *(out for out, _ in convolutions)]
    steps = [ConvNorm(channels[i], out, kernel, norm) for i, (out, kernel) in enumerate(convolutions)]
    return steps[0] if len(steps) == 1 else nn.Sequential(*steps)


def paths_of(kind: str, width: int, reduced: int) -> list[list[tuple[int, int]]]:
    """The convolution paths of an adapter kind, as (output channels, kernel) lists.

    mulconv is the paper's figure 3(b): half the width from 1x1, a quarter each from 3x3 and 5x5 behind a 1x1
    reduction. The single kernels (supplement, section 12) give the whole width from one path, 3x3 and 5x5 behind
    the same reduction; `conv` is conv3x3 whose skip the caller leaves out.
    """
    if kind == "mulconv":
        quarter = width // 4
        return [[(width - 2 * quarter, 1)], [(reduced, 1), (quarter, 3)], [(reduced, 1), (quarter, 5)]]
    kernel = {"conv1x1": 1, "conv": 3, "conv3x3": 3, "conv5x5": 5}[kind]
    return [[(width, 1)]] if kernel == 1 else [[(reduced, 1), (width, kernel)]]


def build_adapter(config: AdapterConfig, dim: int, grid: Grid, others: int = 1) -> nn.Module:
    """One block's adapter for token width `dim`, initialised, for a `grid` of patches behind `others` tokens that are
    none.

    Raises:
        UsageError: a bottleneck too narrow for its paths.
    """
    width = int(dim * config.ratio)
    if width < 4:
        raise UsageError(f"adapter.ratio {config.ratio} leaves {width} of {dim} channels: at least 4 are needed")
    adapter: VanillaAdapter | ConvAdapter
    if config.kind == "vanilla":
        adapter = VanillaAdapter(dim, width)
    else:
        paths = paths_of(config.kind, width, config.reduced)
        adapter = ConvAdapter(dim, width, paths, skip=config.kind != "conv", norm=config.norm, grid=grid, others=others)
    _initialise(adapter, config.init)
    return adapter


@torch.no_grad()
def _initialise(adapter: VanillaAdapter | ConvAdapter, init: str) -> None:
    nn.init.trunc_normal_(adapter.down.weight, std=0.02)
    nn.init.zeros_(adapter.down.bias)
    nn.init.zeros_(adapter.up.weight)
    nn.init.zeros_(adapter.up.bias)
    for module in adapter.modules():
        if not isinstance(module, nn.Conv2d):
            continue
        if init == "published":  # every output channel alike: they stay alike for ever
            for tensor in module.parameters():
                nn.init.constant_(tensor, 1e-5)
        else:
            nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
            module.bias.zero_()  # type: ignore[union-attr]
