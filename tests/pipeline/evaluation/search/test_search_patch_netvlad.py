"""Patch-NetVLAD as a second stage: against its public code restated, and inside an evaluation."""

from __future__ import annotations

import copy
import dataclasses
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from releases_restated import filled, vgg, vgg_shapes, vlad_shapes
from second_stages_restated import patch_order, patch_scores, patch_vlads
from tiny_matchers import netvlad
from tiny_scenes import turned, views

from pipeline.common.errors import UsageError
from pipeline.config import EvaluationConfig, PoolingConfig
from pipeline.evaluation.evaluate import evaluate
from pipeline.evaluation.search.rerank import build_reranker
from pipeline.evaluation.search.rerank.matches import homography_inliers, rapid_score
from pipeline.model.vpr import PlaceModel, build_model
from pipeline.model.weights.released import from_release

CLUSTERS, DIM, SIDE = 3, 24, 12
METHODS = ("patch-netvlad", "patch-netvlad-rss")


class Colours(torch.nn.Module):
    """In place of VGG-16, which takes seconds: 512 fixed mixtures of the colours of each 16 x 16 pixels and around."""

    stride = 16

    def grid_of(self, height: int, width: int) -> tuple[int, int]:
        return height // 16, width // 16

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        around = [torch.nn.functional.avg_pool2d(images, k, 16, (k - 16) // 2) for k in (16, 32)]
        colours = torch.cat(around, 1).flatten(2).transpose(1, 2)
        tokens = (colours @ torch.randn(6, 512, generator=torch.Generator().manual_seed(1)).to(colours)).relu()
        return torch.cat((tokens.mean(1, keepdim=True), tokens), 1)


@pytest.fixture(scope="module")
def released() -> tuple[dict[str, torch.Tensor], PlaceModel]:
    """A release's tensors, and our model of them."""
    shapes = vgg_shapes("encoder.") | vlad_shapes("pool.", CLUSTERS, 512)
    state = filled(shapes | {"WPCA.0.weight": (DIM, CLUSTERS * 512, 1, 1), "WPCA.0.bias": (DIM,)})
    return state, from_release(state, "release", image_size=16 * SIDE)


def test_patches_are_the_restated_ones(released: tuple[dict[str, torch.Tensor], PlaceModel]) -> None:
    """Through both networks; the sums over patches in float64."""
    state, model = released
    image = views(0, 1, SIDE)[..., :144, :144]
    with torch.no_grad():
        theirs = vgg(state, "encoder.", image, 28)
        tokens = model.backbone(image)
        torch.testing.assert_close(tokens[:, 1:], theirs.flatten(2).transpose(1, 2), rtol=1e-3, atol=1e-4)
        wanted = patch_vlads({name: tensor.double() for name, tensor in state.items()}, theirs.double())
        found = copy.deepcopy(model.pooling).double().of_patches(tokens.double(), (9, 9), (2, 5, 8))
    for ours, restated in zip(found, wanted, strict=True):
        torch.testing.assert_close(ours, restated, rtol=1e-4, atol=1e-6)
        assert ours.std(dim=1).max() > 1e-3  # patches differ


@pytest.mark.parametrize("method", METHODS)
def test_the_same_patches_get_the_restated_scores_and_order(
    released: tuple[dict[str, torch.Tensor], PlaceModel], method: str
) -> None:
    model = copy.deepcopy(released[1])
    model.backbone = Colours()
    images = torch.cat((views(0, 3, SIDE), views(1, 1, SIDE)))
    with torch.no_grad():  # whitening takes the mean off
        whitening, model.pooling.projection = model.pooling.projection, None
        vlad = torch.cat(model.pooling.of_patches(model.backbone(images), (SIDE, SIDE), (2, 5, 8)), 1)
        whitening.bias.copy_(-whitening.weight @ vlad.mean((0, 1)))
        model.pooling.projection = whitening
    stage = build_reranker(model, EvaluationConfig(rerank=3, rerank_by=method), "cpu")
    described = [stage.describe(image) for image in images]
    assert [part.shape for part in described[0][:-1]] == [((SIDE - p + 1) ** 2, DIM) for p in (2, 5, 8)]
    scores = np.array([stage.compare(described[0], other, (0, 0)) for other in described[1:]])
    exact = [[part.double() for part in each[:-1]] for each in described]
    theirs = [patch_scores(exact[0], other, SIDE, method.endswith("rss")) for other in exact[1:]]
    np.testing.assert_allclose(scores, -np.array(theirs), rtol=1e-12)
    assert len(np.unique(scores)) > 5
    order = np.argsort(-stage.combine(scores), kind="stable").tolist()
    assert order == patch_order(theirs) and order[-1] == 2  # the other place comes last


def test_scores_of_geometry_by_hand() -> None:
    """A homography's matches among strays; rapid scoring of movements that are all the same, and of one stray."""
    rng = np.random.default_rng(0)
    left = rng.integers(0, 480, (40, 2))
    h = np.array([[1.1, 0.1, 5], [-0.05, 0.9, 8], [1e-4, 0, 1]])
    moved = np.c_[left, np.ones(40)] @ h.T
    right = moved[:, :2] / moved[:, 2:]
    right[30:] += 200
    assert homography_inliers(left, right, 3) == 30
    assert [homography_inliers(left[:n], right[:n], 3) for n in (0, 3, 4)] == [0, 0, 4]
    assert homography_inliers(left * 0, right, 3) == 0  # all in one point: no homography
    points = rng.integers(0, 9, (6, 2))
    assert rapid_score(points, points + 2, (8, 6)) == 6 * (64 + 36)
    assert rapid_score(points[:0], points[:0], (8, 6)) == 0
    # movements 0, 0, 3 in columns: their mean is 1
    moved = np.array([[1, 1], [2, 2], [6, 3]])
    assert rapid_score(moved, moved - [[0, 0], [0, 0], [3, 0]], (8, 6)) == 49 + 49 + 36 + 3 * 36


def test_a_size_that_scores_all_candidates_alike_tells_nothing() -> None:
    stage = build_reranker(netvlad(), EvaluationConfig(rerank=3, rerank_by="patch-netvlad-rss"), "cpu")
    np.testing.assert_allclose(stage.combine(np.array([[3.0, 7, 1], [1, 7, 2]])), [0.45 - 0.4, 0.4 - 0.45])


@pytest.mark.parametrize("method", METHODS)
def test_an_evaluation_puts_the_moved_view_first_and_says_how(tmp_path: Path, method: str) -> None:
    scenes = turned(tmp_path)
    ask = partial(EvaluationConfig, groups=("single",), recalls=(1,), workers=0, rerank=4)
    (result,) = evaluate(netvlad(), [scenes], ask(rerank_by=method), "cpu", progress=False)
    assert result.recalls[1] == 100
    assert result.protocol.name == f"single_96px_pairs_rerank4-{method}"
    assert "first 4 re-ranked by Patch-NetVLAD" in result.protocol.describe()
    # 11, 8 and 5 patches on a side, of 4 x 64 numbers in 4 bytes
    assert f"({(121 + 64 + 25) * 4 * 64 * 4 / 1e6:.2f} MB a photo)" in result.remarks[-1]


def test_what_cannot_be_matched_is_refused_before_anything_is_described(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenes = turned(tmp_path)
    config = EvaluationConfig(groups=("single",), recalls=(1,), workers=0, rerank=2, rerank_by="patch-netvlad")
    gem = build_model(dataclasses.replace(netvlad().config, pooling=PoolingConfig(kind="gem")), 96).eval()
    for model, asked, told in (
        (gem, config, "needs a model with NetVLAD"),
        (netvlad(48), config, "6 x 6 tokens"),
        (netvlad(), dataclasses.replace(config, rerank_layer=1), "leave rerank_layer out"),
    ):
        with pytest.raises(UsageError, match=told):
            evaluate(model, [scenes], asked, "cpu", progress=False)
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(UsageError, match=r"needs OpenCV: pip install .*\[rerank\]"):
        evaluate(netvlad(), [scenes], config, "cpu", progress=False)
    evaluate(netvlad(), [scenes], dataclasses.replace(config, rerank_by="patch-netvlad-rss"), "cpu", progress=False)
