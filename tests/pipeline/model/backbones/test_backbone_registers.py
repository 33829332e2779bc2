"""DINOv2 with registers and DINOv3 against the library's own models and the releases' layouts."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch

from pipeline.config import AdapterConfig, ModelConfig
from pipeline.model.backbones.transformer import Backbone
from pipeline.model.vpr import build_model

SIZE = 42


def with_backbone(config: ModelConfig, **changes: Any) -> ModelConfig:
    return dataclasses.replace(config, backbone=dataclasses.replace(config.backbone, **changes))


def library(rope: bool) -> torch.nn.Module:
    torch.manual_seed(1)
    sizes = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2, "patch_size": 7}
    if rope:
        from transformers import DINOv3ViTConfig, DINOv3ViTModel

        model = DINOv3ViTModel(DINOv3ViTConfig(**sizes, intermediate_size=128, num_register_tokens=4))
    else:
        from transformers import Dinov2WithRegistersConfig, Dinov2WithRegistersModel

        model = Dinov2WithRegistersModel(Dinov2WithRegistersConfig(**sizes, image_size=35))
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return model.eval()


@pytest.mark.parametrize("rope", [True, False])
def test_backbones_with_registers_are_the_library_models(rope: bool, small: ModelConfig, tmp_path: Path) -> None:
    """Loaded from the library's own folder; positions resized from 5 x 5 to 6 x 6; registers stay inside."""
    theirs = library(rope)
    theirs.save_pretrained(tmp_path)
    config = with_backbone(small, registers=4, rope=rope, weights=str(tmp_path))
    ours = Backbone(dataclasses.replace(config, adapter=AdapterConfig(kind="none"), trainable="frozen"), SIZE).eval()
    images = torch.randn(2, 3, SIZE, SIZE)
    with torch.no_grad():
        wanted = theirs(images).last_hidden_state
        tokens = ours(images)
    assert tokens.shape == (2, 37, 32)
    assert torch.allclose(tokens, torch.cat((wanted[:, :1], wanted[:, 5:]), dim=1), atol=2e-5)
    trained = ours.train()(images)
    assert torch.allclose(trained, tokens, atol=2e-5)  # no jitter of positions in train mode


@pytest.mark.parametrize("trainable", ["adapters", "full", "last"])
@pytest.mark.parametrize("rope", [True, False])
def test_adapters_and_training_work_with_registers(rope: bool, trainable: str, small: ModelConfig) -> None:
    config = dataclasses.replace(with_backbone(small, registers=4, rope=rope), trainable=trainable, last_blocks=1)
    model = build_model(config, SIZE)
    (model(torch.randn(4, 3, SIZE, SIZE)) * torch.randn(4, model.descriptor_dim)).sum().backward()
    trained = {n for n, p in model.named_parameters() if p.requires_grad}
    assert {n for n, p in model.named_parameters() if p.grad is not None} == trained
    assert len(model.backbone.adapters()) == (1 if trainable == "last" else 2)  # type: ignore[union-attr]


def test_dinov3_release_layout_loads(small: ModelConfig, tmp_path: Path) -> None:
    """The release fuses query, key, value, masks the key's bias and keeps its rotary periods."""
    theirs = library(True)
    state = {n.removeprefix("model."): t for n, t in theirs.state_dict().items()}
    release = {"storage_tokens": state["embeddings.register_tokens"], "cls_token": state["embeddings.cls_token"],
               "mask_token": state["embeddings.mask_token"][0], "rope_embed.periods": torch.ones(4),
               "patch_embed.proj.weight": state["embeddings.patch_embeddings.weight"],
               "patch_embed.proj.bias": state["embeddings.patch_embeddings.bias"],
               "norm.weight": state["norm.weight"], "norm.bias": state["norm.bias"]}  # fmt: skip
    for i in range(2):
        layer, block = f"layer.{i}", f"blocks.{i}"
        attention = [state[f"{layer}.attention.{p}_proj.weight"] for p in "qkv"]
        biases = [state[f"{layer}.attention.q_proj.bias"], torch.ones(32), state[f"{layer}.attention.v_proj.bias"]]
        release |= {f"{block}.attn.qkv.weight": torch.cat(attention), f"{block}.attn.qkv.bias": torch.cat(biases),
                    f"{block}.attn.qkv.bias_mask": torch.ones(96)}  # fmt: skip
        names = {"attn.proj": "attention.o_proj", "mlp.fc1": "mlp.up_proj", "mlp.fc2": "mlp.down_proj",
                 "norm1": "norm1", "norm2": "norm2"}  # fmt: skip
        for published, own in names.items():
            for part in ("weight", "bias"):
                release[f"{block}.{published}.{part}"] = state[f"{layer}.{own}.{part}"]
        for n in (1, 2):
            release[f"{block}.ls{n}.gamma"] = state[f"{layer}.layer_scale{n}.lambda1"]
    torch.save(release, tmp_path / "dinov3.pth")
    config = with_backbone(small, registers=4, rope=True, weights=str(tmp_path / "dinov3.pth"))
    ours = Backbone(dataclasses.replace(config, adapter=AdapterConfig(kind="none"), trainable="frozen"), SIZE).eval()
    images = torch.randn(2, 3, SIZE, SIZE)
    with torch.no_grad():
        assert torch.allclose(ours(images)[:, 1:], theirs(images).last_hidden_state[:, 5:], atol=2e-5)
