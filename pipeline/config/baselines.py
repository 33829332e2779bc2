"""Settings of the baselines' parts: residual networks, VGG-16 and aggregators; `pipeline.config` holds them in its own.

Invariant: defaults are the sizes published with each method, so that a name alone gives the published shape. No torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pipeline.config.setting import Settings, setting


@dataclass(frozen=True)
class ResNetConfig(Settings):
    """A residual network, as far as it is used."""

    cut: Literal["layer2", "layer3", "layer4"] = setting("layer4", changes="numbers")
    """Last stage used: layer3 has stride 16 and 1024 channels (256 in ResNet-18 and 34), layer4 stride 32 and twice
    as many."""
    layout: Literal["torchvision", "keras"] = setting("torchvision", changes="numbers")
    """Origin of the weights. keras: the stride of a down-sampling bottleneck is in its first convolution, BatchNorm eps
    is 1.001e-5, and the input is BGR 0..255 minus means (converted inside: the model's input stays the same)."""
    stages: tuple[int, ...] = setting((3, 4, 6, 3), changes="numbers", at_least=1, at_most=1000)
    """resnet_custom: bottlenecks of the four stages."""
    width: int = setting(64, changes="numbers", at_least=1, at_most=4096)
    """resnet_custom: channels after the first convolution; a stage's output is 4, 8, 16, 32 times as wide."""


@dataclass(frozen=True)
class VGGConfig(Settings):
    """VGG-16, as far as it is used."""

    cut: Literal["conv5_3", "pool5"] = setting("conv5_3", changes="numbers")
    """conv5_3: the last convolution without its ReLU, stride 16 (NetVLAD, SFRS, CosPlace); pool5: ReLU and pooling
    too, stride 32 (GCL). Both have 512 channels."""
    layout: Literal["torchvision", "matconvnet"] = setting("torchvision", changes="numbers")
    """Origin of the weights. matconvnet (SFRS starts from these): the input is RGB 0..255 minus means (converted
    inside: the model's input stays the same)."""


@dataclass(frozen=True)
class TransVPRConfig(Settings):
    """TransVPR's stem and transformer (Wang et al., CVPR 2022)."""

    dim: int = setting(256, changes="numbers", at_least=4, at_most=8192)
    """Channels of a token after a block, a multiple of 4 x heads (published: 256)."""
    depth: int = setting(6, changes="numbers", at_least=1, at_most=100)
    """Transformer blocks (published: 6)."""
    heads: int = setting(4, changes="numbers", at_least=1, at_most=1024)
    """Attention heads of a block (published: 4)."""
    mlp_ratio: int = setting(2, changes="numbers", at_least=1, at_most=16)
    """Hidden width of the MLP divided by dim (published: 2)."""
    width: int = setting(64, changes="numbers", at_least=1, at_most=4096)
    """Channels of the stem's first stage; each of its four stages has twice as many (published: 64)."""
    levels: tuple[int, ...] = setting((2, 4, 6), changes="numbers", at_least=1, at_most=100)
    """Blocks whose tokens are pooled, from 1 (published: 2, 4, 6)."""
    dropout: float = setting(0.1, changes="numbers", at_least=0, below=1)
    """Dropout of tokens, attention and MLP (published: 0.1)."""
    skipped: float = setting(0.1, changes="numbers", at_least=0, below=1)
    """Largest probability that an image leaves out a branch in training; it grows from block to block (published:
    0.1)."""


@dataclass(frozen=True)
class AttentionMapsConfig(Settings):
    """TransVPR's pooling: an attention map for each level of tokens."""

    levels: int = setting(3, changes="numbers", at_least=1, at_most=100)
    """Levels that a token holds side by side; as many as backbone.transvpr.levels names (published: 3)."""


@dataclass(frozen=True)
class NetVLADConfig(Settings):
    """Residuals to soft-assigned cluster centres (Arandjelovic et al., CVPR 2016)."""

    clusters: int = setting(64, changes="numbers", at_least=1, at_most=4096)
    """Clusters K; the descriptor has K x D numbers (published: 64)."""
    samples: int = setting(50_000, changes="numbers", at_least=1, at_most=10_000_000)
    """Patch features that k-means clusters into the centres, before the first step (published: 50,000)."""
    per_image: int = setting(100, changes="numbers", at_least=1, at_most=100_000)
    """Patch features of one image among them, at most (published: 100)."""
    bias: bool = setting(False, changes="numbers")
    """Assign patches by distance to the centres (with a bias, `vladv2` in releases) instead of by angle."""
    projection: int = setting(0, changes="numbers", at_least=0, at_most=65_536)
    """Dimensions of a linear layer after the normalised residuals (SFRS' release: PCA with whitening, 4096); 0: none.
    It is not initialised from images."""


@dataclass(frozen=True)
class CosPlaceConfig(Settings):
    """GeM and a linear layer (Berton et al., CVPR 2022)."""

    dim: int = setting(512, changes="numbers", at_least=1, at_most=65_536)
    """Output dimensions (published: 32 to 2048, 512 most used)."""


@dataclass(frozen=True)
class MixVPRConfig(Settings):
    """Feature mixing over positions (Ali-bey et al., WACV 2023)."""

    channels: int = setting(1024, changes="numbers", at_least=1, at_most=65_536)
    """Channels after the projection (published: 1024)."""
    rows: int = setting(4, changes="numbers", at_least=1, at_most=4096)
    """Rows after the projection; the descriptor has channels x rows numbers (published: 4, so 4096)."""
    depth: int = setting(4, changes="numbers", at_least=0, at_most=100)
    """Mixer layers (published: 4)."""
    mlp_ratio: float = setting(1.0, changes="numbers", above=0, at_most=100)
    """Hidden width of a mixer divided by the number of positions (published: 1)."""


@dataclass(frozen=True)
class SALADConfig(Settings):
    """Optimal transport to clusters with a dustbin (Izquierdo and Civera, CVPR 2024)."""

    clusters: int = setting(64, changes="numbers", at_least=1, at_most=4096)
    """Clusters; fewer than patches (published: 64)."""
    channels: int = setting(128, changes="numbers", at_least=1, at_most=4096)
    """Channels of a cluster (published: 128)."""
    token: int = setting(256, changes="numbers", at_least=1, at_most=65_536)
    """Channels of the projected class token (published: 256, so 64 x 128 + 256 = 8448)."""
    hidden: int = setting(512, changes="numbers", at_least=1, at_most=65_536)
    """Width of the three two-layer projections (published: 512)."""
    iterations: int = setting(3, changes="numbers", at_least=0, at_most=1000)
    """Sinkhorn iterations (published: 3)."""
    dropout: float = setting(0.3, changes="numbers", at_least=0, below=1)
    """Dropout in the projections of patches (published: 0.3)."""


@dataclass(frozen=True)
class BoQConfig(Settings):
    """Learnable queries that attend to the patches, layer by layer (Ali-bey et al., CVPR 2024)."""

    channels: int = setting(384, changes="numbers", at_least=1, at_most=65_536)
    """Channels after the 3x3 projection, a multiple of 64 (published: 384 on DINOv2, 512 on ResNet-50)."""
    queries: int = setting(64, changes="numbers", at_least=1, at_most=4096)
    """Queries of a layer (published: 64)."""
    layers: int = setting(2, changes="numbers", at_least=1, at_most=100)
    """Layers (published: 2)."""
    rows: int = setting(32, changes="numbers", at_least=1, at_most=4096)
    """Rows after the last projection; the descriptor has channels x rows numbers (published: 32, so 12288)."""
