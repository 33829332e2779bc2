"""Weights in and out: released files in every naming, our own file, and one clear line where something is wrong."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from pipeline.common.errors import DataError, UsageError, UserError
from pipeline.config import ModelConfig
from pipeline.model.vpr import PlaceModel, build_model
from pipeline.model.weights.files import (
    checkpoint_file,
    from_published,
    frozen_hash,
    load_model,
    load_trainable,
    read_metadata,
    save_model,
)
from pipeline.model.weights.names import layout, published_name, to_published
from pipeline.model.weights.pretrained import read_tensors

SIZE = 42


def with_weights(config: ModelConfig, source: Path | str) -> ModelConfig:
    return dataclasses.replace(config, backbone=dataclasses.replace(config.backbone, weights=str(source)))


def stirred(config: ModelConfig, seed: int = 0) -> PlaceModel:
    """A model whose trained parameters and buffers are all away from their start."""
    torch.manual_seed(seed)
    model = build_model(config, SIZE)
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.requires_grad:
                parameter.add_(0.1 * torch.rand_like(parameter))
    model(torch.randn(3, 3, SIZE, SIZE))  # moves the BatchNorm buffers
    return model.eval()


@pytest.fixture
def release(tmp_path: Path, small_release: dict[str, Tensor]) -> Path:
    """A DINOv2 .pth at the small model's sizes."""
    path = tmp_path / "dinov2.pth"
    torch.save(small_release, path)
    return path


@pytest.mark.parametrize("kind", ["pth", "wrapped", "safetensors", "cricavpr"])
def test_released_backbones_load(
    kind: str, tmp_path: Path, small: ModelConfig, small_release: dict[str, Tensor]
) -> None:
    path = tmp_path / ("x.safetensors" if kind == "safetensors" else "x.pth")
    if kind == "safetensors":
        save_file(small_release, path)
    elif kind == "cricavpr":
        state = {f"module.backbone.{n}": t for n, t in small_release.items()}
        state["module.backbone.blocks.0.adapter.D_fc1.bias"] = torch.zeros(16)
        torch.save({"model_state_dict": state, "best_r5": np.float64(90.5), "recalls": np.ones(4)}, path)
    else:
        torch.save({"teacher": small_release} if kind == "wrapped" else small_release, path)
    model = build_model(with_weights(small, path), SIZE)
    loaded = to_published({f"backbone.{n}": t for n, t in model.backbone.state_dict().items()})
    for name, tensor in small_release.items():
        assert torch.equal(loaded[f"backbone.{name}"], tensor), name
    query = layout(model.state_dict())["backbone.blocks.1.attn.qkv.weight"][0]
    assert torch.equal(model.state_dict()[query], small_release["blocks.1.attn.qkv.weight"][:32])
    assert frozen_hash(model) == frozen_hash(build_model(with_weights(small, path), SIZE))


@pytest.mark.parametrize("shards", [1, 2])
def test_transformers_folders_load(shards: int, tmp_path: Path, small: ModelConfig) -> None:
    from transformers import Dinov2Config, Dinov2Model

    torch.manual_seed(0)
    library = Dinov2Model(
        Dinov2Config(hidden_size=32, num_hidden_layers=2, num_attention_heads=2, image_size=42, patch_size=7)
    ).eval()
    library.save_pretrained(tmp_path, max_shard_size="10GB" if shards == 1 else "60KB")
    assert (len(list(tmp_path.glob("*.safetensors"))) > 1) == (shards > 1)
    config = with_weights(dataclasses.replace(small, trainable="frozen"), tmp_path)
    config = dataclasses.replace(config, backbone=dataclasses.replace(config.backbone, pretrain_grid=6))
    images = torch.randn(2, 3, SIZE, SIZE)
    with torch.no_grad():
        ours = build_model(config, SIZE).eval().backbone(images)
        assert torch.allclose(ours, library(images).last_hidden_state, atol=1e-6)


