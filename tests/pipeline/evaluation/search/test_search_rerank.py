"""Re-ranking: the geometry against its definition, then pictures whose order only the arrangement can tell."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from processes import run_ranks

from pipeline.common.errors import DataError, UsageError
from pipeline.config import EvaluationConfig, ModelConfig, RunConfig
from pipeline.config.baselines import ResNetConfig
from pipeline.config.model import AdapterConfig, BackboneConfig, CrossImageConfig
from pipeline.evaluation.evaluate import evaluate
from pipeline.evaluation.search.rerank import build_reranker
from pipeline.evaluation.search.rerank.matches import mutual_matches, similarity_inliers
from pipeline.evaluation.search.rerank.second_stage import Described, rerank
from pipeline.evaluation.sets.evaluation_set import EvaluationSet
from pipeline.model.vpr import PlaceModel, build_model
from pipeline.training.validation import Validation


def test_matches_are_mutual_and_nearest() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(9, 5)), rng.normal(size=(7, 5))
    a, b = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (a, b))
    nearest, back = (a @ b.T).argmax(1), (a @ b.T).argmax(0)
    wanted = [(i, j) for i, j in enumerate(nearest) if back[j] == i]
    left, right = mutual_matches(torch.from_numpy(a), torch.from_numpy(b))
    assert list(zip(left.tolist(), right.tolist(), strict=True)) == wanted and len(wanted) >= 3


@pytest.mark.parametrize(("scale", "turn", "kept"), [(1.0, 0.0, 30), (1.3, 0.2, 30), (0.7, -0.3, 30), (1.0, 2.0, 0)])
def test_inliers_are_the_matches_of_one_transform(scale: float, turn: float, kept: int) -> None:
    """30 matches moved together among 20 strays: found, whatever the transform, unless the camera lies on its side."""
    rng = np.random.default_rng(1)
    left = rng.permutation(400)[:50]
    left = left % 20 + 1j * (left // 20)
    right = scale * np.exp(1j * turn) * left + (2 - 3j)
    right[30:] = rng.uniform(0, 20, 20) + 1j * rng.uniform(0, 20, 20)
    found = similarity_inliers(left, right, (3, 4))
    assert found == similarity_inliers(left, right, (3, 4))
    assert kept <= found <= kept + 6 if kept else found < 12
    assert [similarity_inliers(left[:n], right[:n]) for n in (0, 1)] == [0, 1]


class Colours(torch.nn.Module):
    """Patches are mean colours; the descriptor, their mean over the image, knows nothing of the arrangement."""

    image_size, regions, descriptor_dim = 64, 1, 3

    class Backbone(torch.nn.Module):
        patch = 8

        def grid_of(self, height: int, width: int, layer: int | None = None) -> tuple[int, int]:
            return height // self.patch, width // self.patch

        def patches(self, images: torch.Tensor, layer: int | None = None) -> torch.Tensor:
            return torch.nn.functional.avg_pool2d(images, self.patch).flatten(2).transpose(1, 2)

        def forward(self, images: torch.Tensor) -> torch.Tensor:
            patches = self.patches(images)
            return torch.cat((patches.mean(1, keepdim=True), patches), dim=1)

    def __init__(self) -> None:
        super().__init__()
        self.backbone = self.Backbone()

    def encode(self, images: torch.Tensor) -> torch.Tensor:
        return self.backbone(images)[:, :1]

    def correlate(self, regions: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.normalize(regions.flatten(1), dim=-1)


@pytest.fixture
def scrambled(tmp_path: Path) -> EvaluationSet:
    """Four places; of each the database holds it shifted by a patch, under a worse name than its scrambled twin."""
    rng = np.random.default_rng(5)
    database, queries, positives = [], [], []

    def save(cells: np.ndarray, name: str) -> Path:
        pixels = cells.repeat(8, 0).repeat(8, 1).astype(np.uint8)
        Image.fromarray(pixels).save(tmp_path / name)
        return tmp_path / name

    for place in range(4):
        cells = rng.integers(0, 256, (8, 8, 3))
        twin = rng.permutation(cells.reshape(64, 3)).reshape(8, 8, 3)
        queries.append(save(cells, f"q{place}.png"))
        database += [save(twin, f"{place}-a.png"), save(np.roll(cells, 1, axis=1), f"{place}-b.png")]
        positives.append(np.array([2 * place + 1]))
    return EvaluationSet("scrambled", database, queries, positives, "pairs")


def test_only_the_arrangement_tells_the_twin(scrambled: EvaluationSet) -> None:
    config = EvaluationConfig(groups=("single",), recalls=(1, 2), workers=0, rerank=4)
    before = evaluate(Colours(), [scrambled], dataclasses.replace(config, rerank=0), "cpu", progress=False)[0]
    after = evaluate(Colours(), [scrambled], config, "cpu", progress=False)[0]
    assert before.recalls[1] < 60 and after.recalls[1] == 100
    assert before.protocol.name == "single_64px_pairs" and after.protocol.name == "single_64px_pairs_rerank4"
    assert "first 4 re-ranked" in after.protocol.describe() and "re-ranked" not in before.protocol.describe()
    four = evaluate(Colours(), [scrambled], dataclasses.replace(config, rerank=0, recalls=(4,)), "cpu", progress=False)
    assert (np.sort(after.predictions[:, :4]) == np.sort(four[0].predictions)).all()  # the same four, in another order


def test_too_coarse_a_grid_is_refused(scrambled: EvaluationSet) -> None:
    model = Colours()
    model.backbone.patch = 20
    with pytest.raises(UsageError, match="9 patches"):
        evaluate(model, [scrambled], EvaluationConfig(groups=("single",), workers=0, rerank=2), "cpu", progress=False)


def reranked(evaluated: EvaluationSet) -> tuple[np.ndarray, np.ndarray, str] | str:
    config = EvaluationConfig(groups=("single",), recalls=(1, 2), workers=0, rerank=4)
    try:
        (result,) = evaluate(Colours(), [evaluated], config, "cpu", progress=False)
    except DataError as error:
        return str(error)
    return result.predictions, result.distances, result.remarks[-1]


def test_the_queries_are_shared_by_the_processes(scrambled: EvaluationSet) -> None:
    """Three processes share four queries and all get the answer of one."""
    truth = reranked(scrambled)
    ranks = run_ranks(reranked, 3, scrambled)
    for rank in ranks:
        assert all((found == wanted).all() for found, wanted in zip(rank[:2], truth[:2], strict=True))
    # time and memory are told, for all processes together: 64 patches x 3 numbers x 2 bytes, of 1 + 4 photos
    assert len({rank[2] for rank in ranks}) == 1
    assert re.match(r"single\S+: re-ranking takes 0\.\d+ s a query .* 0\.0 MB for it .* \(0\.00 MB", truth[2])


def broken_after_the_search(evaluated: EvaluationSet) -> str:
    rows = np.tile(np.arange(8), (4, 1))
    try:
        stage = Described(build_reranker(Colours(), EvaluationConfig(rerank=4), "cpu"))
        rerank(stage, evaluated, rows, rows.astype(np.float32))
    except DataError as error:
        return str(error)
    return ""


def test_a_photo_that_breaks_between_the_stages_ends_all_processes_with_its_name(scrambled: EvaluationSet) -> None:
    scrambled.queries[0].write_bytes(b"nothing")
    assert all("q0.png" in rank for rank in run_ranks(broken_after_the_search, 2, scrambled))


def tiny_model(kind: str) -> PlaceModel:
    """A transformer of two blocks and 4 x 4 patches, or a residual network of two stages."""
    torch.manual_seed(0)
    none = CrossImageConfig(layers=0)
    if kind == "resnet":
        resnet = BackboneConfig(name="resnet_custom", resnet=ResNetConfig(stages=(1, 1), width=4, cut="layer2"))
        no_adapter = AdapterConfig(kind="none")
        return build_model(ModelConfig(resnet, adapter=no_adapter, cross_image=none, trainable="full"), 64).eval()
    custom = BackboneConfig(name="custom", dim=16, depth=2, heads=2, patch=7, pretrain_grid=4)
    return build_model(ModelConfig(custom, AdapterConfig(reduced=4), cross_image=none), 28).eval()


@pytest.mark.parametrize("kind", ["transformer", "resnet"])
def test_patches_of_an_earlier_layer_are_what_that_layer_gives(kind: str) -> None:
    """Against the layers called one by one; the last layer is what the model pools."""
    model = tiny_model(kind)
    backbone, images = model.backbone, torch.randn(2, 3, model.image_size, model.image_size)
    with torch.no_grad():
        assert torch.equal(backbone.patches(images), backbone(images)[:, 1:])
        if kind == "resnet":
            x = torch.relu(backbone.bn1(backbone.conv1(images)))
            x = backbone.layer1(torch.nn.functional.max_pool2d(x, 3, 2, padding=1))
            wanted = x.flatten(2).transpose(1, 2)
        else:
            wanted = backbone.vit.embeddings(images)
            for block in backbone.blocks[:1]:
                wanted = block(wanted)
            wanted = backbone.vit.layernorm(wanted)[:, 1:]
        torch.testing.assert_close(backbone.patches(images, 1), wanted)
        assert torch.allclose(backbone.patches(images, backbone.depth), backbone.patches(images))
    with pytest.raises(UsageError, match="1 to"):
        backbone.patches(images, backbone.depth + 1)


def test_a_layer_is_part_of_the_protocol_and_one_that_is_not_there_is_refused(scrambled: EvaluationSet) -> None:
    model = tiny_model("transformer")
    asked = EvaluationConfig(groups=("single",), recalls=(1,), workers=0, rerank=2, rerank_layer=1)
    (result,) = evaluate(model, [scrambled], asked, "cpu", progress=False)
    assert result.protocol.name == "single_28px_pairs_rerank2l1" and "in space, layer 1" in result.protocol.describe()
    with pytest.raises(UsageError, match="layer 9"):
        evaluate(model, [scrambled], dataclasses.replace(asked, rerank_layer=9), "cpu", progress=False)


def test_validation_takes_no_second_stage(scrambled: EvaluationSet) -> None:
    with pytest.raises(UsageError, match=r"re-rank in jobs\.evaluate"):
        Validation(RunConfig(validate=EvaluationConfig(rerank=2)), "cpu")
