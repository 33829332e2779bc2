"""Pooling, adapters and backbone against definitions restated here, and against the library."""

from __future__ import annotations

import dataclasses

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from pipeline.common.errors import UsageError
from pipeline.config import AdapterConfig, BackboneConfig, ModelConfig, PoolingConfig
from pipeline.model.adapters import ConvAdapter, build_adapter
from pipeline.model.backbones.transformer import Backbone, resize_positions
from pipeline.model.pooling import Pooling, cell_edges


@pytest.fixture(autouse=True)
def same_draws() -> None:
    torch.manual_seed(0)


@pytest.mark.parametrize(
    ("grid", "cells", "edges"),
    [(16, 1, [0, 16]), (16, 2, [0, 8, 16]), (16, 3, [0, 5, 11, 16]), (23, 2, [0, 12, 23]), (23, 3, [0, 8, 15, 23])],
)
def test_cell_edges(grid: int, cells: int, edges: list[int]) -> None:
    assert cell_edges(grid, cells) == edges


def pooled_slowly(tokens: Tensor, kind: str, levels: tuple[int, ...], p: float) -> Tensor:
    """The definition, cell by cell."""
    side = round((tokens.shape[1] - 1) ** 0.5)
    patches = F.normalize(tokens[:, 1:], dim=-1).unflatten(1, (side, side))
    regions = []
    for n in levels:
        if kind == "cls" or (kind == "spm" and n == 1):
            regions.append(tokens[:, 0])
            continue
        edges = [int(i * side / n + 0.5) for i in range(n + 1)]
        for row in range(n):
            for column in range(n):
                cell = patches[:, edges[row] : edges[row + 1], edges[column] : edges[column + 1]]
                regions.append(cell.clamp(min=1e-6).pow(p).mean((1, 2)).pow(1 / p))
    return torch.stack(regions, dim=1)


@pytest.mark.parametrize(
    ("kind", "levels", "count"),
    [
        ("spm", (1, 2, 3), 14), ("spmg", (1, 2, 3), 14), ("spm", (1,), 1), ("spm", (2, 1, 4), 21), ("spm", (2, 3), 13),
        ("spmg", (1,), 1), ("gem", (1,), 1), ("cls", (1,), 1),
    ],
)  # fmt: skip
def test_pooling_is_its_definition(kind: str, levels: tuple[int, ...], count: int) -> None:
    pooling = Pooling(PoolingConfig(kind=kind, levels=levels, p=2.5), (7, 7)).double()  # type: ignore[arg-type]
    tokens = torch.randn(2, 50, 8, dtype=torch.float64)
    regions = pooling(tokens)
    assert regions.shape == (2, count, 8) and pooling.regions == count
    assert torch.allclose(regions, pooled_slowly(tokens, kind, levels, 2.5), atol=1e-13)
    assert (pooling.p is None) == (kind == "cls" or (levels == (1,) and kind == "spm"))  # no idle parameter


def test_pooling_stays_float32_under_autocast() -> None:
    pooling = Pooling(PoolingConfig(), (6, 6))
    tokens = torch.randn(2, 37, 8)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(pooling(tokens), pooling(tokens.clone()))
        half = pooling(tokens)
    assert half.dtype == torch.float32 and torch.allclose(half, pooling(tokens), atol=1e-6)


def test_pooling_refuses_more_cells_than_tokens() -> None:
    with pytest.raises(UsageError, match="levels"):
        Pooling(PoolingConfig(levels=(1, 9)), (8, 8))


def stirred(config: AdapterConfig, side: int = 5, dim: int = 16) -> ConvAdapter:
    adapter = build_adapter(config, dim, (side, side)).double()
    for name, parameter in adapter.named_parameters():
        torch.nn.init.normal_(parameter, std=0.3)
        if name.endswith("conv.bias"):  # else now and then all ReLUs of a narrow path are at zero
            parameter.data.abs_().add_(1.0)
    assert isinstance(adapter, ConvAdapter)
    return adapter


@pytest.mark.parametrize(
    ("kind", "reach", "times"),
    [("mulconv", 2, 2), ("conv", 1, 1), ("conv1x1", 0, 2), ("conv3x3", 1, 2), ("conv5x5", 2, 2)],
)
def test_adapter_kernels_and_skip(kind: str, reach: int, times: int) -> None:
    """How far one patch reaches over the others, and how often the class token enters the last Linear."""
    adapter = stirred(AdapterConfig(kind=kind, norm="none", reduced=3), side=9)  # type: ignore[arg-type]
    x = torch.randn(1, 1 + 81, 16, dtype=torch.float64)
    moved = x.clone()
    moved[0, 1 + 40] += 1.0  # the middle of 9 x 9
    change = (adapter(moved) - adapter(x)).abs().sum(-1)[0]
    assert change[0] == 0
    far = change[1:].view(9, 9).nonzero().sub(4).abs().max()
    assert far == reach
    hidden = torch.relu(adapter.down(x[:, 0]))
    assert torch.allclose(adapter(x)[:, 0], adapter.up(times * hidden), atol=1e-12)


def path_by_path(adapter: ConvAdapter, x: Tensor) -> Tensor:
    """The definition: each convolution, its norm and a ReLU by themselves, in torch's own modules."""
    hidden = torch.relu(adapter.down(x))
    side = round((x.shape[1] - 1) ** 0.5)
    ends = []
    for path in adapter.paths:
        grid = hidden[:, 1:].transpose(1, 2).unflatten(2, (side, side))
        for step in path if isinstance(path, torch.nn.Sequential) else [path]:
            grid = torch.relu(step.norm(step.conv(grid)))  # type: ignore[operator, union-attr]
        ends.append(grid.flatten(2).transpose(1, 2))
    mixed = torch.cat((hidden[:, :1], torch.cat(ends, 2)), 1)
    out: Tensor = adapter.up(mixed + hidden if adapter.skip else mixed)
    return out


