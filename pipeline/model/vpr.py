"""The assembled model: images -> regional features -> descriptors, with a seam between the two steps.

Invariant: `encode` looks at one image at a time (but for BatchNorm statistics in training), `correlate` looks
across the images: in `train()` mode at the global batch of all ranks, in `eval()` mode at the images given, as one
group on this rank. So the descriptor of an image depends on its group, and never on how a group is split over ranks.
`correlate_beside` looks at one image and a bank (pipeline.model.bank): it depends on no other image at all.
"""

from __future__ import annotations

import dataclasses
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pipeline.common.errors import UsageError
from pipeline.config import ModelConfig
from pipeline.config.image_size import ImageSize
from pipeline.model.aggregators import build_pooling
from pipeline.model.backbones.resnet import ResNet, is_resnet
from pipeline.model.backbones.transformer import Backbone
from pipeline.model.backbones.transvpr import TransVPR
from pipeline.model.backbones.vgg import VGG
from pipeline.model.bank import Bank
from pipeline.model.batch_norm import GlobalBatchNorm2d
from pipeline.model.chunked import in_step, recomputed
from pipeline.model.cross_image import CrossImageEncoder, Memory, check_crossing
from pipeline.model.pooling import at_least_float32
from pipeline.model.products import use_products

Network = Backbone | ResNet | VGG | TransVPR
BESIDE = 8  # images in a call beside a bank: one alone pays for eight, which is 5 % of its way through ViT-B


