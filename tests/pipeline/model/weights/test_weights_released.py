"""Releases of other methods: our model's descriptors are those of the restated release, for every layout."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from releases_restated import (
    BLOCKS,
    NAMED,
    SEQUENTIAL,
    Shape,
    State,
    boq,
    boq_shapes,
    dinov2,
    dinov2_shapes,
    filled,
    gem,
    linear_shapes,
    mixvpr,
    mixvpr_shapes,
    resnet,
    resnet_shapes,
    salad,
    salad_shapes,
    transvpr,
    transvpr_shapes,
    vgg,
    vgg_shapes,
    vlad,
    vlad_shapes,
)  # fmt: skip
from torch import Tensor

from pipeline.common.errors import DataError, UsageError
from pipeline.config import ModelConfig
from pipeline.model.vpr import PlaceModel
from pipeline.model.weights import convert
from pipeline.model.weights.files import load_model
from pipeline.model.weights.released import RELEASES, from_release, recognise

GEM: Shape = {"aggregation.1.p": (1,)}
SFRS_MEAN = (0.48501960784313836, 0.4579568627450961, 0.4076039215686255)  # its own normalisation, deviation 1 / 255


def sequence(prefix: str) -> list[str]:
    return [prefix + part for part in SEQUENTIAL]


def small(prefix: str = "backbone.", stages: tuple[int, ...] = (1, 1, 2, 1)) -> Shape:
    """A residual network of bottlenecks eight channels wide, cut open."""
    return resnet_shapes(sequence(prefix), stages, width=8)


def sfrs_input(x: Tensor) -> Tensor:
    """ImageNet-normalised images as SFRS wants them."""
    rgb = x * torch.tensor([0.229, 0.224, 0.225]).view(3, 1, 1) + torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1)
    return (rgb - torch.tensor(SFRS_MEAN).view(3, 1, 1)) * 255


def cosplace(state: State, features: Tensor) -> Tensor:
    pooled = gem(F.normalize(features, dim=1), state["aggregation.1.p"])
    return F.normalize(F.linear(pooled, state["aggregation.3.weight"], state["aggregation.3.bias"]), dim=1)


def sfrs(state: State, x: Tensor) -> Tensor:
    found = vlad(state, "net_vlad.", vgg(state, "base_model.base.", sfrs_input(x), 28))
    if "pca_layer.weight" in state:
        found = F.conv2d(found[:, :, None, None], state["pca_layer.weight"], state["pca_layer.bias"]).flatten(1)
    return F.normalize(found, dim=1)


def patch_netvlad(state: State, x: Tensor) -> Tensor:
    found = vlad(state, "pool.", vgg(state, "encoder.", x, 28))
    return F.normalize(
        F.conv2d(found[:, :, None, None], state["WPCA.0.weight"], state["WPCA.0.bias"]).flatten(1), dim=1
    )


def boq_frozen(prefix: str = "backbone.") -> list[str]:
    """The other list of BoQ's ResNet: stem and two stages frozen, the third trained."""
    frozen = [f"{prefix}frozen_layers.{i}" for i in range(3)]
    return [f"{frozen[0]}.0", f"{frozen[0]}.1", *frozen[1:], f"{prefix}unfrozen_layers.0"]


def pca(name: str, out: int, dim: int) -> Shape:
    return {f"{name}.weight": (out, dim, 1, 1), f"{name}.bias": (out,)}


