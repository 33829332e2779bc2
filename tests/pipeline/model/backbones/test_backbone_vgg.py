"""VGG-16 as a backbone and NetVLAD's further settings: names on disk, what is trained, earlier stages, starts."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from releases_restated import dinov2, dinov2_shapes, filled, vgg, vgg_shapes

from pipeline.common.errors import UsageError
from pipeline.config import AdapterConfig, BackboneConfig, CrossImageConfig, ModelConfig, PoolingConfig
from pipeline.config.baselines import NetVLADConfig, VGGConfig
from pipeline.model.aggregators.netvlad import NetVLAD
from pipeline.model.backbones.vgg import VGG
from pipeline.model.vpr import build_model
from pipeline.model.weights.names import to_published

CONFIG = ModelConfig(
    backbone=BackboneConfig(name="vgg16"),
    adapter=AdapterConfig(kind="none"),
    pooling=PoolingConfig(kind="netvlad", netvlad=NetVLADConfig(clusters=3, projection=5)),
    cross_image=CrossImageConfig(layers=0),
    trainable="last",
    last_blocks=1,
)


def backbone(**changes: object) -> ModelConfig:
    return dataclasses.replace(CONFIG, backbone=dataclasses.replace(CONFIG.backbone, **changes))  # type: ignore[arg-type]


def test_torchvisions_file_goes_in_and_its_names_come_out(tmp_path: Path) -> None:
    """A whole classifier's file; earlier stages give their map before the pooling, the last its convolution."""
    state = filled(vgg_shapes("features."))
    torch.save(state | {"classifier.0.weight": torch.ones(2, 2)}, tmp_path / "vgg16.pth")
    config = backbone(weights=str(tmp_path / "vgg16.pth"))
    model = build_model(config, 40).eval()
    stored = to_published(model.state_dict())
    assert all(torch.equal(stored[f"backbone.{n}"], t) for n, t in state.items())
    images = torch.randn(1, 3, 40, 40)
    with torch.no_grad():
        for layer, last in ((1, 3), (2, 8), (3, 15), (4, 22), (5, 28), (None, 28)):
            wanted = vgg(state, "features.", images, last).flatten(2).transpose(1, 2)
            assert torch.allclose(model.backbone.patches(images, layer), wanted, atol=1e-4, rtol=1e-4)
        assert torch.allclose(model.backbone(images)[:, 0], wanted.mean(1), atol=1e-4)
        pooled = build_model(backbone(weights=config.backbone.weights, vgg=VGGConfig(cut="pool5")), 40).eval()
        wanted = vgg(state, "features.", images, 30).flatten(2).transpose(1, 2)
        assert torch.allclose(pooled.backbone(images)[:, 1:], wanted, atol=1e-4, rtol=1e-4)


def test_gradients_reach_the_last_stage_and_the_aggregator() -> None:
    torch.manual_seed(0)
    model = build_model(CONFIG, 32)
    out = model(torch.randn(2, 3, 32, 32), chunk=1)
    assert out.shape == (2, 5) and model.regions == 1
    (out * torch.randn_like(out)).sum().backward()
    trained = {n for n, p in model.named_parameters() if p.requires_grad}
    assert {n for n, p in model.named_parameters() if p.grad is not None} == trained
    assert {n.split(".")[1] for n in trained} == {"stage5", "conv", "centroids", "projection"}


def test_settings_that_do_not_fit_are_one_line(tmp_path: Path) -> None:
    torch.save({"conv1.weight": torch.ones(1)}, tmp_path / "resnet.pth")
    for config, size, message in (
        (dataclasses.replace(CONFIG, trainable="adapters"), 32, "adapters belong to transformer blocks"),
        (dataclasses.replace(CONFIG, last_blocks=6), 32, "between 1 and the 5 stages"),
        (CONFIG, 15, "image_size 15 is smaller"),
        (backbone(weights=str(tmp_path / "resnet.pth")), 32, r"resnet\.pth \(for backbone\.name vgg16\).*lacks 26"),
    ):
        with pytest.raises(UsageError, match=message):
            build_model(config, size)
    with pytest.raises(UsageError, match="layer 6"):
        VGG(CONFIG, 32).patches(torch.zeros(1, 3, 32, 32), 6)


def test_a_backbone_without_its_final_norm(tmp_path: Path) -> None:
    """The released file goes in with the norm's tensors, and no trained parameter is idle."""
    state = filled(dinov2_shapes("", 64, 2, 4))
    torch.save(state, tmp_path / "dinov2.pth")
    settings = BackboneConfig(
        name="custom", dim=64, depth=2, heads=1, pretrain_grid=4, weights=str(tmp_path / "dinov2.pth"), final_norm=False
    )
    config = dataclasses.replace(CONFIG, backbone=settings, pooling=PoolingConfig(kind="gem"))
    model = build_model(config, 56)
    images = torch.randn(1, 3, 56, 56)
    patches, token = dinov2(state, "", images, final_norm=False)
    with torch.no_grad():
        tokens = model.backbone(images)
    assert torch.allclose(tokens[:, 1:], patches.flatten(2).transpose(1, 2), atol=1e-4)
    assert torch.allclose(tokens[:, 0], token, atol=1e-4)
    assert torch.equal(model.backbone.patches(images, 2), model.backbone.patches(images))
    (model(images) * torch.randn(64)).sum().backward()
    assert all((p.grad is not None) == p.requires_grad for p in model.parameters())


def test_netvlads_bias_starts_at_the_distance() -> None:
    """With a bias the assignment is by distance: for features off the sphere's middle the nearest centre wins."""
    torch.manual_seed(0)
    module = NetVLAD(NetVLADConfig(clusters=4, bias=True), 6)
    features = F.normalize(torch.randn(200, 6), dim=1)
    module.cluster(features, seed=0)
    assert module.conv.bias is not None
    logits = F.linear(features, module.conv.weight.flatten(1), module.conv.bias).detach()
    distances = torch.cdist(features, module.centroids.detach())
    assert torch.equal(logits.argmax(1), distances.argmin(1))
    top = logits.topk(2).values
    assert float((top[:, 0] - top[:, 1]).mean()) == pytest.approx(4.60517, rel=1e-4)
