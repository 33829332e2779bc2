"""Settings of the model: backbone, adapters, pooling, cross-image encoder; imported from `pipeline.config`.

Invariant: nothing here imports torch; defaults are the paper's model.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from pipeline.config.baselines import (
    AttentionMapsConfig,
    BoQConfig,
    CosPlaceConfig,
    MixVPRConfig,
    NetVLADConfig,
    ResNetConfig,
    SALADConfig,
    TransVPRConfig,
    VGGConfig,
)
from pipeline.config.setting import Settings, setting

BackboneName = Literal[
    "dinov2_vits14", "dinov2_vitb14", "dinov2_vitl14", "dinov2_vitg14",
    "dinov2_vits14_reg", "dinov2_vitb14_reg", "dinov2_vitl14_reg", "dinov2_vitg14_reg",
    "dinov3_vits16", "dinov3_vits16plus", "dinov3_vitb16", "dinov3_vitl16", "dinov3_vith16plus",
    "resnet18", "resnet34", "resnet50", "resnet101", "resnet152", "resnext101_32x8d", "vgg16", "transvpr",
    "custom", "resnet_custom",
]  # fmt: skip
PoolingKind = Literal["spm", "spmg", "gem", "cls", "netvlad", "cosplace", "mixvpr", "salad", "boq", "transvpr"]


@dataclass(frozen=True)
class BackboneConfig(Settings):
    """The image encoder. `name` fills the sizes; `custom` and `resnet_custom` take them from the fields below."""

    name: BackboneName = setting("dinov2_vitb14", changes="numbers")
    """DINOv2 (paper: ViT-B/14 without registers), with registers, DINOv3, a residual network, VGG-16,
    TransVPR's, or custom."""
    weights: str | None = setting(None, changes="numbers", resume="free")
    """Released weights: a .pth, a safetensors file, a transformers folder, or hub:OWNER/NAME; none: random
    weights."""
    dim: int = setting(768, changes="numbers", at_least=1, at_most=8192)
    """custom: channels D of a token."""
    depth: int = setting(12, changes="numbers", at_least=1, at_most=100)
    """custom: transformer blocks."""
    heads: int = setting(12, changes="numbers", at_least=1, at_most=1024)
    """custom: attention heads of a block."""
    patch: int = setting(14, changes="numbers", at_least=1, at_most=1024)
    """custom: patch side in pixels."""
    mlp_ratio: int = setting(4, changes="numbers", at_least=1, at_most=16)
    """custom: hidden width of the MLP divided by dim."""
    layerscale: float = setting(1.0, changes="numbers")
    """custom: initial LayerScale; 1.0 suits training from scratch, 1e-5 is DINOv2's own start."""
    pretrain_grid: int = setting(37, changes="numbers", at_least=1, at_most=1024)
    """custom: side of the stored position embedding's grid; it is resized once to the input's grid (DINOv2: 37)."""
    registers: int = setting(0, changes="numbers", at_least=0, at_most=1024)
    """custom: register tokens (DINOv2 with registers and DINOv3: 4)."""
    rope: bool = setting(False, changes="numbers")
    """custom: DINOv3's rotary positions instead of a stored position embedding."""
    attention: Literal["sdpa", "eager", "flash_attention_2", "flex_attention"] = setting("sdpa", changes="speed")
    """Attention implementation of transformers."""
    final_norm: bool = setting(True, changes="numbers")
    """Transformers: apply the norm after the last block, as DINOv2 does; BoQ's release does not."""
    resnet: ResNetConfig = field(default_factory=ResNetConfig)
    """Residual networks: the part used, the origin of the weights, sizes of resnet_custom."""
    vgg: VGGConfig = field(default_factory=VGGConfig)
    """VGG-16: the part used and the origin of the weights."""
    transvpr: TransVPRConfig = field(default_factory=TransVPRConfig)
    """TransVPR's: sizes."""


