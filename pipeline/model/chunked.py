"""Encoding in chunks where the adapters hold BatchNorm: block by block, the whole local batch in step.

Invariant: BatchNorm sees what it sees without chunks, the global batch; so the result, the gradients and the running
buffers are those of the unchunked model, to rounding. The price is memory: BatchNorm needs all images of a layer at
once, forward and backward, so two maps of tokens [b, 1 + h*w, D] a block are kept, and while one block is in backward
its adapter's maps for all b images. Peak memory still grows with b, with a much smaller slope (docs/performance.md);
without BatchNorm (`adapter.norm: group` or `none`) it does not, because each chunk then goes through alone.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from pipeline.model.adapters import AdaptedMLP
from pipeline.model.backbones.transformer import Backbone


@contextmanager
def in_step(backbone: Backbone, chunk: int) -> Iterator[None]:
    """Within it, calling the backbone takes each block through `chunk` images at a time, all images before the next.

    Each block keeps its own `__call__`, so what a sharding engine hangs on it still happens, once a forward.
    """
    blocks = backbone.blocks
    for block in blocks:
        block.forward = functools.partial(_block, block, chunk)
    try:
        yield
    finally:
        for block in blocks:
            del block.forward


def _block(block: Any, chunk: int, tokens: Tensor, *args: Any, **kwargs: Any) -> Tensor:
    """One transformer block: [b, T, D] -> [b, T, D]. Kept for backward: its input and what enters its second norm."""
    mlp: nn.Module = block.mlp
    adapted = isinstance(mlp, AdaptedMLP)
    plain = mlp.mlp if isinstance(mlp, AdaptedMLP) else mlp

    def image_by_image(x: Tensor) -> tuple[Tensor, Tensor]:
        attended, _ = block.attention(block.norm1(x), *args, **kwargs)
        middle = block.drop_path(block.layer_scale1(attended)) + x
        return middle, block.layer_scale2(plain(block.norm2(middle))) + middle

    def all_images(middle: Tensor) -> Tensor:
        assert isinstance(mlp, AdaptedMLP)
        out: Tensor = block.layer_scale2(mlp.scale * mlp.adapter(block.norm2(middle)))
        return out

    parts = [recomputed(image_by_image, part) for part in tokens.split(chunk)]
    out = torch.cat([out for _, out in parts])
    if not adapted:
        return out
    middle = torch.cat([middle for middle, _ in parts])
    del parts
    # LayerScale is linear: scaling the adapter's part by itself lets the frozen MLP go in chunks
    total: Tensor = out + recomputed(all_images, middle)
    return total


def recomputed(function: Any, x: Tensor) -> Any:
    """`function(x)`; under gradient only x is kept, and the rest computed again in backward."""
    return checkpoint(function, x, use_reentrant=False) if torch.is_grad_enabled() else function(x)
