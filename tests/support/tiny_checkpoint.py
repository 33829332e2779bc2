"""A run folder with a tiny trained-by-nobody model, saved as a real checkpoint."""

from __future__ import annotations

from pathlib import Path

import torch

from pipeline.config import AdapterConfig, BackboneConfig, CrossImageConfig, ModelConfig, PoolingConfig
from pipeline.model.vpr import build_model
from pipeline.model.weights.files import save_model


def save_tiny(folder: Path, seed: int) -> Path:
    """Writes `<folder>/checkpoints/best/model.safetensors`, 28 pixels, weights of `seed`; returns `folder`."""
    config = ModelConfig(
        backbone=BackboneConfig(name="custom", dim=16, depth=1, heads=2, patch=7, pretrain_grid=4),
        adapter=AdapterConfig(reduced=2),
        pooling=PoolingConfig(levels=(1, 2)),
        cross_image=CrossImageConfig(layers=1, heads=2, feedforward=16),
    )
    torch.manual_seed(seed)
    path = folder / "checkpoints" / "best" / "model.safetensors"
    path.parent.mkdir(parents=True)
    save_model(build_model(config, 28), path, config, 28, everything=True)
    return folder
