"""The loss against reference numbers, an independent library, and itself on real processes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from processes import run_ranks
from releases_restated import multi_similarity
from torch.nn import functional as F

from pipeline.data.positions import points
from pipeline.distributed import rank_slice, world_size
from pipeline.training.checkpoint import RunState
from pipeline.training.loss import MultiSimilarityLoss
from pipeline.training.records.meter import Meter
from pipeline.training.trainer import mined_metrics


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


def test_a_person_sees_the_mined_anchors_of_both_kinds_of_description(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []
    monkeypatch.setattr("pipeline.common.progress.Progress.advance", lambda self, n, text: shown.append(text))
    meter = Meter(16, 2, RunState(index=""), enabled=False)
    meter.record(0.5, (1.0, 0.5), 12.0)
    meter.record(0.5, (0.5, 0.5), 12.0)
    assert "mined 100% and alone 50%, 12.0 negatives each" in shown[0] and "mined 75% and alone 50%" in shown[1]
    assert mined_metrics(meter.report().mined) == {
        "train/mined_anchors": 62.5, "train/mined_anchors_group": 75.0, "train/mined_anchors_alone": 50.0
    }  # fmt: skip
    assert mined_metrics((80.0,)) == {"train/mined_anchors": 80.0}


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="need \\[p\\*b, dim\\]"):
        MultiSimilarityLoss()(torch.randn(4, 8), torch.zeros(5, dtype=torch.long))


def prefix_loss(labels: torch.Tensor, x: torch.Tensor, prefixes: tuple[int, ...]) -> tuple[Any, ...]:
    """This rank's part of a global batch: loss, gradient of the mean summed over ranks, and what was mined."""
    mine = rank_slice(len(labels))
    own = x[mine].clone().requires_grad_()
    function = MultiSimilarityLoss(prefixes=prefixes)
    loss = function(own, labels[mine])
    loss.backward()
    assert own.grad is not None
    return loss.item(), own.grad / world_size(), function.statistics()


def test_the_losses_of_prefixes_are_added_whatever_the_number_of_ranks() -> None:
    """Against whole losses of cut descriptors; float64."""
    generator = torch.Generator().manual_seed(3)
    labels = torch.arange(6).repeat_interleave(4)
    x = (torch.randn(6, 1, 12, generator=generator) + torch.randn(6, 4, 12, generator=generator)).reshape(24, 12)
    x = x.double()
    whole = x.clone().requires_grad_()
    parts = [MultiSimilarityLoss()(whole[:, :dims], labels) for dims in (12, 7, 3)]
    sum(parts).backward()  # type: ignore[union-attr]
    assert whole.grad is not None and len({round(p.item(), 6) for p in parts}) == 3
    mined = prefix_loss(labels, x, ())[2]
    for world in (1, 2):
        ranks = run_ranks(prefix_loss, world, labels, x, (7, 3))
        assert [r[0] for r in ranks] == pytest.approx([sum(p.item() for p in parts)] * world, rel=1e-12)
        torch.testing.assert_close(torch.cat([r[1] for r in ranks]), whole.grad, rtol=1e-10, atol=1e-14)
        assert all(r[2] == mined for r in ranks)  # of the whole descriptors
    with pytest.raises(ValueError, match="prefixes"):
        MultiSimilarityLoss(prefixes=(13,))(x, labels)


def near_loss(labels: torch.Tensor, x: torch.Tensor, points: torch.Tensor, within: float) -> tuple[float, torch.Tensor]:
    """This rank's part of a global batch: the loss and the whole gradient of the mean, summed over ranks."""
    mine = rank_slice(len(labels))
    own = x[mine].clone().requires_grad_()
    loss = MultiSimilarityLoss(ignore_within=within, points=points)(own, labels[mine])
    loss.backward()
    assert own.grad is not None
    return loss.item(), own.grad / world_size()


def test_pairs_of_near_places_are_ignored_whatever_the_number_of_ranks() -> None:
    """Against the definition, written out pair by pair with the great-circle formula; float64."""
    generator = torch.Generator().manual_seed(3)
    labels = torch.tensor([7, 2, 5, 3, 8, 4]).repeat_interleave(4)
    # places 20 m apart in a row across the 180th meridian, at 60 degrees north; place 5 is unknown
    step = 20 / (111_194.93 * 0.5)
    degrees = np.array([[60.0, (180 + step * (i - 4.5) + 180) % 360 - 180] for i in range(10)])
    degrees[5] = np.nan
    table = torch.from_numpy(points(degrees))
    x = (torch.randn(6, 1, 12, generator=generator) + torch.randn(6, 4, 12, generator=generator)).reshape(24, 12)
    x = x.double()

    def metres(a: int, b: int) -> float:
        (lat, lon), (lat2, lon2) = np.radians(degrees[a]), np.radians(degrees[b])
        h = np.sin((lat2 - lat) / 2) ** 2 + np.cos(lat) * np.cos(lat2) * np.sin((lon2 - lon) / 2) ** 2
        return float(2 * 6_371_008.8 * np.arcsin(np.sqrt(h)))

    losses = {within: near_loss(labels, x, table, within) for within in (0.0, 30.0, 45.0)}
    assert len({round(value, 9) for value, _ in losses.values()}) == 3  # each distance really changes the pairs
    for within, (value, gradient) in losses.items():
        defined = multi_similarity(x, labels.tolist(), lambda a, b, within=within: metres(a, b) < within)  # type: ignore[misc]
        assert value == pytest.approx(float(defined), rel=1e-12)
        ranks = run_ranks(near_loss, 2, labels, x, table, within)
        assert [r[0] for r in ranks] == pytest.approx([value] * 2, rel=1e-12)
        torch.testing.assert_close(torch.cat([r[1] for r in ranks]), gradient, rtol=1e-10, atol=1e-14)
