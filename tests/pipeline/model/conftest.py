"""Published weights made from names, at the paper's and at small sizes; written from the reference's own list."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from pipeline.config import AdapterConfig, BackboneConfig, CrossImageConfig, ModelConfig

SMALL = ModelConfig(
    backbone=BackboneConfig(name="custom", dim=32, depth=2, heads=2, patch=7, pretrain_grid=5),
    adapter=AdapterConfig(reduced=4),
    cross_image=CrossImageConfig(layers=2, heads=4, feedforward=48),
)
SMALL_IMAGE = 42  # 6 x 6 tokens


def backbone_shapes(dim: int, depth: int, patch: int, grid: int, mlp: int) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a released DINOv2 state dict."""
    shapes: dict[str, tuple[int, ...]] = {
        "cls_token": (1, 1, dim), "pos_embed": (1, 1 + grid * grid, dim), "mask_token": (1, dim),
        "patch_embed.proj.weight": (dim, 3, patch, patch), "patch_embed.proj.bias": (dim,),
        "norm.weight": (dim,), "norm.bias": (dim,),
    }  # fmt: skip
    for i in range(depth):
        for name, shape in {
            "norm1": (dim,), "norm2": (dim,), "attn.qkv": (3 * dim, dim), "attn.proj": (dim, dim),
            "mlp.fc1": (mlp, dim), "mlp.fc2": (dim, mlp),
        }.items():  # fmt: skip
            shapes[f"blocks.{i}.{name}.weight"] = shape
            shapes[f"blocks.{i}.{name}.bias"] = shape[:1]
        shapes[f"blocks.{i}.ls1.gamma"] = shapes[f"blocks.{i}.ls2.gamma"] = (dim,)
    return shapes


def published_shapes() -> dict[str, tuple[int, ...]]:
    """Names and shapes of the published CricaVPR state dict, from its description."""
    shapes = {f"backbone.{n}": s for n, s in backbone_shapes(768, 12, 14, 37, 3072).items()}
    for i in range(12):
        adapter = f"backbone.blocks.{i}.adapter"
        for name, shape in {"D_fc1": (384, 768), "D_fc2": (768, 384)}.items():
            shapes |= {f"{adapter}.{name}.weight": shape, f"{adapter}.{name}.bias": shape[:1]}
        for name, conv in {
            "branch1": (192, 384, 1, 1), "branch2.0": (24, 384, 1, 1), "branch2.1": (96, 24, 3, 3),
            "branch3.0": (24, 384, 1, 1), "branch3.1": (96, 24, 5, 5),
        }.items():  # fmt: skip
            shapes |= {f"{adapter}.{name}.conv.weight": conv, f"{adapter}.{name}.conv.bias": conv[:1]}
            for part in ("weight", "bias", "running_mean", "running_var"):
                shapes[f"{adapter}.{name}.bn.{part}"] = conv[:1]
            shapes[f"{adapter}.{name}.bn.num_batches_tracked"] = ()
    shapes["aggregation.1.p"] = (1,)
    for i in range(2):
        layer = f"encoder.layers.{i}"
        shapes |= {f"{layer}.self_attn.in_proj_weight": (2304, 768), f"{layer}.self_attn.in_proj_bias": (2304,)}
        for name, shape in {
            "self_attn.out_proj": (768, 768), "linear1": (2048, 768), "linear2": (768, 2048),
            "norm1": (768,), "norm2": (768,),
        }.items():  # fmt: skip
            shapes |= {f"{layer}.{name}.weight": shape, f"{layer}.{name}.bias": shape[:1]}
    return shapes


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
def published_state(shared_dir: Path) -> dict[str, Tensor]:
    """The 668 tensors behind the reference numbers; read, do not change."""
    return recipe(published_shapes())


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
    return recipe(backbone_shapes(32, 2, 7, 5, 128))