@dataclass(frozen=True)
class AdapterConfig(Settings):
    """The adapter beside the MLP of every block (paper, section 3.3)."""

    kind: Literal["mulconv", "vanilla", "conv", "conv1x1", "conv3x3", "conv5x5", "none"] = setting(
        "mulconv", changes="numbers"
    )
    """mulconv (paper); vanilla bottleneck; conv: 3x3 without skip (Convpass-like); single kernels with skip; none."""
    ratio: float = setting(0.5, changes="numbers", above=0, at_most=16)
    """Bottleneck width divided by dim (paper: 0.5, so 384)."""
    reduced: int = setting(24, changes="numbers", at_least=1, at_most=8192)
    """Channels after the 1x1 reduction of the 3x3 and 5x5 paths (paper: 24)."""
    scale: float = setting(0.2, changes="numbers")
    """The factor s of Eq. 4 (paper: 0.2)."""
    norm: Literal["batch", "group", "none"] = setting("batch", changes="numbers")
    """Normalisation in the convolution paths: global BatchNorm (published), GroupNorm (per image), or none."""
    init: Literal["kaiming", "published"] = setting("kaiming", changes="numbers")
    """Convolution initialisation: Kaiming (ours), or the published constant 1e-5, which keeps the channels of a
    reduction identical during the whole training."""


@dataclass(frozen=True)
class PoolingConfig(Settings):
    """Patch tokens to regional features (paper, section 3.2), or one of the baselines' aggregators."""

    kind: PoolingKind = setting("spm", changes="numbers")
    """spm: pyramid, class token as its first level (paper); spmg: GeM on all levels; gem: one GeM; cls: class token;
    netvlad, cosplace, mixvpr, salad, boq, transvpr: the aggregators of those methods, set below."""
    levels: tuple[int, ...] = setting((1, 2, 3), changes="numbers", at_least=1, at_most=64)
    """Pyramid levels n, each of n x n cells (paper: 1, 2, 3, so 14 regions)."""
    p: float = setting(3.0, changes="numbers", above=0, at_most=1000)
    """Initial exponent of GeM, learnable and shared (published: 3)."""
    normalise: bool = setting(True, changes="numbers")
    """spm, spmg, gem: L2-normalise each patch token over channels before GeM (published: yes)."""
    netvlad: NetVLADConfig = field(default_factory=NetVLADConfig)
    """NetVLAD."""
    cosplace: CosPlaceConfig = field(default_factory=CosPlaceConfig)
    """CosPlace."""
    mixvpr: MixVPRConfig = field(default_factory=MixVPRConfig)
    """MixVPR."""
    salad: SALADConfig = field(default_factory=SALADConfig)
    """SALAD."""
    boq: BoQConfig = field(default_factory=BoQConfig)
    """BoQ."""
    transvpr: AttentionMapsConfig = field(default_factory=AttentionMapsConfig)
    """TransVPR."""


@dataclass(frozen=True)
class CrossImageConfig(Settings):
    """The cross-image encoder: attention over the images of the batch, region by region (paper, Eq. 3)."""

    layers: int = setting(2, changes="numbers", at_least=0, at_most=100)
    """Transformer encoder layers; 0 leaves the encoder out (paper: 2)."""
    heads: int = setting(16, changes="numbers", at_least=1, at_most=1024)
    """Attention heads (published: 16)."""
    feedforward: int = setting(2048, changes="numbers", at_least=1, at_most=65_536)
    """Width of the feed-forward part (published: 2048)."""
    dropout: float = setting(0.1, changes="numbers", at_least=0, below=1)
    """Dropout in attention, feed-forward and residuals (published: 0.1)."""
    alone: bool = setting(False, changes="numbers")
    """Each image attends to itself only, in training too (ours): a control, the layers without other images."""


@dataclass(frozen=True)
class ModelConfig(Settings):
    """The assembled model."""

    backbone: BackboneConfig = field(default_factory=BackboneConfig)
    """The image encoder."""
    adapter: AdapterConfig = field(default_factory=AdapterConfig)
    """The adapters in its blocks."""
    pooling: PoolingConfig = field(default_factory=PoolingConfig)
    """Regional features."""
    cross_image: CrossImageConfig = field(default_factory=CrossImageConfig)
    """The cross-image encoder."""
    trainable: Literal["adapters", "full", "frozen", "last"] = setting("adapters", changes="numbers", formerly="train")
    """Trained part of the backbone: its adapters (paper), all of it (full), nothing (frozen), or the last blocks."""
    last_blocks: int = setting(4, changes="numbers", at_least=1, at_most=100)
    """trainable=last: how many blocks (of a residual network: stages) at the end are trained."""