class PlaceModel(nn.Module):
    """Backbone, pooling and cross-image encoder as one; see `build_model`.

    Attributes:
        config, image_size: what it was built from, the size in its canonical form (224, "480x640", "native640").
        input_size: what a photo is brought to; of `native`, one that depends on the photo.
        regions: R, regional features of an image.
        descriptor_dim: R * D, length of a descriptor; D is the backbone's width, or the aggregator's where it has its
            own (which is R = 1 for those that give one flat descriptor).
    """

    correlates_alone = True  # `correlate` knows `alone`
    bank: Bank | None = None  # the one saved beside the weights; no part of them

    def __init__(self, config: ModelConfig, image_size: int | str) -> None:
        super().__init__()
        self.config = config
        size = ImageSize.of(image_size)
        self.image_size = size.setting
        name = config.backbone.name
        others: dict[str, type[ResNet | VGG | TransVPR]] = {"vgg16": VGG, "transvpr": TransVPR}
        kind: type[Network] = ResNet if is_resnet(name) else others.get(name, Backbone)
        self.backbone: Network = kind(config, size)
        self.pooling = build_pooling(config.pooling, self.backbone.dim, self.backbone.grid)
        self.input_size = self.backbone.size
        if size.native:
            if self.pooling.least is None:
                raise UsageError(
                    f"pooling.kind {config.pooling.kind} has weights for one size of input: image_size "
                    f"{size.setting} is none; give a side, or height x width"
                )
            least = max(self.input_size.least, self.backbone.stride * self.pooling.least)
            self.input_size = dataclasses.replace(self.input_size, least=least)
        self.cross_image = CrossImageEncoder(self.pooling.dim, config.cross_image)
        self.regions = self.pooling.regions
        self.descriptor_dim = self.regions * self.pooling.dim
        use_products(self)

    def encode(self, images: Tensor, chunk: int | None = None) -> Tensor:
        """Regional features of normalised images: [b, 3, H, W] -> [b, R, D].

        Args:
            images: float, ImageNet-normalised, H x W as `input_size` gives them.
            chunk: images encoded at a time and recomputed in backward; the result is the same, to rounding. Each chunk
                keeps its input alone, so peak memory depends on the chunk and not on b. With BatchNorm in training
                the chunks go in step, block by block (pipeline.model.chunked), so that it still sees the global
                batch: then memory grows with b, though much less than without chunks.

        Raises:
            UsageError: images of another size; a chunk below 1.
        """
        if images.ndim != 4 or not self.input_size.takes(*images.shape[-2:]):
            height, width = self.input_size.largest
            wanted = f"[b, 3, {height}, {width}]"
            if self.input_size.native:
                step, least = self.input_size.multiple, self.input_size.least
                wanted = f"[b, 3, H, W], H and W multiples of {step} from {least} to {height}"
            raise UsageError(f"the model takes images {wanted}, got {[*images.shape]}")
        if chunk is None:
            return self._regions(images)
        if chunk < 1:
            raise UsageError(f"train.encode_chunk {chunk} must be at least 1")
        grid = self.backbone.grid_of(*images.shape[-2:])
        if any(isinstance(m, GlobalBatchNorm2d) and m.training for m in self.modules()):
            if isinstance(self.backbone, (ResNet, TransVPR)):
                tokens = self.backbone(images, recompute=True)
            else:
                assert isinstance(self.backbone, Backbone)  # VGG has no BatchNorm
                with in_step(self.backbone, chunk):
                    tokens = self.backbone(images)
            return torch.cat([recomputed(partial(self.pooling, grid=grid), part) for part in tokens.split(chunk)])
        return torch.cat([recomputed(self._regions, part) for part in images.split(chunk)])

    def _regions(self, images: Tensor) -> Tensor:
        regions: Tensor = self.pooling(self.backbone(images), self.backbone.grid_of(*images.shape[-2:]))
        return regions

    def correlate(self, regions: Tensor, alone: bool = False) -> Tensor:
        """Descriptors of the images of a group: [b, R, D] -> [b, R*D], of unit length, float32 at least.

        `alone`: b groups of one image each in one call, equal to b calls but for rounding.
        """
        return self._flat(self.cross_image(regions, len(regions) if alone else 0))

    def correlate_jointly(self, regions: Tensor) -> Tensor:
        """Every image described twice, in the group and alone: [b, R, D] -> [2b, R*D], of unit length.

        Rows: the b images of the group (in training: of the global batch), then the same b images each alone.
        """
        return self._flat(self.cross_image(torch.cat((regions, regions)), len(regions)))

    def remember(self, bank: Bank) -> Memory:
        """The constants of `correlate_beside`: a bank's keys and values in each layer, where the model is.

        Raises:
            UsageError: the model's images do not attend to each other, or the bank is of another model's shape.
        """
        check_crossing(self.config.cross_image, "a bank")
        wanted = (self.regions, self.descriptor_dim // self.regions)
        if tuple(bank.regions.shape[1:]) != wanted:
            raise UsageError(f"the bank's regions are {tuple(bank.regions.shape[1:])}, this model's are {wanted}")
        parameter = next(self.parameters())
        return self.cross_image.remember(bank.regions.to(parameter.device, parameter.dtype))

    def correlate_beside(self, regions: Tensor, memory: Memory) -> Tensor:
        """Each image beside a bank: [b, R, D] -> [b, R*D], of unit length, float32 at least.

        Images go through in calls of one shape, `BESIDE` at a time, the last filled up with zeros: a matrix product may
        round differently for another number of rows, so any other way a descriptor's last bits would depend on how
        many images came with it.
        """
        found = []
        for part in regions.split(BESIDE):
            full = F.pad(part, (0, 0, 0, 0, 0, BESIDE - len(part)))
            found.append(self._flat(self.cross_image.beside(full, memory))[: len(part)])
        return torch.cat(found)

    def _flat(self, related: Tensor) -> Tensor:
        with torch.autocast(related.device.type, enabled=False):
            return F.normalize(at_least_float32(related).flatten(1), dim=-1)

    def forward(self, images: Tensor, chunk: int | None = None, joint: bool = False) -> Tensor:
        """`correlate(encode(images, chunk))`: [b, 3, H, W] -> [b, R*D]; `joint`: `correlate_jointly`, [2b, R*D]."""
        regions = self.encode(images, chunk)
        return self.correlate_jointly(regions) if joint else self.correlate(regions)


def build_model(config: ModelConfig, image_size: int | str) -> PlaceModel:
    """The model of a config for inputs of `image_size` (224, "480x640", "native"), in train mode, parts frozen as
    configured.

    Random parts are drawn from torch's global generator: seed it first.

    Raises:
        UsageError: settings that do not fit each other, or weights that do not fit the backbone.
    """
    return PlaceModel(config, image_size)


def parameter_counts(model: PlaceModel) -> dict[str, int]:
    """Parameters by part: total, trainable, backbone, adapters, cross_image, pooling.

    The paper's model gives 106,761,665 / 20,181,185 / 86,580,480 / 9,153,216 / 11,027,968 / 1: the backbone with
    its stored 37 x 37 position embedding and its mask token, as released.
    """

    def count(*modules: nn.Module) -> int:
        return sum(p.numel() for module in modules for p in module.parameters())

    adapters = count(*model.backbone.adapters())
    return {
        "total": count(model),
        "trainable": sum(p.numel() for p in model.parameters() if p.requires_grad),
        "backbone": count(model.backbone) - adapters,
        "adapters": adapters,
        "cross_image": count(model.cross_image),
        "pooling": count(model.pooling),
    }
