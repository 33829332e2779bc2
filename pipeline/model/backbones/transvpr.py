"""TransVPR's image encoder (Wang et al., CVPR 2022): a convolutional stem and a transformer over tokens of its levels.

Invariant: tensors carry the release's names behind `backbone.`; the output has the form of the other backbones, patches
row by row behind the class token, but a token is the concatenation of the tokens after several blocks, each under the
same final norm: TransVPR pools the three levels separately (pipeline.model.aggregators.transvpr). There are no
positions; the stem's padding tells where an image ends.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from pipeline.common.errors import UsageError
from pipeline.config import ModelConfig
from pipeline.config.baselines import TransVPRConfig
from pipeline.config.image_size import ImageSize, for_patch
from pipeline.model.backbones.resnet import check_trained
from pipeline.model.batch_norm import GlobalBatchNorm2d
from pipeline.model.pooling import Grid

PATCH = 16  # pixels: four stages halve the image, and each stage gives the tokens a quarter of their channels


class Attention(nn.Module):
    """Multi-head self-attention, without biases on queries, keys and values."""

    def __init__(self, dim: int, heads: int, dropout: float) -> None:
        super().__init__()
        self.heads, self.dropout = heads, dropout
        self.qkv = nn.Linear(dim, 3 * dim, bias=False)
        self.proj = nn.Linear(dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        """[b, T, D] -> [b, T, D]."""
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        mixed = F.scaled_dot_product_attention(q, k, v, dropout_p=self.dropout if self.training else 0.0)
        return F.dropout(self.proj(mixed.transpose(1, 2).flatten(2)), self.dropout, self.training)


class Block(nn.Module):
    """Attention under a norm before it; then an MLP whose norm also leads the skip.

    `skipped`: probability that an image leaves out a branch in training (stochastic depth).
    """

    def __init__(self, config: TransVPRConfig, skipped: float) -> None:
        super().__init__()
        dim, hidden = config.dim, config.mlp_ratio * config.dim
        self.dropout, self.skipped = config.dropout, skipped
        self.pre_norm = nn.LayerNorm(dim)
        self.self_attn = Attention(dim, config.heads, config.dropout)
        self.norm1 = nn.LayerNorm(dim)
        self.linear1, self.linear2 = nn.Linear(dim, hidden), nn.Linear(hidden, dim)

    def forward(self, x: Tensor) -> Tensor:
        """[b, T, D] -> [b, T, D]."""
        x = self.norm1(x + self._branch(self.self_attn(self.pre_norm(x))))
        hidden = F.dropout(F.gelu(self.linear1(x)), self.dropout, self.training)
        return x + self._branch(F.dropout(self.linear2(hidden), self.dropout, self.training))

    def _branch(self, x: Tensor) -> Tensor:
        if not self.training or self.skipped == 0:
            return x
        kept = torch.rand(len(x), 1, 1, device=x.device) >= self.skipped
        return x * kept.to(x.dtype) / (1 - self.skipped)


class Encoder(nn.Module):
    """Tokens [b, N, D] -> tokens [b, 1 + N, D] after each block, under the final norm."""

    def __init__(self, config: TransVPRConfig) -> None:
        super().__init__()
        self.dropout = config.dropout
        self.class_emb = nn.Parameter(torch.zeros(1, 1, config.dim))
        last = max(config.depth - 1, 1)
        self.blocks = nn.ModuleList(Block(config, config.skipped * i / last) for i in range(config.depth))
        self.norm = nn.LayerNorm(config.dim)


class TransVPR(nn.Module):
    """[b, 3, H, W] normalised images -> [b, 1 + h*w, L * D] tokens of L levels; the first is the class token's.

    `train` of the model's config: full; frozen; last with `last_blocks` counting transformer blocks from the end, which
    leaves the stem frozen.

    Attributes:
        size: of the input.
        grid: rows h and columns w of the patches, of the largest input where its size varies.
        stride: the patch, in pixels.

    Args:
        config: the model's config; used are its backbone and what of it is trained.
        image_size: of the input; its sides are multiples of 16.

    Raises:
        UsageError: adapters, more last blocks than there are, weights of a backbone alone (there are none), sizes that
            do not fit each other.
    """

    def __init__(self, config: ModelConfig, image_size: int | str | ImageSize) -> None:
        super().__init__()
        settings = config.backbone.transvpr
        self.size, self.stride = for_patch(ImageSize.of(image_size), PATCH, config.backbone.name), PATCH
        if config.backbone.weights:
            raise UsageError(
                "model.backbone.weights: TransVPR's release is a whole model; import it with jobs.weights instead"
            )
        if settings.dim % (4 * settings.heads) or max(settings.levels) > settings.depth:
            raise UsageError(
                f"backbone.transvpr: dim {settings.dim} must be a multiple of 4 x heads {settings.heads}, and levels "
                f"{settings.levels} lie within the {settings.depth} blocks"
            )
        check_trained(config, settings.depth)
        self.depth, self.levels, self.grid = settings.depth, settings.levels, self.grid_of(*self.size.largest)
        self.dim = len(settings.levels) * settings.dim
        channels = 3
        for i in range(4):
            width = settings.width * 2**i
            self.add_module(
                f"conv{i + 1}",
                nn.Sequential(nn.Conv2d(channels, width, 3, padding=1), GlobalBatchNorm2d(width), nn.ReLU(),
                              nn.MaxPool2d(3, 2, padding=1)),
            )  # fmt: skip
            side = PATCH // 2 ** (i + 1)
            tokenizer = nn.ModuleDict({"conv_layer": nn.Conv2d(width, settings.dim // 4, side, side)})
            self.add_module(f"tokenizer{i + 1}", tokenizer)
            channels = width
        self.transformer = Encoder(settings)
        for module in self.modules():
            if isinstance(module, nn.Conv2d) and not module.weight.is_meta:
                nn.init.kaiming_normal_(module.weight)
            if isinstance(module, nn.Linear) and not module.weight.is_meta:
                nn.init.trunc_normal_(module.weight, std=0.02)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)
        self.trained = {"full": self.depth + 1, "frozen": 0}.get(config.trainable, config.last_blocks)
        if self.trained <= self.depth:
            self.requires_grad_(False)
            for block in self.blocks[self.depth - self.trained :]:
                block.requires_grad_(True)
            self.transformer.norm.requires_grad_(self.trained > 0)

    @property
    def blocks(self) -> list[nn.Module]:
        """The transformer blocks in order."""
        return list(self.transformer.blocks)

    def train(self, mode: bool = True) -> TransVPR:
        """As in torch, but frozen parts stay as in evaluation: their BatchNorm statistics are frozen too."""
        super().train(mode)
        if self.trained <= self.depth:
            still = [part for part in self.children() if part is not self.transformer]
            for module in (*still, *self.blocks[: self.depth - self.trained]):
                module.eval()
        return self

    def grid_of(self, height: int, width: int, layer: int | None = None) -> Grid:
        """Rows and columns of the patches of an input, after every block the same."""
        return height // PATCH, width // PATCH

    def adapters(self) -> list[nn.Module]:
        """None: the counterpart of the transformers' adapters."""
        return []

    def every_block(self, images: Tensor, recompute: bool = False) -> list[Tensor]:
        """[b, 3, H, W] -> for each block its tokens [b, 1 + h*w, D] under the final norm.

        `recompute`: keep the inputs of stages and blocks alone.
        """

        def run(part: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
            if recompute and torch.is_grad_enabled():
                again: Tensor = checkpoint(part, x, use_reentrant=False)
                return again
            return part(x)

        x, levels = images, []
        for i in range(1, 5):
            x = run(self.get_submodule(f"conv{i}"), x)
            levels.append(self.get_submodule(f"tokenizer{i}.conv_layer")(x).flatten(2).transpose(1, 2))
        encoder = self.transformer
        tokens = torch.cat((encoder.class_emb.expand(len(x), -1, -1), torch.cat(levels, -1)), 1)
        tokens = F.dropout(tokens, encoder.dropout, encoder.training and self.trained > self.depth)
        found = []
        for block in encoder.blocks:
            tokens = run(block, tokens)
            found.append(encoder.norm(tokens))
        return found

    def joined(self, every: list[Tensor]) -> Tensor:
        """Tokens of all blocks -> those of the levels pooled, side by side [b, 1 + h*w, L * D]."""
        return torch.cat([every[level - 1] for level in self.levels], -1)

    def patches(self, images: Tensor, layer: int | None = None) -> Tensor:
        """[b, 3, H, W] -> [b, h*w, D] after block `layer` (1 is the first); None: all levels pooled [b, h*w, L * D].

        Raises:
            UsageError: no such block.
        """
        if layer is not None and not 1 <= layer <= self.depth:
            raise UsageError(f"layer {layer}: the backbone's blocks are 1 to {self.depth}")
        every = self.every_block(images)
        return (self.joined(every) if layer is None else every[layer - 1])[:, 1:]

    def forward(self, images: Tensor, recompute: bool = False) -> Tensor:
        """[b, 3, H, W] -> [b, 1 + h*w, L * D]."""
        return self.joined(self.every_block(images, recompute))
