"""Small models whose parts the second stages of others match."""

from __future__ import annotations

import torch

from pipeline.config import ModelConfig, PoolingConfig
from pipeline.config.baselines import NetVLADConfig, ResNetConfig
from pipeline.config.model import AdapterConfig, BackboneConfig, CrossImageConfig
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
