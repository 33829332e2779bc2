"""The models that are measured: the demo's, the paper's, and one for tests.

Invariant: shapes are those of the real runs; weights are random, which costs the same.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from pipeline.config import AdapterConfig, BackboneConfig, CrossImageConfig, ModelConfig
from pipeline.model.vpr import PlaceModel, build_model

Name = Literal["demo", "vitb", "tiny"]
Norm = Literal["batch", "group"]
VIEWS = 4


@dataclass(frozen=True)
class Size:
    """A model and how much of it a measurement takes.

    Attributes:
        model: the config; dropout is off, so that ways can be compared number by number.
        image_size: side of the input in pixels.
        images: a step's images where a CPU computes.
        images_gpu: a step's images on a GPU.
        chunk: images encoded at a time where chunks are timed.
        memory_chunk: the same where their memory is counted.
    """

    model: ModelConfig
    image_size: int
    images: int
    images_gpu: int
    chunk: int
    memory_chunk: int


SIZES: dict[str, Size] = {
    # jobs/configs/demo.yaml
    "demo": Size(
        ModelConfig(
            backbone=BackboneConfig(name="custom", dim=192, depth=4, heads=3, patch=14, pretrain_grid=8),
            adapter=AdapterConfig(reduced=12),
            cross_image=CrossImageConfig(layers=2, heads=8, feedforward=384, dropout=0.0),
            trainable="full",
        ), 112, 32, 288, 16, 36,
    ),
    "vitb": Size(ModelConfig(cross_image=CrossImageConfig(dropout=0.0)), 224, 8, 72, 4, 8),
    "tiny": Size(
        ModelConfig(
            backbone=BackboneConfig(name="custom", dim=32, depth=2, heads=2, patch=14, pretrain_grid=4),
            adapter=AdapterConfig(reduced=4),
            cross_image=CrossImageConfig(layers=1, heads=4, feedforward=48, dropout=0.0),
            trainable="full",
        ), 56, 8, 8, 2, 2,
    ),
}  # fmt: skip


def bare(size: Size, norm: Norm = "batch") -> PlaceModel:
    """The model in train mode, as the library starts it."""
    return build_model(replace(size.model, adapter=replace(size.model.adapter, norm=norm)), size.image_size).train()


def build(size: Size, norm: Norm = "batch", seed: int = 0) -> PlaceModel:
    """The model in train mode, with adapters that already add something (they start at zero)."""
    torch.manual_seed(seed)
    model = bare(size, norm)
    for adapter in model.backbone.adapters():
        torch.nn.init.trunc_normal_(adapter.up.weight, std=0.02)  # type: ignore[union-attr, arg-type]
    return model


def batch(size: Size, images: int, device: torch.device | str = "cpu") -> tuple[Tensor, Tensor]:
    """Noisy views of random places: images [n, 3, S, S] float32 and labels [n], four consecutive images a place."""
    generator = torch.Generator().manual_seed(1)
    shape = (3, size.image_size, size.image_size)
    places = 0.3 * torch.randn(-(-images // VIEWS), 1, *shape, generator=generator)  # faint, so that mining finds pairs
    views = places + torch.randn(len(places), VIEWS, *shape, generator=generator)
    labels = torch.arange(len(places)).repeat_interleave(VIEWS)
    return views.flatten(0, 1)[:images].to(device), labels[:images].to(device)