MIXVPR = [f"backbone.model.{part}" for part in NAMED]
CASES: dict[str, tuple[str, int, Shape, Callable[[State, Tensor], Tensor]]] = {
    "CosPlace ResNet-18": (
        "cosplace", 70, resnet_shapes(sequence("backbone."), BLOCKS["resnet18"], basic=True) | GEM
        | linear_shapes("aggregation.3", 32, 512),
        lambda s, x: cosplace(s, resnet(s, sequence("backbone."), x)),
    ),
    "EigenPlaces, bottlenecks": (
        "cosplace", 70, small() | GEM | linear_shapes("aggregation.3", 48, 256),
        lambda s, x: cosplace(s, resnet(s, sequence("backbone."), x)),
    ),
    "CosPlace VGG-16": (
        "cosplace", 50, vgg_shapes("backbone.") | GEM | linear_shapes("aggregation.3", 64, 512),
        lambda s, x: cosplace(s, vgg(s, "backbone.", x, 28)),
    ),
    "GeM, norm before": (
        "gem", 70, small() | GEM,
        lambda s, x: F.normalize(gem(F.normalize(resnet(s, sequence("backbone."), x), dim=1), s["aggregation.1.p"])),
    ),
    "GeM, norm after": (
        "gem", 70, small(stages=(1, 1, 2)) | {"aggregation.0.p": (1,)},
        lambda s, x: F.normalize(gem(resnet(s, sequence("backbone."), x), s["aggregation.0.p"])),
    ),
    "GCL": (
        "gcl", 70, small() | {"pool.p": (1,)},
        lambda s, x: F.normalize(gem(resnet(s, sequence("backbone."), x), s["pool.p"])),
    ),
    "GCL VGG-16": (
        "gcl", 70, vgg_shapes("backbone.") | {"pool.p": (1,)},
        lambda s, x: F.normalize(gem(vgg(s, "backbone.", x, 30), s["pool.p"])),
    ),
    "GCL, average": (
        "gcl_avg", 70, small(), lambda s, x: F.normalize(resnet(s, sequence("backbone."), x).mean((2, 3))),
    ),
    "NetVLAD": (
        "netvlad", 50, vgg_shapes("encoder.") | vlad_shapes("pool.", 6, 512),
        lambda s, x: vlad(s, "pool.", vgg(s, "encoder.", x, 28)),
    ),
    "NetVLAD with bias, Patch-NetVLAD's projection": (
        "netvlad", 50, vgg_shapes("encoder.") | vlad_shapes("pool.", 6, 512, bias=True) | pca("WPCA.0", 20, 6 * 512),
        patch_netvlad,
    ),
    "NetVLAD of the benchmark": (
        "netvlad", 70, small(stages=(1, 1, 2)) | vlad_shapes("aggregation.", 6, 128),
        lambda s, x: vlad(s, "aggregation.", resnet(s, sequence("backbone."), x)),
    ),
    "SFRS": ("sfrs", 50, vgg_shapes("base_model.base.") | vlad_shapes("net_vlad.", 6, 512), sfrs),
    "SFRS with PCA": (
        "sfrs", 50, vgg_shapes("base_model.base.") | vlad_shapes("net_vlad.", 6, 512) | pca("pca_layer", 20, 6 * 512),
        sfrs,
    ),
    "MixVPR": (
        "mixvpr", 80, resnet_shapes(MIXVPR, (1, 1, 2), width=8) | mixvpr_shapes(25, 128, 12, 2, 3, bias=True),
        lambda s, x: mixvpr(s, resnet(s, MIXVPR, x)),
    ),
    "MixVPR, no bias": (
        "mixvpr", 80, resnet_shapes(MIXVPR, (1, 1, 2), width=8) | mixvpr_shapes(25, 128, 12, 2, 3, bias=False),
        lambda s, x: mixvpr(s, resnet(s, MIXVPR, x)),
    ),
    "SALAD": (
        "salad", 70, dinov2_shapes("backbone.model.", 128, 2, 4) | salad_shapes(128, 8, 6, 10, 24),
        lambda s, x: salad(s, *dinov2(s, "backbone.model.", x, final_norm=True)),
    ),
    "BoQ DINOv2": (
        "boq", 70, dinov2_shapes("backbone.dino.", 128, 2, 4) | boq_shapes(128, 128, 5, 2, 3),
        lambda s, x: boq(s, dinov2(s, "backbone.dino.", x, final_norm=False)[0]),
    ),
    "BoQ ResNet": (
        "boq", 70, small("backbone.net.", (1, 1, 2)) | boq_shapes(128, 64, 5, 2, 3),
        lambda s, x: boq(s, resnet(s, sequence("backbone.net."), x)),
    ),
    "TransVPR": ("transvpr", 64, transvpr_shapes(128, 6, 8), transvpr),
    "BoQ ResNet, frozen and trained": (
        "boq", 70, resnet_shapes(boq_frozen(), (1, 1, 2), width=8) | boq_shapes(128, 64, 5, 2, 3),
        lambda s, x: boq(s, resnet(s, boq_frozen(), x)),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_descriptors_are_the_releases(name: str) -> None:
    kind, size, shapes, forward = CASES[name]
    state = filled(shapes)
    assert recognise(state) == ("unpooled" if kind == "gcl_avg" else kind)
    model = from_release(state, "a.pth", kind, size)
    images = torch.randn(2, 3, size, size, generator=torch.Generator().manual_seed(3))
    with torch.no_grad():
        wanted, got = forward(state, images), model(images)
    assert got.shape == wanted.shape == (2, model.descriptor_dim)
    assert (wanted[0] - wanted[1]).norm() > 1e-3  # they depend on the image
    assert torch.allclose(got, wanted, atol=1e-5), (got - wanted).abs().max()


def test_every_kind_is_compared() -> None:
    assert {kind for kind, *_ in CASES.values()} == set(RELEASES) - {"unpooled"}


def test_boqs_release_does_not_use_the_final_norm() -> None:
    """Its weights are in the file, or are not."""
    _, size, shapes, forward = CASES["BoQ DINOv2"]
    state = filled(shapes)
    bare = {n: t for n, t in state.items() if not n.startswith("backbone.dino.norm.")}
    images = torch.randn(1, 3, size, size)
    with torch.no_grad():
        assert torch.equal(from_release(state, "a", None, size)(images), from_release(bare, "a", None, size)(images))
        normed = boq(state, dinov2(state, "backbone.dino.", images, final_norm=True)[0])
        assert not torch.allclose(normed, forward(state, images), atol=1e-3)


def test_wrappers_prefixes_and_half_precision_are_taken_off(tmp_path: Path) -> None:
    """As trainers of parallel modules write them, with counters left out."""
    kind, size, shapes, forward = CASES["NetVLAD"]
    state = filled(shapes)
    wrapped = {n.replace("encoder.", "encoder.module.").replace("pool.", "pool.module."): t for n, t in state.items()}
    path = tmp_path / "model_best.pth.tar"
    torch.save({"epoch": 3, "state_dict": wrapped, "recalls": {1: 0.8}, "optimizer": {"state": {}}}, path)
    assert convert.kind_of(str(path)) == kind
    model = convert.read_model(str(path), kind, ModelConfig(), size)
    images = torch.randn(1, 3, size, size)
    with torch.no_grad():
        assert torch.allclose(model(images), forward(state, images), atol=1e-5)
    _, size, shapes, forward = CASES["EigenPlaces, bottlenecks"]
    state = {n: t.half() if t.is_floating_point() else t for n, t in filled(shapes).items()}
    bare = {f"module.{n}": t for n, t in state.items() if not n.endswith("num_batches_tracked")}
    images = torch.randn(1, 3, size, size)
    wanted = forward({n: t.float() for n, t in state.items()}, images)
    with torch.no_grad():
        assert torch.allclose(from_release(bare, "a", None, size)(images), wanted, atol=1e-5)


@pytest.mark.parametrize(
    "name", ["CosPlace VGG-16", "SFRS with PCA", "BoQ DINOv2", "GCL, average", "MixVPR", "TransVPR"]
)
def test_one_file_of_ours_holds_it_all(name: str, tmp_path: Path) -> None:
    kind, size, shapes, _ = CASES[name]
    model = from_release(filled(shapes), "a.pth", kind, size)
    convert.write_model(model, tmp_path / "x.safetensors", "a.pth")
    again: PlaceModel = load_model(tmp_path / "x.safetensors")
    images = torch.randn(1, 3, size, size)
    with torch.no_grad():
        assert torch.equal(again(images), model(images))
    assert convert.kind_of(str(tmp_path / "x.safetensors")) == "model"


def without(state: State, name: str) -> State:
    return {n: t for n, t in state.items() if n != name}


@pytest.mark.parametrize(
    ("case", "change", "message"),
    [
        ("EigenPlaces, bottlenecks", lambda s: without(s, "backbone.6.1.bn2.bias"),
         r"lacks 1.*'backbone\.6\.1\.bn2\.bias'"),
        ("EigenPlaces, bottlenecks", lambda s: s | {"extra.weight": torch.ones(1)}, r"1 unknown.*'extra\.weight'"),
        ("EigenPlaces, bottlenecks", lambda s: s | {"backbone.5.0.conv2.weight": torch.ones(16, 16, 1, 1)},
         r"'backbone\.5\.0\.conv2\.weight' is 16 x 16 x 1 x 1.*need 16 x 16 x 3 x 3"),
        ("CosPlace ResNet-18", lambda s: {n: t for n, t in s.items() if not n.startswith("backbone.7.1.")},
         r"\(2, 2, 2, 1\) blocks"),
        ("NetVLAD", lambda s: s | {"encoder.0.weight": torch.ones(64, 3, 11, 11)},
         r"'encoder\.0\.weight' is 64 x 3 x 11"),
        ("NetVLAD", lambda s: without(s, "encoder.0.weight"), r"lacks 'encoder\.0\.weight'"),
        ("SALAD", lambda s: s | {"aggregator.score.3.weight": torch.ones(8)}, r"score\.3\.weight' is 8, not of 4 dim"),
        ("BoQ DINOv2", lambda s: without(s, "backbone.dino.cls_token"), r"lacks 1.*'backbone\.dino\.cls_token'"),
        ("GCL, average", lambda s: s, r"pooling left no tensors.*--kind gcl_avg"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_one_line(case: str, change: Callable[[State], State], message: str) -> None:
    state = filled(CASES[case][2])
    with pytest.raises(UsageError, match=message) as caught:
        from_release(change(state), "some.pth", None, CASES[case][1])
    assert "some.pth" in str(caught.value) and "\n" not in str(caught.value)


def test_a_size_or_a_method_that_it_is_not() -> None:
    mixvpr_state, salad_state = (filled(CASES[name][2]) for name in ("MixVPR", "SALAD"))
    assert from_release(mixvpr_state, "m.pth").image_size == 80
    with pytest.raises(UsageError, match=r"m\.pth.*80 px alone, not for 96"):
        from_release(mixvpr_state, "m.pth", None, 96)
    with pytest.raises(UsageError, match=r"s\.pth: not a released MixVPR but a released SALAD"):
        from_release(salad_state, "s.pth", "mixvpr")
    with pytest.raises(UsageError, match=r"x\.pth: not a released GCL with GeM but something that is not known"):
        from_release({"w": torch.ones(1)}, "x.pth", "gcl")
    assert recognise({"backbone.blocks.0.norm1.weight": torch.ones(1), "aggregation.1.p": torch.ones(1)}) is None


def test_code_in_a_checkpoint_is_never_run(tmp_path: Path) -> None:
    state = filled(CASES["SFRS"][2])
    torch.save({"state_dict": state, "args": Path("an object")}, tmp_path / "openibl.pth.tar")
    with pytest.raises(DataError, match=r"openibl\.pth\.tar: not loaded.*code in a file is never run"):
        convert.kind_of(str(tmp_path / "openibl.pth.tar"))
