"""Re-ranking: the geometry against its definition, then pictures whose order only the arrangement can tell."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pipeline.config import EvaluationConfig
from pipeline.evaluation.evaluate import evaluate
from pipeline.evaluation.evaluation_set import EvaluationSet
from pipeline.evaluation.rerank import inliers, mutual_matches
from shards.errors import UsageError


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
    found = inliers(left, right, (3, 4))
    assert found == inliers(left, right, (3, 4))
    assert kept <= found <= kept + 6 if kept else found < 12
    assert [inliers(left[:n], right[:n]) for n in (0, 1)] == [0, 1]


class Colours(torch.nn.Module):
    """Patches are mean colours; the descriptor, their mean over the image, knows nothing of the arrangement."""

    image_size, regions, descriptor_dim = 64, 1, 3

    class Backbone(torch.nn.Module):
        grid, dim = 8, 3

        def forward(self, images: torch.Tensor) -> torch.Tensor:
            patches = torch.nn.functional.avg_pool2d(images, 8).flatten(2).transpose(1, 2)
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
    assert before.protocol.name == "single" and after.protocol.name == "single_rerank4"
    assert "first 4 re-ranked" in after.protocol.describe() and "re-ranked" not in before.protocol.describe()
    four = evaluate(Colours(), [scrambled], dataclasses.replace(config, rerank=0, recalls=(4,)), "cpu", progress=False)
    assert (np.sort(after.predictions[:, :4]) == np.sort(four[0].predictions)).all()  # the same four, in another order


def test_too_coarse_a_grid_is_refused(scrambled: EvaluationSet) -> None:
    model = Colours()
    model.backbone.grid = 3
    with pytest.raises(UsageError, match="3 x 3 patches"):
        evaluate(model, [scrambled], EvaluationConfig(groups=("single",), workers=0, rerank=2), "cpu", progress=False)
