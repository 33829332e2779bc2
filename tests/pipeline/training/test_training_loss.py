"""The loss against reference numbers, an independent library, and itself on real processes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from pipeline.training.loss import MultiSimilarityLoss


@pytest.mark.parametrize("case", ["C_72x4x128_hard", "E_4x4x32_hard"])
def test_reference_loss_gradient_and_mining(shared_dir: Path, case: str) -> None:
    truth = np.load(shared_dir / "reference" / "ms_loss.npz")
    x = torch.tensor(truth[f"{case}_x"], dtype=torch.float64, requires_grad=True)
    labels = torch.tensor(truth[f"{case}_labels"])
    loss_function = MultiSimilarityLoss()
    loss = loss_function(x, labels)
    loss.backward()
    assert abs(loss.item() - float(truth[f"{case}_loss_f64"])) < 1e-12
    assert x.grad is not None
    np.testing.assert_allclose(x.grad.numpy(), truth[f"{case}_grad_f64"], atol=1e-14)
    same = labels[:, None] == labels[None]
    others = ~torch.eye(len(labels), dtype=torch.bool)
    similarity = F.normalize(x.detach(), dim=1) @ F.normalize(x.detach(), dim=1).T
    positive, negative = loss_function.mine(similarity, same & others, ~same)
    assert np.array_equal(positive.numpy(), truth[f"{case}_posmask"])
    assert np.array_equal(negative.numpy(), truth[f"{case}_negmask"])
    mined = truth[f"{case}_posmask"].any(1) | truth[f"{case}_negmask"].any(1)
    assert loss_function.statistics().anchors == pytest.approx(mined.mean())


def test_reference_case_with_a_single_mined_pair(shared_dir: Path) -> None:
    """The library returns 0 when every array holds at most one mined index; the formula gives 0.05087."""
    truth = np.load(shared_dir / "reference" / "ms_loss.npz")
    loss = MultiSimilarityLoss()(torch.tensor(truth["A_4x4x32_x"]), torch.tensor(truth["A_4x4x32_labels"]))
    assert loss.item() == pytest.approx(0.05087, abs=5e-6)
    assert float(truth["A_4x4x32_loss_f64"]) == 0.0


@pytest.mark.parametrize(("alpha", "beta", "base", "margin"), [(1, 50, 0, 0.1), (2, 40, 0.5, 0.2)])
def test_agrees_with_pytorch_metric_learning(alpha: float, beta: float, base: float, margin: float) -> None:
    losses = pytest.importorskip("pytorch_metric_learning.losses")
    miners = pytest.importorskip("pytorch_metric_learning.miners")
    torch.manual_seed(0)
    labels = torch.arange(12).repeat_interleave(4)
    x = (torch.randn(12, 1, 16).repeat(1, 4, 1) + 0.9 * torch.randn(12, 4, 16)).reshape(48, 16).double()
    ours, theirs = x.clone().requires_grad_(), x.clone().requires_grad_()
    loss = MultiSimilarityLoss(alpha, beta, base, margin)(ours, labels)
    expected = losses.MultiSimilarityLoss(alpha=alpha, beta=beta, base=base)(
        theirs, labels, miners.MultiSimilarityMiner(epsilon=margin)(theirs, labels)
    )
    loss.backward()
    expected.backward()
    assert loss.item() == pytest.approx(expected.item(), rel=1e-12)
    torch.testing.assert_close(ours.grad, theirs.grad, rtol=1e-9, atol=1e-13)


def test_no_mined_pair_gives_zero_with_a_zero_gradient() -> None:
    x = torch.eye(8, dtype=torch.float64).repeat_interleave(4, dim=0).requires_grad_()
    loss = MultiSimilarityLoss()(x, torch.arange(8).repeat_interleave(4))
    loss.backward()
    assert loss.item() == 0.0
    assert x.grad is not None
    assert torch.equal(x.grad, torch.zeros_like(x))


def test_a_batch_of_one_place_has_no_negatives_and_no_loss() -> None:
    x = torch.randn(4, 8, requires_grad=True)
    loss = MultiSimilarityLoss()(x, torch.zeros(4, dtype=torch.long))
    loss.backward()
    assert loss.item() == 0.0
    assert x.grad is not None
    assert x.grad.abs().max() == 0.0


def test_bfloat16_descriptors_are_compared_in_float32() -> None:
    torch.manual_seed(1)
    x = F.normalize(torch.randn(32, 64), dim=1).bfloat16()
    labels = torch.arange(8).repeat_interleave(4)
    assert MultiSimilarityLoss()(x, labels).dtype == torch.float32
    torch.testing.assert_close(MultiSimilarityLoss()(x, labels), MultiSimilarityLoss()(x.float(), labels))


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="need \\[b, dim\\]"):
        MultiSimilarityLoss()(torch.randn(4, 8), torch.zeros(5, dtype=torch.long))
