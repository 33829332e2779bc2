"""VGG-16 (Simonyan and Zisserman, ICLR 2015) as an image encoder: what NetVLAD, SFRS and their time were built on.

Invariant: tensors carry torchvision's names on disk; the output has the form of the other backbones, patches row by
row behind one token for the whole image, here their mean. There is no normalisation inside, so an image never sees
another.
"""

from __future__ import annotations

import contextlib
import dataclasses

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pipeline.common.errors import UsageError
from pipeline.config import ModelConfig
from pipeline.config.image_size import ImageSize
from pipeline.model.backbones.resnet import DEVIATION, MEAN, check_trained
from pipeline.model.pooling import Grid

# channels and number of the 3x3 convolutions of each stage; stages are parted by 2x2 max pooling
STAGES = ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))
MATCONVNET_MEANS = (123.68, 116.779, 103.939)  # of RGB 0..255


class Stage(nn.Sequential):
    """3x3 convolutions with ReLUs; `bare`: none after the last."""

    def __init__(self, channels: int, width: int, count: int, bare: bool) -> None:
        super().__init__(*(nn.Conv2d(channels if i == 0 else width, width, 3, padding=1) for i in range(count)))
        self.bare = bare

    def forward(self, x: Tensor) -> Tensor:
        """[b, channels, H, W] -> [b, width, H, W]."""
        for i, conv in enumerate(self, 1):
            x = conv(x)
            if not (self.bare and i == len(self)):
                x = F.relu(x)
        return x


class VGG(nn.Module):
    """[b, 3, H, W] normalised images -> [b, 1 + h*w, 512] tokens of the last stage; the first is their mean.

    `train` of the model's config: full; frozen; last with `last_blocks` counting stages from the end.

    Attributes:
        size: of the input.
        grid: rows h and columns w of the patches, of the largest input where its size varies.
        stride: pixels from patch to patch.

    Args:
        config: the model's config; used are its backbone and what of it is trained.
        image_size: of the input; sides of at least the backbone's stride (16 or 32).

    Raises:
        UsageError: adapters (they belong to transformer blocks), more last stages than there are, an input smaller
            than the stride, weights that do not fit.
    """

    mean: Tensor
    deviation: Tensor
    matconvnet_means: Tensor

    def __init__(self, config: ModelConfig, image_size: int | str | ImageSize) -> None:
        super().__init__()
        settings, backbone = config.backbone.vgg, config.backbone
        self.dim, self.depth = STAGES[-1][0], len(STAGES)
        check_trained(config, self.depth)
        self.layout, self.pool_last = settings.layout, settings.cut == "pool5"
        self.stride = 32 if self.pool_last else 16
        size = ImageSize.of(image_size)
        self.size = dataclasses.replace(size, least=max(size.least, self.stride))
        self.grid = self.grid_of(*self.size.largest)
        if min(size.height, size.width) < self.stride:
            raise UsageError(f"image_size {size.setting} is smaller than a patch of backbone {backbone.name}")
        channels = 3
        with torch.device("meta") if backbone.weights else contextlib.nullcontext():
            for i, (width, count) in enumerate(STAGES, 1):
                self.add_module(f"stage{i}", Stage(channels, width, count, bare=i == self.depth and not self.pool_last))
                channels = width
        for conv in self.modules():
            if isinstance(conv, nn.Conv2d) and not conv.weight.is_meta and conv.bias is not None:
                nn.init.kaiming_normal_(conv.weight, mode="fan_out", nonlinearity="relu")
                nn.init.zeros_(conv.bias)
        # the buffers follow from the layout: never stored, and there also where the model is only shapes so far
        for name, values in (("mean", MEAN), ("deviation", DEVIATION), ("matconvnet_means", MATCONVNET_MEANS)):
            self.register_buffer(name, torch.tensor(values, device="cpu").view(1, 3, 1, 1), persistent=False)
        if backbone.weights:
            from pipeline.model.weights.pretrained import load_vgg

            load_vgg(self, backbone.weights, backbone.name)
        trained = {"full": self.depth, "frozen": 0}.get(config.trainable, config.last_blocks)
        for stage in self.blocks[: self.depth - trained]:
            stage.requires_grad_(False)

    @property
    def blocks(self) -> list[nn.Module]:
        """The stages in order."""
        return [self.get_submodule(f"stage{i + 1}") for i in range(self.depth)]

    def grid_of(self, height: int, width: int, layer: int | None = None) -> Grid:
        """Rows and columns of the patches of an input after stage `layer`, before its pooling; None: the last."""
        halvings = 5 if self.pool_last and layer in (None, self.depth) else (layer or self.depth) - 1
        return height // 2**halvings, width // 2**halvings

    def adapters(self) -> list[nn.Module]:
        """None: the counterpart of the transformers' adapters."""
        return []

    def map(self, images: Tensor, stage: int | None = None) -> Tensor:
        """[b, 3, H, W] normalised images -> [b, 512, h, w], or the map after an earlier stage, before its pooling."""
        x = images
        if self.layout == "matconvnet":
            x = (x * self.deviation.to(x.dtype) + self.mean.to(x.dtype)) * 255 - self.matconvnet_means.to(x.dtype)
        for i, block in enumerate(self.blocks[:stage]):
            x = block(x if i == 0 else F.max_pool2d(x, 2))
        return F.max_pool2d(x, 2) if self.pool_last and stage in (None, self.depth) else x

    def patches(self, images: Tensor, layer: int | None = None) -> Tensor:
        """[b, 3, H, W] -> [b, h*w, D] after stage `layer` (1 is the first); None: the last one.

        Raises:
            UsageError: no such stage.
        """
        if layer is not None and not 1 <= layer <= self.depth:
            raise UsageError(f"layer {layer}: the backbone's stages are 1 to {self.depth}")
        return self.map(images, layer).flatten(2).transpose(1, 2)

    def forward(self, images: Tensor) -> Tensor:
        """[b, 3, H, W] -> [b, 1 + h*w, 512]."""
        patches = self.patches(images)
        return torch.cat((patches.mean(1, keepdim=True), patches), dim=1)
