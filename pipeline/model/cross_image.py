"""The cross-image encoder: attention over the images of the batch, region by region (paper, section 3.2, Eq. 3).

Invariant: in training every image attends to the global batch, whatever the number of ranks; in evaluation the
images given are one group on this rank alone. Cost a rank and layer: attention of its own b queries against the B
gathered keys and values, one all-gather of B*R*2D numbers, one reduce-scatter of the same size backward. Images that
attend to themselves only need no other rank; they go through the same call, so that joint training (each image in the
global batch and alone) calls every layer once and a sharding engine gathers its parameters once.

Beside a bank (evaluation) each image attends to itself and to a fixed list of M images. These attend to each other
only, so their keys and values are constants of each layer (`remember`), and an image's output depends on no other
image.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pipeline.common.errors import UsageError
from pipeline.config import CrossImageConfig
from pipeline.distributed import begin_gather
from pipeline.model.products import linear

Memory = list[tuple[Tensor, Tensor]]
"""Keys and values of a bank's M images in each layer, [R, heads, M, D / heads] each."""


class CrossImageAttention(nn.Module):
    """Multi-head self-attention over images; parameters named and started as in `nn.MultiheadAttention`."""

    def __init__(self, dim: int, heads: int, dropout: float) -> None:
        super().__init__()
        self.heads = heads
        self.dropout = dropout
        self.in_proj_weight = nn.Parameter(torch.empty(3 * dim, dim))
        self.in_proj_bias = nn.Parameter(torch.zeros(3 * dim))
        self.out_proj = nn.Linear(dim, dim)
        nn.init.xavier_uniform_(self.in_proj_weight)
        nn.init.zeros_(self.out_proj.bias)

    def forward(self, x: Tensor, alone: int = 0) -> Tensor:
        """[b, R, D] -> [b, R, D]: each region's b images (queries) over that region's B images (keys, values).

        `alone`: the last so many images attend to themselves only, and nobody else attends to them. The softmax over
        one key is 1, so what is attended to is the value.
        """
        together, dim = len(x) - alone, x.shape[-1]
        attended = []
        if together and self.training:
            attended.append(self._over_all(x[:together]))
        elif together:
            query, key, value = linear(x[:together], self.in_proj_weight, self.in_proj_bias).chunk(3, dim=-1)
            attended.append(self._attend(query, key, value))
        if alone:
            attended.append(linear(x[together:], self.in_proj_weight[2 * dim :], self.in_proj_bias[2 * dim :]))
        out: Tensor = self.out_proj(torch.cat(attended))
        return out

    def keys_values(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """What a bank's images are to others in this layer: [M, R, D] -> keys, values [R, heads, M, D / heads]."""
        dim = x.shape[-1]
        key_value = linear(x, self.in_proj_weight[dim:], self.in_proj_bias[dim:])
        key, value = key_value.split(dim, dim=-1)
        return self._by_region(key), self._by_region(value)

    def beside(self, x: Tensor, keys: Tensor, values: Tensor) -> Tensor:
        """[b, R, D] -> [b, R, D]: each image over itself and over the keys and values of a bank."""
        query, key, value = linear(x, self.in_proj_weight, self.in_proj_bias).chunk(3, dim=-1)
        query, key, value = self._by_region(query), self._by_region(key), self._by_region(value)
        itself = (query * key).sum(-1, keepdim=True)  # [R, heads, b, 1]
        scores = torch.cat((query @ keys.transpose(-1, -2), itself), dim=-1) * query.shape[-1] ** -0.5
        weights = scores.softmax(-1)
        attended = weights[..., :-1] @ values + weights[..., -1:] * value
        out: Tensor = self.out_proj(attended.permute(2, 0, 1, 3).flatten(2))
        return out

    def _over_all(self, x: Tensor) -> Tensor:
        """[b, R, D] -> [b, R, D], before the output's projection: own queries over the global batch.

        Keys and values are projected on the rank that owns the image, then gathered once, in the type in which they
        were computed: the projection is not repeated W times. Own queries are projected while they travel.
        """
        dim = x.shape[-1]
        travelling = begin_gather(linear(x, self.in_proj_weight[dim:], self.in_proj_bias[dim:]))
        query = linear(x, self.in_proj_weight[:dim], self.in_proj_bias[:dim])
        key, value = travelling().split(dim, dim=-1)
        return self._attend(query, key, value)

    def _attend(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """[b, R, D], [B, R, D], [B, R, D] -> [b, R, D]."""
        query, key, value = self._by_region(query), self._by_region(key), self._by_region(value)
        dropout = self.dropout if self.training else 0.0
        attended = F.scaled_dot_product_attention(query, key, value, dropout_p=dropout)  # [R, heads, b, D / heads]
        return attended.permute(2, 0, 1, 3).flatten(2)

    def _by_region(self, x: Tensor) -> Tensor:
        """[n, R, D] -> [R, heads, n, D / heads]: the images become the sequence."""
        return x.unflatten(-1, (self.heads, -1)).permute(1, 2, 0, 3)


class CrossImageLayer(nn.Module):
    """One post-norm transformer encoder layer with exact GELU; parameters as in `nn.TransformerEncoderLayer`."""

    def __init__(self, dim: int, config: CrossImageConfig) -> None:
        super().__init__()
        self.self_attn = CrossImageAttention(dim, config.heads, config.dropout)
        self.linear1 = nn.Linear(dim, config.feedforward)
        self.linear2 = nn.Linear(config.feedforward, dim)
        self.norm1 = nn.LayerNorm(dim)
        self.norm2 = nn.LayerNorm(dim)
        self.dropout = nn.Dropout(config.dropout)

    def forward(self, x: Tensor, alone: int = 0) -> Tensor:
        """[b, R, D] -> [b, R, D]; `alone` as in the attention."""
        return self._after(x, self.self_attn(x, alone))

    def beside(self, x: Tensor, keys: Tensor, values: Tensor) -> Tensor:
        """[b, R, D] -> [b, R, D] beside the keys and values of a bank, as in the attention."""
        return self._after(x, self.self_attn.beside(x, keys, values))

    def _after(self, x: Tensor, attended: Tensor) -> Tensor:
        x = self.norm1(x + self.dropout(attended))
        hidden = self.dropout(F.gelu(self.linear1(x)))
        out: Tensor = self.norm2(x + self.dropout(self.linear2(hidden)))
        return out


class CrossImageEncoder(nn.Module):
    """Layers shared by all regions: [b, R, D] -> [b, R, D]. No positional encoding, no final norm.

    Raises:
        UsageError: heads that do not divide the width.
    """

    def __init__(self, dim: int, config: CrossImageConfig) -> None:
        super().__init__()
        if config.layers and dim % config.heads:
            raise UsageError(f"cross_image.heads {config.heads} does not divide the token width {dim}")
        self.alone = config.alone
        self.layers = nn.ModuleList(CrossImageLayer(dim, config) for _ in range(config.layers))

    def forward(self, regions: Tensor, alone: int = 0) -> Tensor:
        """[b, R, D] -> [b, R, D]; `alone`: the last so many images are groups of one (the config's: all)."""
        for layer in self.layers:
            regions = layer(regions, len(regions) if self.alone else alone)
        return regions

    def remember(self, bank: Tensor) -> Memory:
        """The keys and values of a bank [M, R, D] in each layer; its images attend to each other only. In eval mode."""
        memory: Memory = []
        for layer in self.layers:
            assert isinstance(layer, CrossImageLayer)
            memory.append(layer.self_attn.keys_values(bank))
            bank = layer(bank)
        return memory

    def beside(self, regions: Tensor, memory: Memory) -> Tensor:
        """[b, R, D] -> [b, R, D]: each image beside a bank, and beside no other. In eval mode."""
        for layer, (keys, values) in zip(self.layers, memory, strict=True):
            assert isinstance(layer, CrossImageLayer)
            regions = layer.beside(regions, keys, values)
        return regions


def check_crossing(config: CrossImageConfig, wanted: str) -> None:
    """Refuses `wanted`, a setting that needs images to attend to each other.

    Raises:
        UsageError: the model has no cross-image encoder, or one whose images attend to themselves only.
    """
    if not config.layers:
        raise UsageError(f"{wanted} needs a cross-image encoder, and model.cross_image.layers is 0: leave it out")
    if config.alone:
        raise UsageError(
            f"{wanted} needs images that attend to each other, and model.cross_image.alone is set: leave one out"
        )
