"""The assembled model: every variant by name, what is trained, chunks, groups, precision."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor

from pipeline.common.errors import UsageError
from pipeline.config import AdapterConfig, CrossImageConfig, ModelConfig
from pipeline.model.variants import PAPER, variant
from pipeline.model.vpr import build_model, parameter_counts
from pipeline.model.weights.files import frozen_hash

SIZE = 42


@pytest.mark.parametrize("name", PAPER)
def test_each_variant_trains_all_it_says_and_nothing_else(name: str, small: ModelConfig, small_images: Tensor) -> None:
    config = variant(name, small)
    torch.manual_seed(0)
    model = build_model(config, SIZE)
    descriptors = model(small_images)
    regions = 1 if "GeM" in name else 14
    assert descriptors.shape == (4, 32 * regions) == (4, model.descriptor_dim) and model.regions == regions
    assert torch.allclose(descriptors.norm(dim=1), torch.ones(4))
    (descriptors * torch.randn_like(descriptors)).sum().backward()
    trained = {n for n, p in model.named_parameters() if p.requires_grad}
    assert {n for n, p in model.named_parameters() if p.grad is not None} == trained  # DDP wants none idle
    assert not any(".mlp.adapter." not in n for n in trained if n.startswith("backbone.")) or "Full" in name
    assert ("Full" in name) == ("backbone.vit.embeddings.position_embeddings" in trained)
    assert any(".adapter." in n for n in trained) == (not name.startswith(("Frozen", "Full")))
    assert any(n.startswith("cross_image.") for n in trained) == (config.cross_image.layers > 0)
    assert "backbone.vit.embeddings.mask_token" not in trained


def test_variants_say_what_the_papers_names_say() -> None:
    paper = ModelConfig()
    assert variant("CricaVPR") == variant("AdaptSPM+Crica") == variant("MulConvAdapter") == paper
    assert variant("AdaptGeM") == variant("MulConvAdapter-GeM")
    assert variant("FrozenDINOv2") == variant("FrozenDINOv2-SPM+Crica")
    for name in ("FrozenDINOv2-GeM", "FrozenDINOv2-SPM", "AdaptGeM", "AdaptSPMG", "AdaptSPM"):
        with_crica = variant(f"{name}+Crica")
        assert with_crica.cross_image.layers == 2 and variant(name).cross_image.layers == 0
        assert dataclasses.replace(with_crica, cross_image=CrossImageConfig(layers=0)) == variant(name)
    assert variant("ConvAdapter").adapter.kind == "conv" and variant("3x3").adapter.kind == "conv3x3"
    with pytest.raises(UsageError, match="did you mean 'AdaptSPM\\+Crica'"):
        variant("adaptspm+circa")


@pytest.mark.parametrize("last", [1, 2])
def test_last_blocks_are_trained_with_their_adapters(small: ModelConfig, small_images: Tensor, last: int) -> None:
    model = build_model(dataclasses.replace(small, trainable="last", last_blocks=last), SIZE)
    model(small_images)[:, ::3].sum().backward()
    trained = {n for n, p in model.named_parameters() if p.requires_grad}
    assert trained == {n for n, p in model.named_parameters() if p.grad is not None}
    assert {n.split(".")[4] for n in trained if "encoder.layer" in n} == {str(i) for i in range(2 - last, 2)}
    assert len(model.backbone.adapters()) == last
    with pytest.raises(UsageError, match="last_blocks 3"):
        build_model(dataclasses.replace(small, trainable="last", last_blocks=3), SIZE)


def test_released_sizes_have_the_released_parameter_counts() -> None:
    released = {"s": 22_056_576, "b": 86_580_480, "l": 304_368_640, "g": 1_136_480_768}
    for letter, count in released.items():
        config = ModelConfig(adapter=AdapterConfig(kind="none"), cross_image=CrossImageConfig(layers=0))
        backbone = dataclasses.replace(config.backbone, name=f"dinov2_vit{letter}14")  # type: ignore[arg-type]
        with torch.device("meta"):
            model = build_model(dataclasses.replace(config, backbone=backbone), 224)
        assert parameter_counts(model)["backbone"] == count


@pytest.mark.parametrize("norm", ["batch", "group", "none"])
def test_chunks_change_nothing_but_memory(norm: str, small: ModelConfig, small_images: Tensor) -> None:
    adapter = dataclasses.replace(small.adapter, norm=norm)  # type: ignore[arg-type]
    cross_image = dataclasses.replace(small.cross_image, dropout=0.0)
    model = build_model(dataclasses.replace(small, adapter=adapter, cross_image=cross_image), SIZE).double()
    for block_adapter in model.backbone.adapters():
        torch.nn.init.normal_(block_adapter.up.weight)  # type: ignore[arg-type]
    images = small_images.double()
    gradients = []
    for chunk in (None, 3, 1):
        model.zero_grad()
        out = model(images, chunk=chunk)
        (out * torch.linspace(-1, 1, out.numel()).view_as(out)).sum().backward()
        gradients.append({n: p.grad.clone() for n, p in model.named_parameters() if p.grad is not None})
    for chunked in gradients[1:]:
        for name, whole in gradients[0].items():
            assert torch.allclose(chunked[name], whole, rtol=1e-10, atol=1e-13), name


def test_chunks_leave_the_running_statistics_as_they_would_be(small: ModelConfig, small_images: Tensor) -> None:
    """BatchNorm sees all images at once, and once: neither chunk by chunk nor again when backward recomputes."""
    buffers = []
    for chunk in (None, 3):
        torch.manual_seed(0)
        model = build_model(small, SIZE).double()
        model(small_images.double(), chunk=chunk).sum().backward()
        buffers.append(dict(model.named_buffers()))
        assert "forward" not in model.backbone.blocks[0].__dict__  # nothing left hanging on the blocks
    assert any(name.endswith("running_mean") for name in buffers[0])
    for name, whole in buffers[0].items():
        torch.testing.assert_close(buffers[1][name], whole, rtol=1e-12, atol=1e-14)


def test_chunks_are_whole_and_exact_in_evaluation(small: ModelConfig, small_images: Tensor) -> None:
    model = build_model(small, SIZE).eval()
    with torch.no_grad():
        assert torch.allclose(model(small_images, chunk=3), model(small_images), atol=1e-6)
    with pytest.raises(UsageError, match="encode_chunk 0"):
        model(small_images, chunk=0)


def test_a_descriptor_depends_on_its_group_and_regions_do_not(small: ModelConfig, small_images: Tensor) -> None:
    model = build_model(small, SIZE).eval()
    with torch.no_grad():
        regions = model.encode(small_images)
        assert torch.allclose(regions[:2], model.encode(small_images[:2]), atol=1e-6)
        assert torch.allclose(model.correlate(regions), model(small_images))
        assert (model.correlate(regions)[:2] - model.correlate(regions[:2])).abs().max() > 1e-4
    with pytest.raises(UsageError, match="42"):
        model.encode(small_images[..., :35])


def test_bfloat16_autocast_keeps_unit_float32_descriptors(small: ModelConfig, small_images: Tensor) -> None:
    model = build_model(small, SIZE)
    with torch.autocast("cpu", torch.bfloat16):
        half = model(small_images)
    half[:, 0].sum().backward()
    assert half.dtype == torch.float32 and torch.allclose(half.norm(dim=1), torch.ones(4), atol=1e-6)
    model.eval()
    with torch.no_grad():
        exact = model(small_images)
        with torch.autocast("cpu", torch.bfloat16):
            assert (model(small_images) - exact).abs().max() < 0.02


def test_building_is_drawn_from_the_seed(small: ModelConfig) -> None:
    hashes = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        hashes.append(frozen_hash(build_model(small, SIZE)))
    assert hashes[0] == hashes[1] != hashes[2]
