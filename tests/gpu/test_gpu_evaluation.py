"""Evaluation on a GPU against the CPU: descriptors, PCA, search, and the workers that a validation reads with.

Run by `make test-gpu`. Skipped where the packages that evaluation needs are missing.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from gpu_steps import TINY

from pipeline.benchmark.sizes import build
from pipeline.config import EvaluationConfig

for package in ("faiss", "PIL", "pyarrow", "scipy", "simplejpeg"):
    pytest.importorskip(package)


def photos(folder: Path, count: int) -> list[Path]:
    from PIL import Image

    folder.mkdir()
    paths = [folder / f"{i:02d}.png" for i in range(count)]
    for i, path in enumerate(paths):
        field = np.random.default_rng(i // 2).integers(0, 256, (4, 4, 3))  # two photos of each place
        noise = np.random.default_rng([i]).integers(-9, 10, (4, 4, 3))
        Image.fromarray((field + noise).clip(0, 255).astype(np.uint8)).resize((64, 64)).save(path)
    return paths


@pytest.mark.parametrize("pca", [None, pytest.param(8, marks=pytest.mark.gpu)])
def test_predictions_are_those_of_the_cpu(device: torch.device, tmp_path: Path, pca: int | None) -> None:
    from pipeline.evaluation.evaluate import evaluate
    from pipeline.evaluation.sets.evaluation_set import EvaluationSet

    files = photos(tmp_path / "photos", 24)
    positives = [np.array([i]) for i in range(12)]
    evaluated = EvaluationSet("fields", files[::2], files[1::2], positives, "pairs")
    # on the CPU other tests start workers; here they would only cost
    config = EvaluationConfig(
        groups=("single", "ordered"), group_size=4, batch=5, workers=2 if device.type == "cuda" else 0,
        recalls=(1, 5), pca=pca,
    )  # fmt: skip
    model = build(TINY)
    truth = evaluate(model, [evaluated], config, "cpu", progress=False)
    found = evaluate(model.to(device), [evaluated], config, device, progress=False)
    for one, two in zip(truth, found, strict=True):
        assert one.recalls == two.recalls and one.recalls[5] > 50
        assert (one.predictions[:, 0] == two.predictions[:, 0]).all()
        assert np.allclose(one.distances, two.distances, atol=1e-4)


def test_batches_are_pinned_where_there_is_a_gpu() -> None:
    from pipeline.data.workers import options

    assert options(0, 1)["pin_memory"] == options(1, 1)["pin_memory"] == torch.cuda.is_available()


def test_pca_is_that_of_the_cpu(device: torch.device) -> None:
    from pipeline.evaluation.search.exact import slices
    from pipeline.evaluation.search.projection import fit_rows

    rows = np.random.default_rng(0).normal(size=(200, 24)) * np.linspace(3, 1, 24)
    truth, found = (fit_rows(lambda: slices(rows), np.arange(200), 6, device=where) for where in ("cpu", device))
    assert torch.allclose(truth.components, found.components, atol=1e-5)
    assert torch.allclose(truth.variances, found.variances, rtol=1e-5)


def test_batches_copied_beside_a_step_are_the_loaders(device: torch.device) -> None:
    """Two buffers for six batches, each fetched before the step of the one before it."""
    from pipeline.data.images import normalise
    from pipeline.data.places import Batch
    from pipeline.training.ahead import OnDevice

    def batch(number: int) -> Batch:
        images = torch.full((4, 3, 64, 64), 40 * number, dtype=torch.uint8)
        labels = torch.full((4,), number)
        return Batch(*(t.pin_memory() if device.type == "cuda" else t for t in (images, labels)), [str(number)])

    batches = OnDevice(map(batch, range(6)), device)
    coming, found = batches.fetch(), []
    while coming is not None:
        now, coming = coming(), batches.fetch()
        torch.ones(512, 512, device=device) @ torch.ones(512, 512, device=device)  # a step
        found.append(now)
    for number, ready in enumerate(found):
        assert torch.allclose(ready.images.cpu(), normalise(batch(number).images), atol=1e-6)
        assert ready.labels.tolist() == [number] * 4 and ready.keys == [str(number)] and ready.copy_wait() >= 0.0
    assert len(found) == 6
