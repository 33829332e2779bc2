"""Weights from elsewhere and back: kinds are recognised, files stand alone, ONNX computes what torch computes."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from pipeline.common.errors import DataError, UsageError, UserError
from pipeline.config import BackboneConfig, ModelConfig
from pipeline.model.bank import make_bank
from pipeline.model.vpr import PlaceModel, build_model
from pipeline.model.weights import convert
from pipeline.model.weights.files import load_model, save_model

SIZE = 42
onnx_packages = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("onnx", "onnxruntime", "onnxscript")),
    reason="the extra 'onnx' is not installed",
)


def away_from_start(config: ModelConfig) -> PlaceModel:
    """A model whose adapters and statistics count: trained parameters and buffers moved."""
    torch.manual_seed(5)
    model = build_model(config, SIZE)
    with torch.no_grad():
        for parameter in (p for p in model.parameters() if p.requires_grad):
            parameter.add_(0.05 * torch.randn_like(parameter))
    model(torch.randn(3, 3, SIZE, SIZE))
    return model.eval()


@pytest.fixture
def released_model(tmp_path: Path, small: ModelConfig) -> tuple[PlaceModel, Path]:
    """A small model, and its weights as a trainer of parallel modules would have saved them."""
    model, path = away_from_start(small), tmp_path / "CricaVPR.pth"
    convert.write_published(model, path)
    state = torch.load(path, weights_only=True)
    torch.save({"epoch_num": 3, "model_state_dict": {f"module.{n}": t for n, t in state.items()}}, path)
    return model, path


def test_a_release_with_prefixes_becomes_one_file_that_stands_alone(
    released_model: tuple[PlaceModel, Path], small: ModelConfig, small_images: Tensor, tmp_path: Path
) -> None:
    model, path = released_model
    assert convert.kind_of(str(path)) == "cricavpr"
    read = convert.read_model(str(path), "cricavpr", small, SIZE)
    target = tmp_path / "out" / "x.safetensors"
    convert.write_model(read, target, str(path))
    path.unlink()
    with torch.no_grad():
        assert torch.equal(load_model(target)(small_images), model(small_images))
    assert convert.kind_of(str(target)) == "model"
    convert.write_published(load_model(target), tmp_path / "again.pth")
    again, stored = torch.load(tmp_path / "again.pth", weights_only=True), load_file(target)
    assert list(again) and again.keys() == stored.keys()
    assert all(torch.equal(again[name], stored[name]) for name in stored)


def test_a_trained_checkpoint_without_its_backbone_becomes_whole(
    small: ModelConfig, small_release: dict[str, Tensor], small_images: Tensor, tmp_path: Path
) -> None:
    """The checkpoint needs the backbone's file; the exported file must not."""
    release = tmp_path / "dinov2.pth"
    torch.save(small_release, release)
    config = dataclasses.replace(small, backbone=dataclasses.replace(small.backbone, weights=str(release)))
    model = build_model(config, SIZE).eval()
    best = tmp_path / "run" / "checkpoints" / "best" / "model.safetensors"
    save_model(model, best, config, SIZE, everything=False, extra={"step": 7})
    convert.write_model(convert.read_model(str(tmp_path / "run"), "model", small, None), tmp_path / "w.safetensors",
                         str(tmp_path / "run"))  # fmt: skip
    release.unlink()
    with torch.no_grad():
        assert torch.equal(load_model(tmp_path / "w.safetensors")(small_images), model(small_images))
    with pytest.raises(UserError, match=r"dinov2\.pth"):
        load_model(tmp_path / "run")


def test_another_input_size_keeps_the_weights(small: ModelConfig, tmp_path: Path) -> None:
    model = away_from_start(small)
    convert.write_model(model, tmp_path / "m.safetensors", "here")
    larger = convert.read_model(str(tmp_path / "m.safetensors"), "model", small, 56)
    assert larger.image_size == 56 and larger.backbone.grid == (8, 8)  # type: ignore[union-attr]
    assert all(torch.equal(t, larger.state_dict()[n]) for n, t in model.state_dict().items())


def test_backbones_are_told_by_width_depth_and_parts(tmp_path: Path) -> None:
    """Tensors of no bytes but true names: what decides is in the shapes."""
    for name, dim, depth, registers in (("dinov2_vits14", 384, 12, False), ("dinov2_vitl14_reg", 1024, 24, True)):
        state = {"norm.weight": torch.ones(dim), "pos_embed": torch.ones(1, 1, 1), "cls_token": torch.ones(1)}
        state |= {f"blocks.{i}.norm1.weight": torch.ones(1) for i in range(depth)}
        state |= {"register_tokens": torch.ones(1)} if registers else {}
        torch.save(state, tmp_path / "b.pth")
        assert convert.kind_of(str(tmp_path / "b.pth")) == "backbone"
        assert convert.fitting_backbone(str(tmp_path / "b.pth"), BackboneConfig()).name == name
    state = {"norm.weight": torch.ones(100), "blocks.0.norm1.weight": torch.ones(1), "pos_embed": torch.ones(1)}
    torch.save(state, tmp_path / "b.pth")
    with pytest.raises(UsageError, match="1 blocks of width 100 are none of the named backbones"):
        convert.fitting_backbone(str(tmp_path / "b.pth"), BackboneConfig())


