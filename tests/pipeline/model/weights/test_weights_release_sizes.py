"""Releases of other methods at their true sizes: what is recognised, and the published numbers of parameters."""

from __future__ import annotations

import pytest
import torch
from releases_restated import (
    BLOCKS,
    NAMED,
    SEQUENTIAL,
    Shape,
    boq_shapes,
    dinov2_shapes,
    filled,
    linear_shapes,
    mixvpr_shapes,
    resnet,
    resnet_shapes,
    salad_shapes,
    vgg_shapes,
    vlad_shapes,
)

from pipeline.common.errors import UsageError
from pipeline.config import AdapterConfig, BackboneConfig, CrossImageConfig, ModelConfig, PoolingConfig
from pipeline.config.baselines import ResNetConfig
from pipeline.model.variants import variant
from pipeline.model.vpr import parameter_counts
from pipeline.model.weights.files import without_weights
from pipeline.model.weights.released import from_release, recognise

GEM: Shape = {"aggregation.1.p": (1,)}
MIXVPR = [f"backbone.model.{part}" for part in NAMED]


def sequence(prefix: str) -> list[str]:
    return [prefix + part for part in SEQUENTIAL]


def pca(name: str, out: int, dim: int) -> Shape:
    return {f"{name}.weight": (out, dim, 1, 1), f"{name}.bias": (out,)}


def published(name: str, cut: str = "layer4") -> ModelConfig:
    return ModelConfig(
        backbone=BackboneConfig(name=name, resnet=ResNetConfig(cut=cut)),  # type: ignore[arg-type]
        adapter=AdapterConfig(kind="none"), pooling=PoolingConfig(kind="gem"),
        cross_image=CrossImageConfig(layers=0), trainable="frozen",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "count"),
    [  # torchvision's, less the classifier
        ("resnet18", 11_689_512 - 513_000), ("resnet34", 21_797_672 - 513_000), ("resnet152", 60_192_808 - 2_049_000),
        ("resnext101_32x8d", 88_791_336 - 2_049_000), ("vgg16", 14_714_688),
    ],
)  # fmt: skip
def test_backbones_have_the_published_parameters(name: str, count: int) -> None:
    assert parameter_counts(without_weights(published(name), 64))["backbone"] == count


FULL = {  # the released sizes: what is recognised, side of the input, dimensions, parameters
    "CosPlace ResNet-50, 2048": (
        resnet_shapes(sequence("backbone."), BLOCKS["resnet50"]) | GEM | linear_shapes("aggregation.3", 2048, 2048),
        ("cosplace", "resnet50", "native640", 2048, 23_508_032 + 1 + 2048 * 2049),
    ),
    "MixVPR": (
        resnet_shapes(MIXVPR, (3, 4, 6)) | mixvpr_shapes(400, 1024, 1024, 4, 4, bias=True),
        ("mixvpr", "resnet50", 320, 4096, 10_880_900),  # 10.88 M
    ),
    "SALAD": (
        dinov2_shapes("backbone.model.", 768, 12, 37) | salad_shapes(768, 64, 128, 256, 512),
        ("salad", "dinov2_vitb14", 322, 8448, 86_580_480 + 1_411_009),
    ),
    "BoQ DINOv2": (
        dinov2_shapes("backbone.dino.", 768, 12, 37) | boq_shapes(768, 384, 64, 2, 32),
        ("boq", "dinov2_vitb14", 322, 12288, None),
    ),
    "BoQ ResNet-50": (
        resnet_shapes(sequence("backbone.net."), (3, 4, 6)) | boq_shapes(1024, 512, 64, 2, 32),
        ("boq", "resnet50", 384, 16384, None),
    ),
    "SFRS": (
        vgg_shapes("base_model.base.") | vlad_shapes("net_vlad.", 64, 512) | pca("pca_layer", 4096, 32768),
        ("sfrs", "vgg16", "480x640", 4096, 14_714_688 + 2 * 32768 + 4096 * 32769),
    ),
    "GCL ResNeXt": (
        resnet_shapes(sequence("backbone."), (3, 4, 23, 3), groups=32) | {"pool.p": (1,)},
        ("gcl", "resnext101_32x8d", "480x640", 2048, 86_742_336 + 1),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FULL)
def test_released_sizes_are_recognised(name: str) -> None:
    shapes, (kind, backbone, size, dim, count) = FULL[name]
    with torch.device("meta"):  # shapes say it all
        state = {n: torch.empty(shape) for n, shape in shapes.items()}
    assert recognise(state) == kind
    model = from_release(state, "a.pth")
    assert (model.config.backbone.name, model.image_size, model.descriptor_dim) == (backbone, size, dim)
    assert count is None or parameter_counts(model)["total"] == count


def test_grouped_bottlenecks_are_resnexts() -> None:
    """ResNeXt's first two stages at full width; they alone are no release."""
    state = filled(resnet_shapes(sequence("backbone."), (3, 4), groups=32))
    images = torch.randn(1, 3, 40, 40)
    model = from_release(state | {"pool.p": torch.ones(1)}, "g.pth", None, 40)
    assert model.config.backbone.name == "resnext101_32x8d" and model.config.backbone.resnet.cut == "layer2"
    with torch.no_grad():
        wanted = resnet(state, sequence("backbone."), images, groups=32)
        assert torch.allclose(model.backbone(images)[:, 1:], wanted.flatten(2).transpose(1, 2), atol=1e-4, rtol=1e-4)
        other = resnet(state, sequence("backbone."), images.flip(3), groups=32)
        assert not torch.allclose(wanted, other, atol=1e-1)
    with pytest.raises(UsageError, match=r"g\.pth.*\(1, 1\) blocks"):
        from_release(filled(resnet_shapes(sequence("backbone."), (1, 1), groups=32) | {"pool.p": (1,)}), "g.pth")


def test_boq_by_name_is_the_released_architecture() -> None:
    assert not variant("BoQ").backbone.final_norm and variant("SALAD").backbone.final_norm
