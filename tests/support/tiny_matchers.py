"""Small models whose parts the second stages of others match."""

from __future__ import annotations

import dataclasses

import torch

from pipeline.config import ModelConfig, PoolingConfig
from pipeline.config.baselines import NetVLADConfig, ResNetConfig, TransVPRConfig
from pipeline.config.model import AdapterConfig, BackboneConfig, CrossImageConfig
from pipeline.model.variants import variant
from pipeline.model.vpr import PlaceModel, build_model


def netvlad(image_size: int = 96) -> PlaceModel:
    """Two stages of a small residual network: a token every 8 pixels; four clusters."""
    torch.manual_seed(0)
    return build_model(
        ModelConfig(
            BackboneConfig(name="resnet_custom", resnet=ResNetConfig(stages=(1, 1), width=8, cut="layer2")),
            AdapterConfig(kind="none"),
            PoolingConfig(kind="netvlad", netvlad=NetVLADConfig(clusters=4)),
            CrossImageConfig(layers=0),
            trainable="full",
        ),
        image_size,
    ).eval()


def transvpr_config(**changes: float) -> ModelConfig:
    """TransVPR with narrow parts."""
    config = variant("TransVPR")
    settings = dataclasses.replace(TransVPRConfig(dim=32, heads=2, width=8), **changes)  # type: ignore[arg-type]
    return dataclasses.replace(config, backbone=dataclasses.replace(config.backbone, transvpr=settings))


def transvpr(image_size: int = 96) -> PlaceModel:
    """A token every 16 pixels."""
    torch.manual_seed(0)
    return build_model(transvpr_config(), image_size).eval()
