"""Published weights made from names, at the paper's and at small sizes."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from releases_restated import cricavpr_shapes, dinov2_shapes
from torch import Tensor

from pipeline.config import AdapterConfig, BackboneConfig, CrossImageConfig, ModelConfig

SMALL = ModelConfig(
    backbone=BackboneConfig(name="custom", dim=32, depth=2, heads=2, patch=7, pretrain_grid=5),
    adapter=AdapterConfig(reduced=4),
    cross_image=CrossImageConfig(layers=2, heads=4, feedforward=48),
)
SMALL_IMAGE = 42  # 6 x 6 tokens


def recipe(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Tensor]:
    """Values from names, float32 (num_batches_tracked: integer), by the reference's table."""
    return {name: _value(name, shape) for name, shape in shapes.items()}


def _value(name: str, shape: tuple[int, ...]) -> Tensor:
    if name.endswith("num_batches_tracked"):
        return torch.tensor(0)
    z = np.random.default_rng(zlib.crc32(name.encode())).standard_normal(shape)
    if name.endswith("running_mean"):
        z = 0.05 * z
    elif name.endswith("running_var"):
        z = 0.10 * (1 + 0.5 * abs(z))
    elif name == "aggregation.1.p":
        z = 3 + 0.1 * z
    elif name.endswith(".gamma"):
        z = 0.20 + 0.02 * z
    elif name.endswith((".bias", "in_proj_bias")):
        z = 0.02 * z
    elif "pos_embed" in name or "cls_token" in name:
        z = 0.20 * z
    elif "mask_token" in name:
        z = 0.02 * z
    elif len(shape) == 1:
        z = 1 + 0.1 * z
    else:
        z = (0.05 if name.startswith("encoder.") else 0.02) * z
    return torch.from_numpy(z.astype(np.float32))


@pytest.fixture(scope="session")
def published_state() -> dict[str, Tensor]:
    """The 668 tensors behind the reference numbers; read, do not change."""
    return recipe(cricavpr_shapes(768, 12, 37, 24, 2, 2048))


@pytest.fixture(scope="session")
def reference(shared_dir: Path) -> dict[str, Any]:
    """Arrays of the reference files by "<file>/<array>", read when asked for."""
    return {name: np.load(shared_dir / "reference" / f"{name}.npz") for name in ("model_eval", "train_step")}


@pytest.fixture(scope="session")
def reference_images() -> Tensor:
    """The eight images of the reference, [8, 3, 224, 224] float32."""
    return torch.from_numpy(np.random.default_rng(0).standard_normal((8, 3, 224, 224)).astype(np.float32))


@pytest.fixture
def small() -> ModelConfig:
    """A model of two narrow blocks over 6 x 6 tokens."""
    return SMALL


@pytest.fixture
def small_images() -> Tensor:
    """Four images for the small model."""
    return torch.randn(4, 3, SMALL_IMAGE, SMALL_IMAGE, generator=torch.Generator().manual_seed(1))


@pytest.fixture
def small_release() -> dict[str, Tensor]:
    """A DINOv2 release state dict at the small model's sizes."""
    return recipe(dinov2_shapes("", 32, 2, 5, patch=7))
