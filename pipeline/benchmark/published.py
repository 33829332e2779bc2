"""A training step and inference as the published code computes them, restated plainly to be timed beside ours.

Written from the paper and from what its implementation does: attention written out (its library has nothing faster
without xFormers), each region of the pyramid pooled by itself, torch's encoder layers, the whole similarity matrix,
torch's default Adam. Invariant: descriptors, loss and gradients are those of `PlaceModel` with the same weights, on one
process (a test compares them). Tensors have the released names.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pipeline.benchmark.sizes import Size, batch, build
from pipeline.benchmark.step import Step
from pipeline.benchmark.timing import Comparison, compare, processor_clock
from pipeline.config import ModelConfig
from pipeline.model.backbones.transformer import sizes
from pipeline.model.vpr import PlaceModel
from pipeline.model.weights.names import published_name, to_published


class Attention(nn.Module):
    """Self-attention of an image's tokens [b, T, D]."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        """[b, T, D] -> [b, T, D]."""
        b, t, d = x.shape
        q, k, v = self.qkv(x).reshape(b, t, 3, self.heads, d // self.heads).permute(2, 0, 3, 1, 4)
        attention = ((q * (d // self.heads) ** -0.5) @ k.transpose(-2, -1)).softmax(dim=-1)
        out: Tensor = self.proj((attention @ v).transpose(1, 2).reshape(b, t, d))
        return out


class Scale(nn.Module):
    """LayerScale."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(dim))

    def forward(self, x: Tensor) -> Tensor:
        """[b, T, D] -> [b, T, D]."""
        return x * self.gamma


class MLP(nn.Module):
    """Linear, exact GELU, Linear."""

    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(dim, hidden)
        self.fc2 = nn.Linear(hidden, dim)

    def forward(self, x: Tensor) -> Tensor:
        """[b, T, D] -> [b, T, D]."""
        out: Tensor = self.fc2(F.gelu(self.fc1(x)))
        return out


class ConvNorm(nn.Module):
    """Convolution, BatchNorm, ReLU."""

    def __init__(self, channels: int, out: int, kernel: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, out, kernel, padding=kernel // 2)
        self.bn = nn.BatchNorm2d(out, eps=0.001)

    def forward(self, x: Tensor) -> Tensor:
        """[b, C, H, W] -> [b, out, H, W]."""
        return F.relu(self.bn(self.conv(x)), inplace=True)


class Adapter(nn.Module):
    """The multi-scale convolution adapter (paper, figure 3b)."""

    def __init__(self, dim: int, width: int, reduced: int) -> None:
        super().__init__()
        quarter = width // 4
        self.D_fc1 = nn.Linear(dim, width)
        self.branch1 = ConvNorm(width, width - 2 * quarter, 1)
        self.branch2 = nn.Sequential(ConvNorm(width, reduced, 1), ConvNorm(reduced, quarter, 3))
        self.branch3 = nn.Sequential(ConvNorm(width, reduced, 1), ConvNorm(reduced, quarter, 5))
        self.D_fc2 = nn.Linear(width, dim)

    def forward(self, x: Tensor) -> Tensor:
        """[b, 1 + G*G, D] -> [b, 1 + G*G, D]."""
        hidden = F.relu(self.D_fc1(x))
        b, t, width = hidden.shape
        side = round((t - 1) ** 0.5)
        grid = hidden[:, 1:].reshape(b, side, side, width).permute(0, 3, 1, 2)
        paths = torch.cat([self.branch1(grid), self.branch2(grid), self.branch3(grid)], dim=1)
        patches = paths.permute(0, 2, 3, 1).reshape(b, t - 1, width)
        out: Tensor = self.D_fc2(torch.cat((hidden[:, :1], patches), dim=1) + hidden)
        return out


class Block(nn.Module):
    """A transformer block with its adapter beside the MLP."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        size = sizes(config.backbone)
        self.norm1 = nn.LayerNorm(size.dim, eps=1e-6)
        self.attn = Attention(size.dim, size.heads)
        self.ls1 = Scale(size.dim)
        self.norm2 = nn.LayerNorm(size.dim, eps=1e-6)
        self.mlp = MLP(size.dim, size.mlp_ratio * size.dim)
        self.adapter = Adapter(size.dim, int(size.dim * config.adapter.ratio), config.adapter.reduced)
        self.ls2 = Scale(size.dim)
        self.scale = config.adapter.scale

    def forward(self, x: Tensor) -> Tensor:
        """[b, T, D] -> [b, T, D]."""
        x = x + self.ls1(self.attn(self.norm1(x)))
        normed = self.norm2(x)
        out: Tensor = x + self.ls2(self.mlp(normed) + self.scale * self.adapter(normed))
        return out


class Patches(nn.Module):
    """The projection of patches."""

    def __init__(self, dim: int, patch: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, dim, patch, patch)

    def forward(self, images: Tensor) -> Tensor:
        """[b, 3, S, S] -> [b, G*G, D]."""
        out: Tensor = self.proj(images).flatten(2).transpose(1, 2)
        return out


class Backbone(nn.Module):
    """DINOv2 with adapters: [b, 3, S, S] -> [b, 1 + G*G, D]."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        size = sizes(config.backbone)
        self.cls_token = nn.Parameter(torch.zeros(1, 1, size.dim))
        self.mask_token = nn.Parameter(torch.zeros(1, size.dim), requires_grad=False)
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + size.pretrain_grid**2, size.dim))
        self.patch_embed = Patches(size.dim, size.patch)
        self.blocks = nn.ModuleList(Block(config) for _ in range(size.depth))
        self.norm = nn.LayerNorm(size.dim, eps=1e-6)

    def forward(self, images: Tensor) -> Tensor:
        """[b, 3, S, S] -> [b, 1 + G*G, D]."""
        x = self.patch_embed(images)
        x = torch.cat((self.cls_token.expand(len(x), -1, -1), x), dim=1)
        x = x + self.positions(round((x.shape[1] - 1) ** 0.5))
        for block in self.blocks:
            x = block(x)
        out: Tensor = self.norm(x)
        return out

    def positions(self, grid: int) -> Tensor:
        """The position embedding at this grid, resized in every forward."""
        side = round((self.pos_embed.shape[1] - 1) ** 0.5)
        if side == grid:
            return self.pos_embed
        patches = self.pos_embed[:, 1:].reshape(1, side, side, -1).permute(0, 3, 1, 2)
        scale = (grid + 0.1) / side
        patches = F.interpolate(patches, scale_factor=(scale, scale), mode="bicubic")
        return torch.cat((self.pos_embed[:, :1], patches.permute(0, 2, 3, 1).flatten(1, 2)), dim=1)


class GeM(nn.Module):
    """Generalised mean over a region."""

    def __init__(self) -> None:
        super().__init__()
        self.p = nn.Parameter(torch.full((1,), 3.0))

    def forward(self, x: Tensor) -> Tensor:
        """[b, D, h, w] -> [b, D, 1, 1]."""
        return F.avg_pool2d(x.clamp(min=1e-6).pow(self.p), x.shape[-2:]).pow(1.0 / self.p)


class Normalise(nn.Module):
    """Unit length over channels."""

    def forward(self, x: Tensor) -> Tensor:
        """[b, D, h, w] -> [b, D, h, w]."""
        return F.normalize(x, p=2.0, dim=1)


class Published(nn.Module):
    """The published model with the weights of ours, parts frozen alike.

    Args:
        model: of the published kind: DINOv2 with the MulConv adapter and BatchNorm, a pyramid of levels 1, 2, 3.
    """

    def __init__(self, model: PlaceModel) -> None:
        super().__init__()
        config = model.config
        encoder, dim = config.cross_image, sizes(config.backbone).dim
        self.backbone = Backbone(config)
        self.aggregation = nn.Sequential(Normalise(), GeM(), nn.Flatten())
        layer = nn.TransformerEncoderLayer(dim, encoder.heads, encoder.feedforward, encoder.dropout, F.gelu)
        self.encoder = nn.TransformerEncoder(layer, encoder.layers, enable_nested_tensor=False)
        self.load_state_dict(to_published(model.state_dict()))
        trained = {published_name(name)[0] for name, p in model.named_parameters() if p.requires_grad}
        for name, parameter in self.named_parameters():
            parameter.requires_grad_(name in trained)

    def forward(self, images: Tensor) -> Tensor:
        """[b, 3, S, S] -> descriptors [b, R*D]."""
        tokens = self.backbone(images)
        grid = round((tokens.shape[1] - 1) ** 0.5)
        patches = tokens[:, 1:].reshape(len(tokens), grid, grid, -1).permute(0, 3, 1, 2)
        regions = [tokens[:, 0]]
        for cells in (2, 3):
            edges = [int(i * grid / cells + 0.5) for i in range(cells + 1)]
            regions += [
                self.aggregation(patches[:, :, edges[row] : edges[row + 1], edges[column] : edges[column + 1]])
                for row in range(cells)
                for column in range(cells)
            ]
        related = self.encoder(torch.stack(regions, dim=1))  # the images are the sequence
        return F.normalize(related.flatten(1), p=2.0, dim=-1)


def multi_similarity(descriptors: Tensor, labels: Tensor) -> Tensor:
    """The loss over mined pairs of the whole batch: [B, R*D], [B] -> scalar."""
    similarity = descriptors @ descriptors.T
    same = labels[:, None] == labels[None, :]
    positive, negative = same & ~torch.eye(len(labels), dtype=torch.bool, device=labels.device), ~same
    hardest_negative = similarity.masked_fill(~negative, -torch.inf).amax(1, keepdim=True)
    hardest_positive = similarity.masked_fill(~positive, torch.inf).amin(1, keepdim=True)
    positive, negative = (
        positive & (similarity - 0.1 < hardest_negative),
        negative & (similarity + 0.1 > hardest_positive),
    )
    push = torch.log(1 + (torch.exp(-similarity) * positive).sum(1))
    pull = torch.log(1 + (torch.exp(50.0 * similarity) * negative).sum(1)) / 50.0
    return (push + pull).mean()


class PublishedStep:
    """A published model with its optimiser and one batch; calling it is one training step in float32."""

    def __init__(self, model: PlaceModel, images: Tensor, labels: Tensor) -> None:
        self.model, self.images, self.labels = Published(model).to(images.device), images, labels
        self.optimizer = torch.optim.Adam([p for p in self.model.parameters() if p.requires_grad], lr=1e-6)

    def __call__(self) -> None:
        """One step."""
        self.model.train()
        self.optimizer.zero_grad()
        multi_similarity(self.model(self.images), self.labels).backward()
        self.optimizer.step()

    def describe(self) -> None:
        """Inference."""
        self.model.eval()
        with torch.no_grad():
            self.model(self.images)


def measure(size: Size, device: torch.device, rounds: int, images: int) -> list[Comparison]:
    """Training step and inference in float32, ours over the published; on a CPU one thread, in its seconds of work."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        pixels, labels = batch(size, images, device)
        model = build(size)
        theirs, ours = PublishedStep(model, pixels, labels), Step(model, pixels, labels, device)

        def describe() -> None:
            ours.model.eval()
            with torch.inference_mode():
                ours.model(pixels)
            ours.model.train()

        where = "CPU seconds of one thread" if device.type == "cpu" else "GPU"
        kinds: dict[str, tuple[Callable[[], None], Callable[[], None]]] = {
            "training step": (theirs, ours.way()),
            "inference": (theirs.describe, describe),
        }
        return [
            compare(
                f"{name}, {images} images, float32, {where}",
                {"published": one, "ours": other},
                images,
                rounds,
                device,
                processor_clock,
            )
            for name, (one, other) in kinds.items()
        ]
    finally:
        torch.set_num_threads(threads)