def test_swiglu_and_both_generations_of_library_names() -> None:
    """ViT-g's fused w12 (gate first) and w3; transformers 5.17 and 5.23 call the same tensors differently."""
    block = "backbone.vit.encoder.layer.3."
    for own, published in {
        "mlp.mlp.gate_proj.weight": ("mlp.w12.weight", 0), "mlp.up_proj.bias": ("mlp.w12.bias", 1),
        "mlp.weights_in.weight": ("mlp.w12.weight", 0), "mlp.weights_out.bias": ("mlp.w3.bias", 0),
        "mlp.down_proj.weight": ("mlp.w3.weight", 0), "attention.v_proj.bias": ("attn.qkv.bias", 2),
        "attention.attention.key.weight": ("attn.qkv.weight", 1), "attention.o_proj.bias": ("attn.proj.bias", 0),
        "attention.output.dense.weight": ("attn.proj.weight", 0), "layer_scale2.lambda1": ("ls2.gamma", 0),
    }.items():  # fmt: skip
        assert published_name(block + own) == (f"backbone.blocks.3.{published[0]}", published[1])
    with torch.device("meta"):
        backbone = dataclasses.replace(ModelConfig().backbone, name="dinov2_vitg14")
        model = build_model(dataclasses.replace(ModelConfig(), backbone=backbone), 224)
    names = layout(model.state_dict())
    gate = [model.state_dict()[n] for n in names["backbone.blocks.39.mlp.w12.weight"]]
    assert [tuple(t.shape) for t in gate] == [(4096, 1536), (4096, 1536)]
    assert model.state_dict()[names["backbone.blocks.0.mlp.w3.weight"][0]].shape == (1536, 4096)


class Trap:
    """Unpickling it would write a file."""

    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (Path(self.path),)


def test_foreign_code_is_never_run(tmp_path: Path) -> None:
    sprung = tmp_path / "sprung"
    torch.save({"blocks.0.norm1.weight": torch.ones(3), "x": Trap(str(sprung))}, tmp_path / "trap.pth")
    with pytest.raises(DataError, match=r"trap\.pth: not loaded") as caught:
        read_tensors(str(tmp_path / "trap.pth"))
    assert not sprung.exists() and "\n" not in str(caught.value)


def test_wrong_weights_are_one_clear_line(tmp_path: Path, small: ModelConfig, small_release: dict[str, Tensor]) -> None:
    cases: list[tuple[str, object, str]] = [
        ("text.pth", b"not a checkpoint", "neither a PyTorch nor"),
        ("text.safetensors", b"not one either", "neither a PyTorch nor"),
        ("list.pth", [1, 2], "holds a list"),
        ("empty.pth", {}, "no tensors"),
        ("other.pth", {"conv1.weight": torch.ones(1)}, "no DINOv2 weights.*conv1.weight"),
        ("registers.pth", small_release | {"register_tokens": torch.ones(1, 4, 32)}, "register tokens"),
        (
            "cut.pth",
            {n: t for n, t in small_release.items() if n != "norm.bias"},
            "lacks 1 tensors.*backbone.norm.bias",
        ),
        ("more.pth", small_release | {"head.weight": torch.ones(1)}, "1 unknown tensors.*head.weight"),
        ("wide.pth", small_release | {"cls_token": torch.ones(1, 1, 48)}, "cls_token' is 1 x 1 x 48 .* 1 x 1 x 32"),
    ]
    for name, content, complaint in cases:
        path = tmp_path / name
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            torch.save(content, path)
        with pytest.raises(UserError, match=complaint) as caught:
            build_model(with_weights(small, path), SIZE)
        assert name in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(UsageError, match=r"holds no model\.safetensors"):
        build_model(with_weights(small, tmp_path), SIZE)


def test_published_weights_load_at_another_input_size(published_state: dict[str, Tensor]) -> None:
    model = from_published(published_state, image_size=322)
    assert model.backbone.vit.embeddings.resized.shape == (1, 1 + 23 * 23, 768)
    assert model.pooling.members.sum(1).tolist()[:4] == [144, 132, 132, 121]  # 12|11 in both directions


