"""The baselines' aggregators against their definitions restated in NumPy, their counts and their symmetries."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from pipeline.common.errors import UsageError
from pipeline.config import ModelConfig, PoolingConfig
from pipeline.config.baselines import (
    BoQConfig,
    CosPlaceConfig,
    MixVPRConfig,
    NetVLADConfig,
    SALADConfig,
    TransVPRConfig,
)
from pipeline.model.aggregators import AGGREGATORS, build_pooling
from pipeline.model.aggregators.netvlad import NetVLAD, k_means
from pipeline.model.aggregators.salad import transport
from pipeline.model.variants import BASELINES, PAPER, variant
from pipeline.model.vpr import build_model, parameter_counts
from pipeline.model.weights.names import fit

DIM, GRID = 12, 5
TINY = PoolingConfig(
    netvlad=NetVLADConfig(clusters=4),
    cosplace=CosPlaceConfig(dim=6),
    mixvpr=MixVPRConfig(channels=7, rows=2, depth=2, mlp_ratio=1.4),
    salad=SALADConfig(clusters=4, channels=3, token=5, hidden=8, dropout=0.0),
    boq=BoQConfig(channels=64, queries=6, layers=2, rows=3),
)


def built(kind: str) -> nn.Module:
    """The aggregator with every parameter away from its start, in float64."""
    torch.manual_seed(3)
    module = build_pooling(dataclasses.replace(TINY, kind=kind), DIM, (GRID, GRID)).double().eval()  # type: ignore[arg-type]
    with torch.no_grad():
        for name, parameter in module.named_parameters():
            if name != "p":
                parameter.add_(0.3 * torch.randn_like(parameter))
    return module


@pytest.fixture
def tokens() -> Tensor:
    """[2, 1 + 25, 12]"""
    return torch.randn(2, 1 + GRID * GRID, DIM, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


def unit(x: np.ndarray, axis: int = -1) -> np.ndarray:
    return x / np.linalg.norm(x, axis=axis, keepdims=True)


def softmax(x: np.ndarray) -> np.ndarray:
    e = np.exp(x - x.max(-1, keepdims=True))
    return e / e.sum(-1, keepdims=True)


def netvlad(w: dict[str, np.ndarray], image: np.ndarray) -> np.ndarray:
    """Residual by residual: V(k) = sum_i a_k(x_i) (x_i - c_k), intra-normalised (equation 4 and section 3.1)."""
    x = unit(image[1:])
    assigned = softmax(x @ w["conv.weight"][:, :, 0, 0].T)
    sums = np.zeros_like(w["centroids"])
    for i in range(len(x)):
        for k in range(len(sums)):
            sums[k] += assigned[i, k] * (x[i] - w["centroids"][k])
    return unit(sums)


def cosplace(w: dict[str, np.ndarray], image: np.ndarray) -> np.ndarray:
    x = np.maximum(unit(image[1:]), 1e-6)
    pooled = (x ** w["p"][0]).mean(0) ** (1 / w["p"][0])
    return w["fc.weight"] @ pooled + w["fc.bias"]


def mixvpr(w: dict[str, np.ndarray], image: np.ndarray) -> np.ndarray:
    maps = image[1:].T  # a row for each channel
    for i in range(2):
        mean, deviation = maps.mean(1, keepdims=True), np.sqrt(maps.var(1, keepdims=True) + 1e-5)
        hidden = (maps - mean) / deviation * w[f"mix.{i}.mix.0.weight"] + w[f"mix.{i}.mix.0.bias"]
        hidden = np.maximum(hidden @ w[f"mix.{i}.mix.1.weight"].T + w[f"mix.{i}.mix.1.bias"], 0)
        maps = maps + hidden @ w[f"mix.{i}.mix.3.weight"].T + w[f"mix.{i}.mix.3.bias"]
    channels = w["channel_proj.weight"] @ maps + w["channel_proj.bias"][:, None]
    return (channels @ w["row_proj.weight"].T + w["row_proj.bias"]).ravel()


def salad(w: dict[str, np.ndarray], image: np.ndarray) -> np.ndarray:
    """Sinkhorn on plain numbers, rows (clusters and dustbin) first, instead of logarithms."""

    def per_patch(name: str) -> np.ndarray:
        hidden = np.maximum(w[f"{name}.0.weight"][:, :, 0, 0] @ image[1:].T + w[f"{name}.0.bias"][:, None], 0)
        return w[f"{name}.3.weight"][:, :, 0, 0] @ hidden + w[f"{name}.3.bias"][:, None]

    scores = per_patch("score")
    m, n = scores.shape
    plan = np.exp(np.vstack([scores, np.full((1, n), w["dust_bin"])]))
    mass = np.append(np.ones(m), n - m)
    for _ in range(3):
        plan *= (mass / plan.sum(1))[:, None]
        plan /= plan.sum(0)
    gathered = unit(per_patch("cluster_features") @ plan[:-1].T, axis=0)
    token = np.maximum(w["token_features.0.weight"] @ image[0] + w["token_features.0.bias"], 0)
    token = w["token_features.2.weight"] @ token + w["token_features.2.bias"]
    return np.concatenate([unit(token), gathered.ravel()])


def boq(w: dict[str, np.ndarray], image: np.ndarray) -> np.ndarray:
    """64 channels, so one head."""

    def norm(x: np.ndarray, name: str) -> np.ndarray:
        centred = x - x.mean(-1, keepdims=True)
        return centred / np.sqrt(x.var(-1, keepdims=True) + 1e-5) * w[f"{name}.weight"] + w[f"{name}.bias"]

    def attend(q: np.ndarray, x: np.ndarray, name: str) -> np.ndarray:
        wq, wk, wv = np.split(w[f"{name}.in_proj_weight"], 3)
        bq, bk, bv = np.split(w[f"{name}.in_proj_bias"], 3)
        out = softmax((q @ wq.T + bq) @ (x @ wk.T + bk).T / 8.0) @ (x @ wv.T + bv)
        return out @ w[f"{name}.out_proj.weight"].T + w[f"{name}.out_proj.bias"]

    grid = np.pad(image[1:].reshape(GRID, GRID, DIM), ((1, 1), (1, 1), (0, 0)))
    x = np.empty((GRID * GRID, 64))
    for i in range(GRID * GRID):
        window = grid[i // GRID : i // GRID + 3, i % GRID : i % GRID + 3]  # [3, 3, D]
        x[i] = np.einsum("ocyx,yxc->o", w["proj_c.weight"], window) + w["proj_c.bias"]
    x, answers = norm(x, "norm_input"), []
    for i in range(2):
        e = f"boqs.{i}.encoder"
        x = norm(x + attend(x, x, f"{e}.self_attn"), f"{e}.norm1")
        hidden = np.maximum(x @ w[f"{e}.linear1.weight"].T + w[f"{e}.linear1.bias"], 0)
        x = norm(x + hidden @ w[f"{e}.linear2.weight"].T + w[f"{e}.linear2.bias"], f"{e}.norm2")
        q = w[f"boqs.{i}.queries"][0]
        q = norm(q + attend(q, q, f"boqs.{i}.self_attn"), f"boqs.{i}.norm_q")
        answers.append(norm(attend(q, x, f"boqs.{i}.cross_attn"), f"boqs.{i}.norm_out"))
    return (np.concatenate(answers).T @ w["fc.weight"].T + w["fc.bias"]).ravel()


def transvpr(w: dict[str, np.ndarray], image: np.ndarray) -> np.ndarray:
    """Three levels of four channels; a map for each."""
    x = image[1:]
    maps = softmax((x @ w["attention_pool.weight"].T + w["attention_pool.bias"]).T)  # [3, 25]
    sums = [sum(maps[level, i] * x[i, 4 * level : 4 * level + 4] for i in range(len(x))) for level in range(3)]
    return w["fc.weight"] @ unit(np.concatenate(sums)) + w["fc.bias"]


TRUTHS = {"netvlad": netvlad, "cosplace": cosplace, "mixvpr": mixvpr, "salad": salad, "boq": boq, "transvpr": transvpr}


def test_every_aggregator_has_a_truth() -> None:
    assert set(TRUTHS) == set(AGGREGATORS)


@pytest.mark.parametrize("kind", [*TRUTHS, "spm", "gem"])
def test_no_parameter_is_a_single_number(kind: str) -> None:
    """FSDP2 shards along the first dimension and refuses a parameter that has none."""
    assert all(parameter.ndim > 0 for parameter in built(kind).parameters())


def test_a_dustbin_stored_as_a_number_is_read() -> None:
    """As the release has it, and files of ours before it became a vector of one."""
    module = built("salad")
    older = {n: t.squeeze() if n == "dust_bin" else t for n, t in module.state_dict().items()}
    assert older["dust_bin"].ndim == 0
    other = build_pooling(dataclasses.replace(TINY, kind="salad"), DIM, (GRID, GRID)).double()
    fit(other, older, "an older file")
    assert torch.equal(other.dust_bin.detach(), module.dust_bin.detach())  # type: ignore[union-attr, operator]


@pytest.mark.parametrize("kind", TRUTHS)
def test_aggregators_are_their_definitions(kind: str, tokens: Tensor) -> None:
    module = built(kind)
    weights = {name: tensor.numpy() for name, tensor in module.state_dict().items()}
    with torch.no_grad():
        regions = module(tokens).numpy()
    assert regions.shape == (2, module.regions, module.dim)
    for i in range(2):
        wanted = TRUTHS[kind](weights, tokens[i].numpy())
        assert np.allclose(regions[i], wanted.reshape(regions[i].shape), rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("kind", TRUTHS)
def test_who_looks_at_the_order_of_patches(kind: str, tokens: Tensor) -> None:
    module = built(kind)
    shuffled = torch.cat((tokens[:, :1], tokens[:, 1:][:, torch.randperm(GRID * GRID)]), dim=1)
    with torch.no_grad():
        same = torch.allclose(module(tokens), module(shuffled), atol=1e-10)
    assert same == (kind not in ("boq", "mixvpr"))  # BoQ's 3x3 projection and MixVPR's mixing look at it


def test_transport_gives_each_patch_its_mass_and_in_time_each_cluster_its_own() -> None:
    scores = 2 * torch.randn(2, 5, 20, dtype=torch.float64)
    three, many = (transport(scores, torch.tensor(1.0, dtype=torch.float64), n) for n in (3, 500))
    for plan in (three, many):
        assert torch.allclose(plan.sum(1), torch.ones(2, 20, dtype=torch.float64), atol=1e-12) and (plan >= 0).all()
    assert torch.allclose(many[:, :5].sum(2), torch.ones(2, 5, dtype=torch.float64), atol=1e-6)
    assert torch.allclose(many[:, 5].sum(1), torch.full((2,), 15.0, dtype=torch.float64), atol=1e-5)


@pytest.mark.parametrize(
    ("kind", "settings", "dim", "grid", "count", "size"),
    [
        ("salad", {}, 768, 16, 1_411_009, 8448),  # "1.4 M" in the paper
        ("mixvpr", {}, 1024, 20, 2_337_604, 4096),  # with ResNet-50 up to layer 3 10.88 M, as published
        ("netvlad", {}, 1024, 20, 2 * 64 * 1024, 65_536),
        ("cosplace", {}, 2048, 10, 1 + 2048 * 512 + 512, 512),
        ("transvpr", {}, 768, 30, 768 * 256 + 256 + 3 * 769, 256),
        ("boq", {}, 768, 16, None, 12_288),
        ("boq", {"boq": BoQConfig(channels=512)}, 1024, 20, None, 16_384),
    ],
)
def test_published_sizes(
    kind: str, settings: dict[str, object], dim: int, grid: int, count: int | None, size: int
) -> None:
    config = dataclasses.replace(PoolingConfig(kind=kind), **settings)  # type: ignore[arg-type]
    module = build_pooling(config, dim, (grid, grid))
    c = config.boq.channels
    if count is None:  # the formula: 3x3 projection and norm; a layer's encoder, two attentions, queries, two norms
        layer = 12 * c * c + 13 * c + 2 * (4 * c * c + 4 * c) + 64 * c + 4 * c
        count = 9 * dim * c + 3 * c + 2 * layer + 129 * 32
    assert sum(p.numel() for p in module.parameters()) == count
    assert module.regions * module.dim == size


def test_mixvpr_with_its_backbone_has_the_published_count() -> None:
    counts = parameter_counts(build_model(variant("MixVPR"), 320))
    assert counts["backbone"] == 8_543_296 and counts["total"] == 10_880_900


def test_k_means_finds_what_is_there() -> None:
    generator = torch.Generator().manual_seed(0)
    truth = 10 * torch.randn(6, 4, generator=generator)
    points = truth.repeat_interleave(50, 0) + 0.1 * torch.randn(300, 4, generator=generator)
    centres = k_means(points, 6, seed=1)
    nearest = torch.cdist(truth, centres).min(1)
    assert sorted(nearest.indices.tolist()) == list(range(6)) and nearest.values.max() < 0.1
    assert torch.equal(centres, k_means(points, 6, seed=1))
    assert k_means(points[:3], 6, seed=1).isfinite().all()


def test_clustering_sets_netvlad_as_published() -> None:
    """Centres lie where features are; on average the nearest is 100 times as likely as the second."""
    torch.manual_seed(0)
    module = NetVLAD(NetVLADConfig(clusters=5), 8)
    directions = torch.nn.functional.normalize(torch.randn(5, 8), dim=1)
    features = 3 * (directions.repeat_interleave(40, 0) + 0.05 * torch.randn(200, 8))
    module.cluster(features, seed=0)
    assert torch.cdist(directions, module.centroids.detach()).min(1).values.max() < 0.1
    x = torch.nn.functional.normalize(features, dim=1)
    logits = (x @ module.conv.weight.detach()[:, :, 0, 0].T).topk(2).values
    assert float((logits[:, 0] - logits[:, 1]).mean()) == pytest.approx(math.log(100), rel=1e-4)


SMALL_PARTS: dict[str, object] = {
    "netvlad": NetVLADConfig(clusters=4),
    "salad": SALADConfig(clusters=3, channels=4, token=8, hidden=16),
    "mixvpr": MixVPRConfig(channels=8, rows=2),
}


@pytest.mark.parametrize("name", BASELINES)
def test_each_baseline_trains_all_it_says(name: str, small: ModelConfig) -> None:
    """One step's gradients reach every trained parameter; widths and stages as in the variant, the rest small."""
    config = variant(name, small)
    parts = SMALL_PARTS | {"boq": BoQConfig(channels=64, queries=4)}
    resnet = dataclasses.replace(config.backbone.resnet, stages=(1, 1, 1, 1), width=4)
    names = {"resnet50": "resnet_custom", "transvpr": "transvpr"}
    backbone = dataclasses.replace(
        config.backbone,
        name=names.get(config.backbone.name, "custom"),  # type: ignore[arg-type]
        resnet=resnet,
        transvpr=TransVPRConfig(dim=16, width=4),
    )
    last = min(config.last_blocks, 2)
    pooling = dataclasses.replace(config.pooling, **parts)
    config = dataclasses.replace(config, backbone=backbone, pooling=pooling, last_blocks=last)
    size = {"resnet_custom": 84, "transvpr": 48}.get(backbone.name, 42)
    torch.manual_seed(0)
    model = build_model(config, size)
    descriptors = model(torch.randn(4, 3, size, size))
    assert descriptors.shape == (4, model.descriptor_dim)
    assert torch.allclose(descriptors.norm(dim=1), torch.ones(4), atol=1e-5)
    (descriptors * torch.randn_like(descriptors)).sum().backward()
    trained = {n for n, p in model.named_parameters() if p.requires_grad}
    assert {n for n, p in model.named_parameters() if p.grad is not None} == trained
    assert any(n.startswith("backbone.") for n in trained)
    assert all(n in trained for n, _ in model.named_parameters() if n.startswith("pooling."))
    assert ("+Crica" in name) == any(n.startswith("cross_image.") for n in trained)


def test_every_name_the_method_wants_exists() -> None:
    crica = ["FrozenDINOv2-GeM", "FrozenDINOv2-SPM", "AdaptGeM", "AdaptSPMG", "AdaptSPM"]
    adaptation = [
        "FrozenDINOv2",
        "FullTunedDINOv2",
        "VanillaAdapter",
        "ConvAdapter",
        "MulConvAdapter",
        "1x1",
        "3x3",
        "5x5",
    ]
    assert set(crica) | {f"{n}+Crica" for n in crica} | set(adaptation) <= set(PAPER)
    assert {"NetVLAD", "CosPlace", "MixVPR", "GeM", "SALAD", "BoQ", "ResNet50-GeM"} <= set(BASELINES)


def test_salad_refuses_more_clusters_than_patches() -> None:
    with pytest.raises(UsageError, match=r"clusters 64.*49 patches"):
        build_pooling(PoolingConfig(kind="salad"), 32, (7, 7))
    with pytest.raises(UsageError, match=r"boq\.channels 100"):
        build_pooling(PoolingConfig(kind="boq", boq=BoQConfig(channels=100)), 32, (7, 7))
