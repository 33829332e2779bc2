"""`single` in one call for many images: equal to a call an image, on any number of processes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from processes import run_ranks
from street import model, street

from pipeline.config import (
    EvaluationConfig,
)
from pipeline.data.images import load_image, normalise, to_input
from pipeline.evaluation.describe import encode
from pipeline.evaluation.describe.encode import calls_of
from pipeline.evaluation.describe.sides import Engine
from pipeline.evaluation.evaluate import evaluating
from pipeline.evaluation.protocol import protocols
from pipeline.evaluation.sets.evaluation_set import EvaluationSet


@pytest.fixture
def photos(tmp_path: Path) -> EvaluationSet:
    return street(tmp_path)


def described(photos: EvaluationSet) -> np.ndarray:
    encode.ALONE = 4  # several calls, the last one short
    built, config = model(), EvaluationConfig(groups=("single",), workers=0, batch=5)
    protocol = protocols(config, 28, "pairs")[0]
    with evaluating(built):
        engine = Engine(built, config, torch.device("cpu"), None, False, "")
        blocks = engine.side(photos, "database", [protocol]).describe(protocol)
    if blocks is None:  # not rank 0
        return np.zeros(0)
    whole = np.zeros((23, built.descriptor_dim), np.float32)
    for rows, block in blocks():
        whole[rows] = block
    return whole


def test_equal_to_each_image_by_itself_on_any_number_of_processes(
    photos: EvaluationSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(encode, "ALONE", 4)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    together, built = described(photos), model().eval()
    torch.set_num_threads(threads)
    with torch.no_grad():
        images = normalise(torch.stack([to_input(load_image(p), 28) for p in photos.database]))
        by_itself = torch.cat([built(image[None]) for image in images]).numpy()
        grouped = built(images).numpy()
    np.testing.assert_allclose(together, by_itself, atol=1e-6)
    assert np.abs(grouped - by_itself).max() > 1e-3  # a group would have told otherwise
    for world in (1, 2, 3):
        assert (run_ranks(described, world, photos)[0] == together).all()


def test_only_groups_of_one_are_called_together() -> None:
    config = EvaluationConfig(groups=("single", "ordered"), group_size=2)
    single, pairs = protocols(config, 28, "")
    calls, alone = calls_of(single, 130, "database", model())
    assert alone and [len(c) for c in calls] == [64, 64, 2] and np.concatenate(calls).tolist() == list(range(130))
    for protocol, built, size in ((pairs, model(), 2), (single, object(), 1)):
        calls, alone = calls_of(protocol, 129, "database", built)
        assert not alone and [len(c) for c in calls] == [size] * (129 // size) + [1] * (129 % size)
