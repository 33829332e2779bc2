"""Residual networks (He et al., CVPR 2016; ResNeXt: Xie et al., CVPR 2017) as image encoders: the baselines' backbone.

Invariant: tensors carry torchvision's names; the output has the form of the other backbones, patches row by row behind
one token for the whole image, here their mean (what the network's own classifier reads). Frozen stages keep the
statistics they came with; trained ones take them from the global batch.
"""

from __future__ import annotations

import contextlib
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from pipeline.common.errors import UsageError
from pipeline.config import ModelConfig
from pipeline.config.baselines import ResNetConfig
from pipeline.config.image_size import ImageSize
from pipeline.model.batch_norm import GlobalBatchNorm2d
from pipeline.model.pooling import Grid

STAGES: dict[str, tuple[int, ...]] = {
    "resnet18": (2, 2, 2, 2),
    "resnet34": (3, 4, 6, 3),
    "resnet50": (3, 4, 6, 3),
    "resnet101": (3, 4, 23, 3),
    "resnet152": (3, 8, 36, 3),
    "resnext101_32x8d": (3, 4, 23, 3),
}
BASIC = ("resnet18", "resnet34")  # two 3x3 convolutions a block instead of a bottleneck
GROUPS = {"resnext101_32x8d": 32}  # of the middle convolution, which is then four times as wide
EPS = {"torchvision": 1e-5, "keras": 1.001e-5}
# the model's input is normalised with ImageNet's mean and deviation (RGB, 0..1); Keras' weights want BGR less means
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
KERAS_MEANS = (103.939, 116.779, 123.68)


def is_resnet(name: str) -> bool:
    """Whether a backbone's name means a residual network."""
    return name.startswith(("resnet", "resnext"))


class Bottleneck(nn.Module):
    """1x1, 3x3, 1x1 with a skip; the stride sits in the 3x3 (torchvision) or in the first 1x1 (Keras).

    In groups (ResNeXt) the middle is four times as wide: 32 groups of 8 at the first stage, where others have 64.
    """

    expansion = 4

    def __init__(self, channels: int, width: int, stride: int, layout: str, groups: int = 1) -> None:
        super().__init__()
        out, eps, early = 4 * width, EPS[layout], layout == "keras"
        width = width if groups == 1 else 4 * width
        self.conv1 = nn.Conv2d(channels, width, 1, stride if early else 1, bias=False)
        self.bn1 = GlobalBatchNorm2d(width, eps=eps)
        self.conv2 = nn.Conv2d(width, width, 3, 1 if early else stride, padding=1, groups=groups, bias=False)
        self.bn2 = GlobalBatchNorm2d(width, eps=eps)
        self.conv3 = nn.Conv2d(width, out, 1, bias=False)
        self.bn3 = GlobalBatchNorm2d(out, eps=eps)
        self.downsample: nn.Sequential | None = None
        if stride != 1 or channels != out:
            self.downsample = nn.Sequential(
                nn.Conv2d(channels, out, 1, stride, bias=False), GlobalBatchNorm2d(out, eps=eps)
            )

    def forward(self, x: Tensor) -> Tensor:
        """[b, channels, H, W] -> [b, 4 * width, H / stride, W / stride]."""
        skip = x if self.downsample is None else self.downsample(x)
        x = F.relu(self.bn1(self.conv1(x)))
        x = F.relu(self.bn2(self.conv2(x)))
        return F.relu(self.bn3(self.conv3(x)) + skip)


class BasicBlock(nn.Module):
    """3x3, 3x3 with a skip (ResNet-18 and 34); the stride sits in the first."""

    expansion = 1

    def __init__(self, channels: int, width: int, stride: int, layout: str) -> None:
        super().__init__()
        eps = EPS[layout]
        self.conv1 = nn.Conv2d(channels, width, 3, stride, padding=1, bias=False)
        self.bn1 = GlobalBatchNorm2d(width, eps=eps)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.bn2 = GlobalBatchNorm2d(width, eps=eps)
        self.downsample: nn.Sequential | None = None
        if stride != 1 or channels != width:
            self.downsample = nn.Sequential(
                nn.Conv2d(channels, width, 1, stride, bias=False), GlobalBatchNorm2d(width, eps=eps)
            )

    def forward(self, x: Tensor) -> Tensor:
        """[b, channels, H, W] -> [b, width, H / stride, W / stride]."""
        skip = x if self.downsample is None else self.downsample(x)
        x = F.relu(self.bn1(self.conv1(x)))
        return F.relu(self.bn2(self.conv2(x)) + skip)


def check_trained(config: ModelConfig, stages: int) -> None:
    """Whether a network of so many stages can be trained as `config` says.

    Raises:
        UsageError: adapters, or more last stages than there are.
    """
    if config.trainable == "adapters" or config.adapter.kind != "none":
        raise UsageError(
            f"adapters belong to transformer blocks and backbone {config.backbone.name} has none: set "
            "model.adapter.kind none and model.trainable full, last or frozen"
        )
    if config.trainable == "last" and not 1 <= config.last_blocks <= stages:
        raise UsageError(f"model.last_blocks {config.last_blocks} must lie between 1 and the {stages} stages used")