@pytest.mark.parametrize("train", [True, False])
@pytest.mark.parametrize("norm", ["batch", "group", "none"])
@pytest.mark.parametrize("kind", ["mulconv", "conv", "conv1x1", "conv3x3", "conv5x5"])
def test_adapter_is_its_paths_one_by_one(kind: str, norm: str, train: bool) -> None:
    """Output, gradients and running buffers, though convolutions and norms side by side are computed together."""
    adapter = stirred(AdapterConfig(kind=kind, norm=norm, reduced=3)).train(train)  # type: ignore[arg-type]
    x = torch.randn(3, 1 + 25, 16, dtype=torch.float64)
    start = {name: value.clone() for name, value in adapter.state_dict().items()}
    found = []
    for run in (adapter, lambda x: path_by_path(adapter, x)):
        adapter.load_state_dict(start)
        adapter.zero_grad()
        asked = x.clone().requires_grad_()
        out = run(asked)
        (out**2).sum().backward()
        gradients = {name: p.grad.clone() for name, p in adapter.named_parameters() if p.grad is not None}
        found.append(gradients | {"out": out.detach(), "x": asked.grad})
        found[-1] |= {f"buffer {name}": value.clone() for name, value in adapter.named_buffers()}
    for name, value in found[1].items():
        assert torch.allclose(found[0][name], value, rtol=1e-9, atol=1e-9), name


@pytest.mark.parametrize("norm", ["batch", "group", "none"])
def test_adapter_norm_decides_whether_images_mix(norm: str) -> None:
    adapter = stirred(AdapterConfig(norm=norm, reduced=3)).train()  # type: ignore[arg-type]
    x = torch.randn(3, 1 + 25, 16, dtype=torch.float64)
    alone = adapter(x[:1])
    assert torch.allclose(adapter(x)[:1], alone, atol=1e-12) == (norm != "batch")


def test_adapter_initialisation() -> None:
    """Both start at a zero output; the published constant makes the reduced channels alike, Kaiming does not."""
    x = torch.randn(2, 1 + 25, 64)
    for init in ("published", "kaiming"):
        adapter = build_adapter(AdapterConfig(init=init), 64, (5, 5))  # type: ignore[arg-type]
        assert not adapter(x).any()
        reduction = next(p.detach() for n, p in adapter.named_parameters() if n == "paths.1.0.conv.weight")
        assert bool(torch.equal(reduction, torch.full_like(reduction, 1e-5))) == (init == "published")
        assert (float(reduction.std(0).max()) == 0.0) == (init == "published")
    gain = float(reduction.std()) * (32**0.5)  # fan-in 32: Kaiming's deviation is sqrt(2 / fan-in)
    assert gain == pytest.approx(2**0.5, rel=0.1)


def test_positions_resize_by_scale_and_pass_gradient() -> None:
    stored = torch.randn(1, 1 + 37 * 37, 4, dtype=torch.float64)
    frozen = resize_positions(stored, (23, 23))
    trained = resize_positions(stored.clone().requires_grad_(), (23, 23))
    assert frozen.shape == (1, 1 + 23 * 23, 4) and torch.equal(frozen[:, 0], stored[:, 0])
    assert torch.allclose(frozen, trained.detach(), atol=1e-5) and trained.requires_grad
    by_size = F.interpolate(stored[:, 1:].reshape(1, 37, 37, 4).permute(0, 3, 1, 2), size=(23, 23), mode="bicubic")
    assert (frozen[:, 1:] - by_size.permute(0, 2, 3, 1).flatten(1, 2)).abs().max() > 1e-3
    assert resize_positions(stored, (37, 37)) is stored


@pytest.mark.parametrize("attention", ["sdpa", "eager"])
def test_backbone_without_adapters_is_the_library_model(small: ModelConfig, attention: str) -> None:
    from transformers import Dinov2Config, Dinov2Model

    backbone_config = dataclasses.replace(small.backbone, attention=attention, pretrain_grid=6)
    config = dataclasses.replace(small, backbone=backbone_config, adapter=AdapterConfig(kind="none"))
    ours = Backbone(config, 42).eval()
    torch.nn.init.normal_(ours.vit.embeddings.position_embeddings)
    ours.vit.embeddings.refresh()
    theirs = Dinov2Model(
        Dinov2Config(hidden_size=32, num_hidden_layers=2, num_attention_heads=2, image_size=42, patch_size=7)
    ).eval()
    theirs.load_state_dict({n.removeprefix("vit."): t for n, t in ours.state_dict().items()})
    images = torch.randn(2, 3, 42, 42)
    with torch.no_grad():
        assert torch.allclose(ours(images), theirs(images).last_hidden_state, atol=1e-6)


@pytest.mark.parametrize(
    ("backbone", "size", "complaint"),
    [
        (BackboneConfig(name="custom", dim=32, heads=5), 56, "heads"),
        (BackboneConfig(), 225, "image_size 225"),
        (BackboneConfig(name="custom", dim=32, depth=1, heads=2, attention="flash_attention_2"), 56, "attention"),
        (BackboneConfig(weights="nowhere/to.be"), 224, "no such weights"),
    ],
)
def test_backbone_refuses_what_cannot_be(backbone: BackboneConfig, size: int, complaint: str) -> None:
    with pytest.raises(UsageError, match=complaint) as caught:
        Backbone(ModelConfig(backbone=backbone), size)
    assert "\n" not in str(caught.value)