def test_a_backbone_file_holds_the_release_tensor_by_tensor(
    small: ModelConfig, small_release: dict[str, Tensor], tmp_path: Path
) -> None:
    torch.save({"teacher": small_release}, tmp_path / "dinov2.pth")
    convert.write_backbone(str(tmp_path / "dinov2.pth"), small.backbone, tmp_path / "b.safetensors")
    stored = load_file(tmp_path / "b.safetensors")
    assert stored.keys() == small_release.keys()
    assert all(torch.equal(stored[name], tensor) for name, tensor in small_release.items())
    wide = dataclasses.replace(small.backbone, dim=48)
    with pytest.raises(UsageError, match=r"dinov2\.pth .* the model wants"):
        convert.write_backbone(str(tmp_path / "dinov2.pth"), wide, tmp_path / "c.safetensors")
    assert not list(tmp_path.glob("*c.safetensors"))


def test_a_backbone_is_no_cricavpr(small: ModelConfig, small_release: dict[str, Tensor], tmp_path: Path) -> None:
    torch.save(small_release, tmp_path / "dinov2.pth")
    with pytest.raises(UsageError, match="neither adapters nor a cross-image encoder"):
        convert.read_model(str(tmp_path / "dinov2.pth"), "cricavpr", small, None)


@onnx_packages
def test_onnx_computes_what_torch_computes(small: ModelConfig, tmp_path: Path) -> None:
    """Descriptors of five images at once, each its own group, against torch taking them one at a time."""
    import onnxruntime

    from pipeline.model.weights import onnx_export

    small = dataclasses.replace(
        small,  # the exporter's time is by the operator
        backbone=dataclasses.replace(small.backbone, depth=1),
        cross_image=dataclasses.replace(small.cross_image, layers=1),
    )
    model, file = away_from_start(small), tmp_path / "m.onnx"
    assert onnx_export.export_onnx(model, file) < 1e-5
    assert [f.name for f in tmp_path.iterdir()] == ["m.onnx"]
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    images = torch.randn(5, 3, SIZE, SIZE)
    found = torch.from_numpy(session.run(None, {"images": images.numpy()})[0])
    with torch.no_grad():
        wanted = torch.cat([model(image[None]) for image in images])
        together = model(images)
    assert torch.allclose(found, wanted, atol=1e-5) and found.shape == (5, model.descriptor_dim)
    assert (found - together).abs().max() > 1e-3  # it is the group of one that was exported, and the group matters
    about = session.get_modelmeta().custom_metadata_map
    assert json.loads(about["config"])["backbone"]["dim"] == 32 and about["groups"] == "single"

    with torch.no_grad():  # other weights: the check of the job must see it
        model.cross_image.layers[0].linear1.weight.add_(0.1)  # type: ignore[union-attr, operator]
    with pytest.raises(DataError, match="onnxruntime differs from torch by"):
        onnx_export.check(model, file, "descriptors")


@onnx_packages
@pytest.mark.slow
def test_onnx_beside_a_bank(small: ModelConfig, tmp_path: Path) -> None:
    """Five images in and five descriptors out, each torch's beside the bank, whose keys and values are constants."""
    import onnxruntime

    from pipeline.model.weights import onnx_export

    backbone = dataclasses.replace(small.backbone, depth=1)
    model, file = away_from_start(dataclasses.replace(small, backbone=backbone)), tmp_path / "m.onnx"
    model.bank = make_bank(torch.randn(6, model.regions, 32), "train")
    assert onnx_export.export_onnx(model, file) < 1e-5
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    images = torch.randn(5, 3, SIZE, SIZE)
    (found,) = session.run(None, {"images": images.numpy()})
    with torch.no_grad():
        wanted = model.correlate_beside(model.encode(images), model.remember(model.bank))
        assert torch.allclose(torch.from_numpy(found), wanted, atol=1e-5)
        assert (wanted - model.correlate(model.encode(images), alone=True)).abs().max() > 1e-3
    assert model.bank.digest in session.get_modelmeta().custom_metadata_map["groups"]


@onnx_packages
@pytest.mark.slow
def test_onnx_of_regions(small: ModelConfig, tmp_path: Path) -> None:
    from pipeline.model.weights import onnx_export

    assert onnx_export.export_onnx(away_from_start(small), tmp_path / "m.onnx", "regions") < 1e-4


def test_without_the_packages_onnx_is_refused_in_one_line(
    small: ModelConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from pipeline.model.weights import onnx_export

    monkeypatch.setattr(onnx_export, "PACKAGES", ("no_such_package",))
    with pytest.raises(UsageError, match=r"needs no_such_package: pip install .*\[onnx\]"):
        onnx_export.export_onnx(build_model(small, SIZE), tmp_path / "m.onnx")
    assert not list(tmp_path.iterdir())
