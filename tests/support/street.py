"""A small untrained model whose encoder's every parameter matters, and a street of photos for it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from tiny import photo

from pipeline.config import AdapterConfig, BackboneConfig, CrossImageConfig, ModelConfig, PoolingConfig
from pipeline.evaluation.sets.evaluation_set import EvaluationSet
from pipeline.model.vpr import PlaceModel, build_model


def model() -> PlaceModel:
    """28 px, 5 regions of 16 numbers, two encoder layers; the same weights each time."""
    torch.manual_seed(3)
    config = ModelConfig(
        backbone=BackboneConfig(name="custom", dim=16, depth=1, heads=2, patch=7, pretrain_grid=4),
        adapter=AdapterConfig(reduced=2),
        pooling=PoolingConfig(levels=(1, 2)),
        cross_image=CrossImageConfig(layers=2, heads=2, feedforward=16, dropout=0.0),
    )
    built = build_model(config, 28)
    for parameter in built.cross_image.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return built


def street(folder: Path) -> EvaluationSet:
    """23 photos in `folder`, and one query."""
    paths = [folder / f"{i:02d}.jpg" for i in range(23)]
    for i, path in enumerate(paths):
        photo(i, 0).save(path)
    return EvaluationSet("street", paths, paths[:1], [np.zeros(1, np.int64)], "pairs")