def test_published_weights_that_do_not_fit_are_one_clear_line() -> None:
    with pytest.raises(UsageError, match=r"lacks 66\d tensors.*1 unknown tensors, first 'backbone.surplus'"):
        from_published({"module.backbone.surplus": torch.ones(1)})


@pytest.mark.parametrize("everything", [True, False])
@pytest.mark.parametrize("released", [True, False])
def test_a_saved_model_comes_back(
    everything: bool, released: bool, small: ModelConfig, release: Path, tmp_path: Path, small_images: Tensor
) -> None:
    config = with_weights(small, release) if released else small
    model = stirred(config)
    run = tmp_path / "outputs" / "run"
    path = run / "checkpoints" / "step-00000007" / "model.safetensors"
    save_model(model, path, config, SIZE, everything, {"step": 7})
    assert [p.name for p in path.parent.iterdir()] == ["model.safetensors"]
    metadata = read_metadata(path)
    assert metadata["config"] == config and metadata["image_size"] == SIZE and metadata["extra"] == {"step": 7}
    stored = load_file(path)
    assert ("backbone.blocks.0.attn.qkv.weight" in stored) == (everything or not released)
    (run / "checkpoints" / "last").symlink_to("step-00000007")
    torch.manual_seed(99)
    with torch.no_grad():
        wanted = model(small_images)
        for where in (path, path.parent, run):
            again = load_model(where)
            assert not again.training and again.config == config
            assert torch.equal(again(small_images), wanted)
    assert frozen_hash(again) == metadata["backbone_hash"]
    assert {n for n, p in again.named_parameters() if p.requires_grad} == {
        n for n, p in model.named_parameters() if p.requires_grad
    }


def test_the_best_checkpoint_is_preferred_to_the_last(tmp_path: Path, small: ModelConfig) -> None:
    for step in ("step-1", "step-2"):
        save_model(stirred(small), tmp_path / "checkpoints" / step / "model.safetensors", small, SIZE, True)
    (tmp_path / "last").write_text("checkpoints/step-2\n")
    assert checkpoint_file(tmp_path).parent.name == "step-2"
    (tmp_path / "checkpoints" / "best").symlink_to("step-1")
    assert checkpoint_file(tmp_path).resolve().parent.name == "step-1"
    with pytest.raises(UsageError, match="no model there"):
        checkpoint_file(tmp_path / "nowhere")


def test_trained_weights_are_refused_beside_another_backbone(
    small: ModelConfig, release: Path, tmp_path: Path, small_release: dict[str, Tensor]
) -> None:
    config = with_weights(small, release)
    trained, file = stirred(config), tmp_path / "model.safetensors"
    save_model(trained, file, config, SIZE, everything=False)
    fresh = build_model(config, SIZE)
    assert load_trainable(fresh, file)["config"] == config
    for name, tensor in trained.state_dict().items():
        assert torch.equal(fresh.state_dict()[name], tensor), name
    other = tmp_path / "other.pth"
    torch.save(small_release | {"norm.bias": torch.ones(32)}, other)
    with pytest.raises(UsageError, match="other frozen weights"):
        load_trainable(build_model(with_weights(small, other), SIZE), file)
    with pytest.raises(DataError, match="not a model written by this project"):
        save_file(small_release, tmp_path / "foreign.safetensors")
        load_model(tmp_path / "foreign.safetensors")


def test_the_frozen_hash_sees_every_frozen_weight_and_no_trained_one(small: ModelConfig) -> None:
    model = build_model(small, SIZE)
    before = frozen_hash(model)
    with torch.no_grad():
        model.cross_image.layers[0].linear1.weight.add_(1)  # type: ignore[union-attr, operator]
        assert frozen_hash(model) == before
        model.backbone.vit.layernorm.bias[3] += 1e-3
        assert frozen_hash(model) != before
        model.backbone.vit.layernorm.bias[3] = 0
    assert frozen_hash(model) == before
