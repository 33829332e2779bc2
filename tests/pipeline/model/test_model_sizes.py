"""Inputs that are no squares: tokens, cells and positions follow; one model of `native` is a model of each shape."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny_matchers import transvpr_config
from torch import Tensor

from pipeline.common.errors import UsageError
from pipeline.config import AdapterConfig, BackboneConfig, CrossImageConfig, ModelConfig, PoolingConfig
from pipeline.config.baselines import BoQConfig, CosPlaceConfig, MixVPRConfig, NetVLADConfig, ResNetConfig, SALADConfig
from pipeline.evaluation.identity import model_digest
from pipeline.model.adapters import build_adapter
from pipeline.model.backbones.transformer import resize_positions
from pipeline.model.bank import make_bank
from pipeline.model.pooling import Pooling
from pipeline.model.variants import variant
from pipeline.model.vpr import PlaceModel, build_model
from pipeline.model.weights.files import at_size, load_model, save_model
from pipeline.model.weights.onnx_export import export_onnx

SMALL = ModelConfig(
    backbone=BackboneConfig(name="custom", dim=32, depth=2, heads=2, patch=7, pretrain_grid=5),
    adapter=AdapterConfig(reduced=4),
    cross_image=CrossImageConfig(layers=1, heads=4, feedforward=48, dropout=0.0),
)
POOLING = PoolingConfig(
    netvlad=NetVLADConfig(clusters=4), cosplace=CosPlaceConfig(dim=6), mixvpr=MixVPRConfig(channels=8, rows=2, depth=1),
    salad=SALADConfig(clusters=4, channels=3, token=5, hidden=8, dropout=0.0),
    boq=BoQConfig(channels=64, queries=4, layers=1, rows=3),
)  # fmt: skip


def small(pooling: str = "spm", resnet: bool = False, **backbone: Any) -> ModelConfig:
    config = dataclasses.replace(SMALL, pooling=dataclasses.replace(POOLING, kind=pooling))  # type: ignore[arg-type]
    config = dataclasses.replace(config, backbone=dataclasses.replace(config.backbone, **backbone))
    if pooling != "spm":
        config = dataclasses.replace(config, cross_image=dataclasses.replace(config.cross_image, layers=0))
    if resnet:
        network = ResNetConfig(stages=(1, 1), width=4, cut="layer2")
        config = dataclasses.replace(
            config, trainable="full", adapter=AdapterConfig(kind="none"),
            backbone=dataclasses.replace(config.backbone, name="resnet_custom", resnet=network),
        )  # fmt: skip
    return config


def built(config: ModelConfig, size: int | str) -> PlaceModel:
    """The same weights at any size; adapters and statistics count."""
    torch.manual_seed(7)
    model = build_model(config, size).eval()
    for name, parameter in model.named_parameters():
        if "adapter" in name:
            torch.nn.init.normal_(parameter, std=0.1)
    return model


def images(height: int, width: int, count: int = 2) -> Tensor:
    return torch.randn(count, 3, height, width, generator=torch.Generator().manual_seed(height))


def test_a_square_is_the_same_however_it_is_written() -> None:
    side, product = built(small(), 42), built(small(), "42x42")
    assert product.image_size == 42 == side.image_size and model_digest(product) == model_digest(side)
    with torch.no_grad():
        assert torch.equal(product(images(42, 42)), side(images(42, 42)))


@pytest.mark.parametrize(
    ("config", "unit"),
    [
        (small(), 14), (small("spm", registers=2), 14), (small("spm", rope=True, registers=2), 14),
        (small("spm", True), 14), (small("gem"), 14), (small("netvlad", True), 14), (small("cosplace", True), 14),
        (small("salad"), 14), (small("boq"), 14), (small("boq", True), 14), (transvpr_config(), 16),
        (dataclasses.replace(variant("NetVLAD"), backbone=BackboneConfig(name="vgg16"), last_blocks=1), 16),
    ],
    ids=["spm", "registers", "rope", "resnet", "gem", "netvlad", "cosplace", "salad", "boq", "boq resnet", "transvpr",
         "vgg"],
)  # fmt: skip
def test_a_native_model_is_the_model_of_each_shape(config: ModelConfig, unit: int) -> None:
    """To the last bit, and whatever shape came before."""
    square = built(config, 3 * unit)
    native = at_size(square, f"native{4 * unit}")
    assert native.image_size == f"native{4 * unit}"
    for height, width in ((3 * unit, 4 * unit), (4 * unit, 2 * unit), (3 * unit, 4 * unit), (3 * unit, 3 * unit)):
        fixed = at_size(square, f"{height}x{width}")
        with torch.no_grad():
            found = native(images(height, width))
            assert torch.equal(found, fixed(images(height, width))), (height, width)
            assert torch.equal(native(images(height, width)), found)
    with pytest.raises(UsageError, match=r"takes images \[b, 3, H, W\], H and W multiples of"):
        native(images(5 * unit, 3 * unit))
    with pytest.raises(UsageError, match=rf"takes images \[b, 3, {3 * unit}, {3 * unit}\]"):
        square(images(3 * unit, 4 * unit))


def test_weights_for_one_grid_take_no_other() -> None:
    model = built(small("mixvpr"), "28x56")
    with pytest.raises(UsageError, match="mixvpr are for 28 x 56 px alone, not for 56 x 28 px"):  # as many positions
        at_size(model, "56x28")
    with pytest.raises(UsageError, match="mixvpr are for 28 x 56 px alone, not for photos' own shape"):
        at_size(model, "native")
    with pytest.raises(UsageError, match=r"pooling\.kind mixvpr has weights for one size"):
        build_model(small("mixvpr"), "native56")
    assert at_size(model, "28x56") is model


def test_positions_follow_rows_and_columns_apart() -> None:
    """Of an embedding that changes along one side only, a rectangle has what the square of that side has."""
    line = torch.randn(37, 4, generator=torch.Generator().manual_seed(0))
    by_rows = torch.cat((torch.zeros(1, 4), line.repeat_interleave(37, 0)))[None]
    by_columns = torch.cat((torch.zeros(1, 4), line.repeat(37, 1)))[None]
    for registers in (False, True):
        tall, wide = (
            resize_positions(given, (16, 23), registers)[0, 1:].view(16, 23, 4) for given in (by_rows, by_columns)
        )
        square = [resize_positions(given, (n, n), registers)[0, 1:] for given, n in ((by_rows, 16), (by_columns, 23))]
        torch.testing.assert_close(tall, square[0].view(16, 16, 4)[:, :1].expand(-1, 23, -1), rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(wide, square[1].view(23, 23, 4)[:1].expand(16, -1, -1), rtol=1e-4, atol=1e-5)


def test_cells_of_a_rectangle_are_those_of_its_sides() -> None:
    """Edges floor(i * side / n + 0.5) of each side; plain GeM over each cell."""
    h, w, p = 5, 8, 3.0
    tokens = torch.rand(1, 1 + h * w, 6)
    found = Pooling(PoolingConfig(kind="spmg", levels=(1, 2, 3)), (h, w))(tokens)[0]
    patches = torch.nn.functional.normalize(tokens[0, 1:], dim=-1).view(h, w, 6)
    wanted = []
    for n in (1, 2, 3):
        rows, columns = ([int(i * side / n + 0.5) for i in range(n + 1)] for side in (h, w))
        for i in range(n):
            for j in range(n):
                cell = patches[rows[i] : rows[i + 1], columns[j] : columns[j + 1]].reshape(-1, 6)
                wanted.append(cell.clamp(min=1e-6).pow(p).mean(0).pow(1 / p))
    torch.testing.assert_close(found, torch.stack(wanted))


def test_an_adapters_convolutions_see_the_rectangle() -> None:
    h, w = 4, 7
    adapter = build_adapter(AdapterConfig(kind="conv3x3", norm="none", reduced=3), 16, (h, w))
    for parameter in adapter.parameters():  # no ReLU cuts off
        torch.nn.init.uniform_(parameter)
    x = torch.rand(1, 1 + h * w, 16)
    moved = x.clone()
    moved[0, 1 + 2 * w + 6] += 1  # the last patch of the third row
    changed = (adapter(moved) - adapter(x)).abs().sum(-1)[0, 1:].view(h, w) > 1e-6
    assert {tuple(at) for at in changed.nonzero().tolist()} == {(r, c) for r in (1, 2, 3) for c in (5, 6)}


def test_a_rectangle_trains_also_in_chunks() -> None:
    model = built(small(), "28x56").train()
    gradients = []
    for chunk in (None, 2):
        model.zero_grad()
        descriptors = model(images(28, 56, 4), chunk=chunk)
        (descriptors * torch.arange(descriptors.shape[1]) / 100).sum().backward()
        gradients.append([p.grad.clone() for p in model.parameters() if p.grad is not None])
    for plain, chunked in zip(*gradients, strict=True):
        torch.testing.assert_close(plain, chunked, rtol=1e-3, atol=1e-4)


def test_files_keep_size_and_bank(tmp_path: Path) -> None:
    model = built(small(), "28x56")
    model.bank = make_bank(torch.randn(3, model.regions, model.descriptor_dim // model.regions), "train")
    assert at_size(model, "native").bank is model.bank
    for size in ("28x56", "native640"):
        again = at_size(model, size)
        save_model(again, tmp_path / "m.safetensors", again.config, again.image_size, everything=True)
        loaded = load_model(tmp_path / "m.safetensors")
        assert loaded.image_size == size and model_digest(loaded) == model_digest(model)
        with torch.no_grad():
            assert torch.equal(loaded(images(28, 56)), model(images(28, 56)))


def test_an_onnx_file_has_one_size(tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    with pytest.raises(UsageError, match=r"n\.onnx: an ONNX file has inputs of one size"):
        export_onnx(built(small(), "native"), tmp_path / "n.onnx")


@pytest.mark.slow
def test_an_onnx_file_may_take_rectangles(tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    onnxruntime = pytest.importorskip("onnxruntime")
    assert export_onnx(built(small(), "28x56"), tmp_path / "m.onnx") < 1e-4
    session = onnxruntime.InferenceSession(str(tmp_path / "m.onnx"))
    assert session.get_inputs()[0].shape[2:] == [28, 56]
    assert session.get_modelmeta().custom_metadata_map["image_size"] == "28x56"
