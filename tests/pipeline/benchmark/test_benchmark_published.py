"""The published step that ours is timed against computes what ours computes."""

from __future__ import annotations

import copy

import pytest
import torch

from pipeline.benchmark.published import Published, measure, multi_similarity
from pipeline.benchmark.sizes import SIZES, batch, build
from pipeline.model.weights.names import to_published
from pipeline.training.loss import MultiSimilarityLoss


@pytest.mark.parametrize("training", [True, False])
def test_the_restated_step_has_the_numbers_of_ours(training: bool) -> None:
    images, labels = batch(SIZES["tiny"], 8)
    model = build(SIZES["tiny"]).double().train(training)
    theirs = Published(copy.deepcopy(model)).double().train(training)
    theirs.load_state_dict(to_published(model.state_dict()))
    ours, other = model(images.double()), theirs(images.double())
    torch.testing.assert_close(other, ours, rtol=1e-9, atol=1e-11)
    loss = MultiSimilarityLoss()(ours, labels)
    torch.testing.assert_close(multi_similarity(other, labels), loss, rtol=1e-9, atol=1e-11)
    loss.backward()
    multi_similarity(other, labels).backward()
    gradients = to_published({n: p.grad for n, p in model.named_parameters() if p.grad is not None})
    found = {n: p.grad for n, p in theirs.named_parameters() if p.grad is not None}
    assert gradients.keys() == found.keys()
    scale = max(g.abs().max().item() for g in gradients.values())
    for name, gradient in gradients.items():
        torch.testing.assert_close(found[name], gradient, rtol=1e-8, atol=1e-9 * scale, msg=name)
    training_step, inference = measure(SIZES["tiny"], torch.device("cpu"), 1, 8)
    assert training_step.ratio("ours") > 0 and inference.ratio("ours") > 0