class ResNet(nn.Module):
    """[b, 3, H, W] normalised images -> [b, 1 + h*w, D] tokens of the last stage used; the first is their mean.

    `train` of the model's config: full; frozen; last with `last_blocks` counting stages from the end.

    Attributes:
        size: of the input.
        grid: rows h and columns w of the patches, of the largest input where its size varies.
        stride: pixels from patch to patch.

    Args:
        config: the model's config; used are its backbone and what of it is trained.
        image_size: of the input; any.

    Raises:
        UsageError: adapters (they belong to transformer blocks), more last stages than there are, weights that do not
            fit.
    """

    mean: Tensor
    deviation: Tensor
    keras_means: Tensor

    def __init__(self, config: ModelConfig, image_size: int | str | ImageSize) -> None:
        super().__init__()
        settings, backbone = config.backbone.resnet, config.backbone
        self.layout = settings.layout
        self.depth = int(settings.cut.removeprefix("layer"))
        check_trained(config, self.depth)
        with torch.device("meta") if backbone.weights else contextlib.nullcontext():
            self._build(settings, STAGES.get(backbone.name, settings.stages), backbone.name)
        # the buffers follow from the layout: never stored, and there also where the model is only shapes so far
        shape = (1, 3, 1, 1)
        for name, values in (("mean", MEAN), ("deviation", DEVIATION), ("keras_means", KERAS_MEANS)):
            self.register_buffer(name, torch.tensor(values, device="cpu").view(shape), persistent=False)
        self.size = ImageSize.of(image_size)
        self.grid = self.grid_of(*self.size.largest)
        self.stride = 2 ** (self.depth + 1)
        if backbone.weights:
            from pipeline.model.weights.pretrained import load_resnet

            load_resnet(self, backbone.weights, backbone.name)
        self.trained = {"full": self.depth + 1, "frozen": 0}.get(config.trainable, config.last_blocks)
        for module in self._frozen():
            module.requires_grad_(False)

    def _build(self, settings: ResNetConfig, stages: tuple[int, ...], name: str) -> None:
        width = 64 if name in STAGES else settings.width
        block: Any = BasicBlock if name in BASIC else Bottleneck
        groups = {"groups": GROUPS[name]} if name in GROUPS else {}
        if len(stages) < self.depth:
            raise UsageError(f"backbone.resnet.stages {stages} has fewer stages than {settings.cut}")
        self.conv1 = nn.Conv2d(3, width, 7, 2, padding=3, bias=False)
        self.bn1 = GlobalBatchNorm2d(width, eps=EPS[settings.layout])
        channels = width
        for i in range(self.depth):
            narrow = width * 2**i
            blocks = []
            for j in range(stages[i]):
                blocks.append(block(channels, narrow, 2 if i > 0 and j == 0 else 1, settings.layout, **groups))
                channels = block.expansion * narrow
            self.add_module(f"layer{i + 1}", nn.Sequential(*blocks))
        self.dim = channels
        for module in self.modules():
            if isinstance(module, nn.Conv2d) and not module.weight.is_meta:
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    @property
    def blocks(self) -> list[Any]:
        """The stages in order."""
        return [self.get_submodule(f"layer{i + 1}") for i in range(self.depth)]

    def _frozen(self) -> list[nn.Module]:
        if self.trained > self.depth:
            return []
        return [self.conv1, self.bn1, *self.blocks[: self.depth - self.trained]]

    def train(self, mode: bool = True) -> ResNet:
        """As in torch, but frozen stages stay as in evaluation: their BatchNorm statistics are frozen too."""
        super().train(mode)
        for module in self._frozen():
            module.eval()
        return self

    def grid_of(self, height: int, width: int, layer: int | None = None) -> Grid:
        """Rows and columns of the patches of an input after stage `layer`; None: the last one used."""
        halvings = (layer or self.depth) + 1  # the first convolution, its pooling, and each stage but the first
        return -(-height // 2**halvings), -(-width // 2**halvings)

    def adapters(self) -> list[nn.Module]:
        """None: the counterpart of the transformers' adapters."""
        return []

    def map(self, images: Tensor, recompute: bool = False, stage: int | None = None) -> Tensor:
        """[b, 3, H, W] normalised images -> [b, D, h, w] after the last stage used, or after an earlier one.

        `recompute`: keep bottlenecks' inputs alone.
        """
        x = images
        if self.layout == "keras":
            x = (x * self.deviation.to(x.dtype) + self.mean.to(x.dtype)).flip(1) * 255 - self.keras_means.to(x.dtype)
        x = F.max_pool2d(F.relu(self.bn1(self.conv1(x))), 3, 2, padding=1)
        for blocks in self.blocks[:stage]:
            for block in blocks:
                x = checkpoint(block, x, use_reentrant=False) if recompute and torch.is_grad_enabled() else block(x)
        return x

    def patches(self, images: Tensor, layer: int | None = None) -> Tensor:
        """[b, 3, H, W] -> [b, h*w, D] after stage `layer` (1 is the first); None: the last one used.

        Raises:
            UsageError: no such stage.
        """
        if layer is not None and not 1 <= layer <= self.depth:
            raise UsageError(f"layer {layer}: the stages used of the backbone are 1 to {self.depth}")
        return self.map(images, stage=layer).flatten(2).transpose(1, 2)

    def forward(self, images: Tensor, recompute: bool = False) -> Tensor:
        """[b, 3, H, W] -> [b, 1 + h*w, D]."""
        patches = self.map(images, recompute).flatten(2).transpose(1, 2)
        return torch.cat((patches.mean(1, keepdim=True), patches), dim=1)
