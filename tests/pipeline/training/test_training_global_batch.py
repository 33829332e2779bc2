"""The reason for this project: the same descriptors, loss, gradients, buffers and weights on 1, 2 and 4 processes.

Real gloo processes, different images on each rank, float64, dropout 0; the truth is one process with the whole batch.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from processes import run_ranks
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from pipeline.config import AdapterConfig, BackboneConfig, CrossImageConfig, ModelConfig
from pipeline.distributed import rank, rank_slice, world_size
from pipeline.model.vpr import build_model
from pipeline.training.loss import MultiSimilarityLoss

SMALL = ModelConfig(
    backbone=BackboneConfig(name="custom", dim=32, depth=2, heads=2, patch=14, pretrain_grid=4),
    adapter=AdapterConfig(reduced=4),
    cross_image=CrossImageConfig(layers=2, heads=4, feedforward=48, dropout=0.0),
    trainable="full",
)
PLACES, VIEWS, SIZE, STEPS = 8, 4, 56, 3


def batches() -> list[Tensor]:
    """Three global batches of noisy places: [32, 3, 56, 56] each, so that mining finds pairs."""
    generator = torch.Generator().manual_seed(5)
    places = torch.randn(PLACES, 1, 3, SIZE, SIZE, generator=generator, dtype=torch.float64)
    noise = torch.randn(STEPS, PLACES, VIEWS, 3, SIZE, SIZE, generator=generator, dtype=torch.float64)
    return [(0.3 * places + n).reshape(PLACES * VIEWS, 3, SIZE, SIZE) for n in noise]


def steps(config: ModelConfig, chunk: int | None = None, joint: bool = False) -> dict[str, Any]:
    """Three SGD steps on this rank's slices; what they computed, whole."""
    torch.manual_seed(3)
    model = build_model(config, SIZE).double()
    for block in model.backbone.blocks:  # adapters start at a zero output; give them one, so that every part matters
        if hasattr(block.mlp, "adapter"):
            for parameter in block.mlp.adapter.parameters():
                torch.nn.init.normal_(parameter, std=0.1)
    model.train()
    module: Any = model
    if world_size() > 1:
        module = DistributedDataParallel(model, broadcast_buffers=False)
    optimizer = torch.optim.SGD([p for p in model.parameters() if p.requires_grad], lr=0.5)
    loss_function = MultiSimilarityLoss()
    labels = torch.arange(PLACES).repeat_interleave(VIEWS)
    losses, descriptors, gradients, mined = [], [], {}, []
    for number, images in enumerate(batches()):
        mine = rank_slice(len(images))
        out = module(images[mine], chunk=chunk, joint=joint)
        loss = loss_function(out, labels[mine])
        optimizer.zero_grad()
        loss.backward()
        losses.append(loss.item())
        descriptors.append(out.detach())
        mined.append(loss_function.statistics())
        if number == 0:
            gradients = {n: p.grad.clone() for n, p in model.named_parameters() if p.requires_grad}
        optimizer.step()
    return {
        "losses": losses, "descriptors": descriptors, "gradients": gradients, "mined": mined, "rank": rank(),
        "weights": {n: p.detach().clone() for n, p in model.named_parameters()},
        "buffers": {n: b.clone() for n, b in model.named_buffers()},
    }  # fmt: skip


def worst(truth: dict[str, Tensor], found: dict[str, Tensor]) -> float:
    """Largest difference over the tensors, relative to the largest value of all of them."""
    assert truth.keys() == found.keys()
    scale = max(t.abs().max().item() for t in truth.values() if t.is_floating_point())
    return max((truth[n] - found[n]).abs().max().item() for n in truth if truth[n].is_floating_point()) / scale


VARIANTS = {
    "published": SMALL,
    "adapters_only": replace(SMALL, trainable="adapters"),
    "group_norm": replace(SMALL, adapter=replace(SMALL.adapter, norm="group")),
    "no_encoder": replace(SMALL, cross_image=replace(SMALL.cross_image, layers=0)),
    "joint": SMALL,
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_nothing_depends_on_the_number_of_processes(variant: str) -> None:
    config, joint = VARIANTS[variant], variant == "joint"
    truth = steps(config, None, joint)
    assert len(truth["mined"][0].by_pass) == 1 + joint
    assert min(truth["mined"][0].by_pass) > 0.5, "too few mined pairs: this test would prove little"
    assert all(g.abs().max() > 0 for n, g in truth["gradients"].items() if not n.endswith("conv.bias"))
    for world in (2, 4):
        ranks = run_ranks(steps, world, config, None, joint)
        for number in range(STEPS):
            # of joint training each rank holds its images in the global batch, then alone
            parts = [r["descriptors"][number].chunk(1 + joint) for r in ranks]
            together = torch.cat([part for kind in zip(*parts, strict=True) for part in kind])
            torch.testing.assert_close(together, truth["descriptors"][number], rtol=1e-9, atol=1e-11)
        for found in ranks:
            assert found["losses"] == pytest.approx(truth["losses"], rel=1e-9)
            assert found["mined"] == truth["mined"]
            for what in ("gradients", "weights", "buffers"):
                assert worst(truth[what], found[what]) < 1e-9, (what, world, found["rank"])
        # data-parallel replicas must stay the same to the bit, or they drift apart
        assert all(torch.equal(ranks[0]["weights"][n], r["weights"][n]) for r in ranks for n in r["weights"])


def test_gradients_tensor_by_tensor() -> None:
    """Relative to each tensor's own size: a lost factor in one small tensor cannot hide behind a large one."""
    truth = steps(SMALL)["gradients"]
    found = run_ranks(steps, 2, SMALL)[0]["gradients"]
    for name, gradient in truth.items():
        # a bias in front of a BatchNorm, or on attention keys (softmax ignores it): the true gradient is zero
        if name.endswith(("conv.bias", "k_proj.bias")):
            assert max(gradient.abs().max(), found[name].abs().max()) < 1e-12
            continue
        difference = (gradient - found[name]).norm() / gradient.norm()
        assert difference < 1e-9, (name, float(difference))


def test_joint_training_is_one_loss_over_two_passes_of_the_encoder() -> None:
    """Written out: the images in one group, each image by itself, and a loss over all of them under doubled labels."""
    torch.manual_seed(3)
    model = build_model(SMALL, SIZE).double()
    images, labels = batches()[0], torch.arange(PLACES).repeat_interleave(VIEWS)
    found = []
    for joint in (True, False):
        model.zero_grad()
        if joint:
            loss = (ours := MultiSimilarityLoss())(model(images, joint=True), labels)
        else:
            regions = model.encode(images)
            alone = [model.correlate(one[None]) for one in regions]
            twice = torch.cat([model.correlate(regions), *alone])
            loss = (plain := MultiSimilarityLoss())(twice, labels.repeat(2))
        loss.backward()
        found.append({n: p.grad.clone() for n, p in model.named_parameters() if p.grad is not None})
        found[-1]["loss"] = loss.detach()
    assert worst(*found) < 1e-12
    assert ours.statistics().anchors == plain.statistics().anchors == sum(ours.statistics().by_pass) / 2
    assert ours.statistics().positives == plain.statistics().positives > VIEWS - 1  # across both kinds of description


@pytest.mark.parametrize("variant", ["published", "adapters_only", "group_norm", "joint"])
@pytest.mark.parametrize("world", [1, 2])
def test_chunks_give_the_same_gradients(world: int, variant: str) -> None:
    """Also with BatchNorm, whose statistics and buffers stay those of the global batch."""
    config, joint = VARIANTS[variant], variant == "joint"
    whole = steps(config, None, joint)
    found = steps(config, 5, joint) if world == 1 else run_ranks(steps, world, config, 5, joint)[1]
    for what in ("gradients", "weights", "buffers"):
        assert worst(whole[what], found[what]) < 1e-9
    assert found["losses"] == pytest.approx(whole["losses"], rel=1e-9)


def test_a_lost_sum_in_the_gather_would_be_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """The comparison has teeth: without the backward of the gather the gradients are wrong."""
    truth = steps(SMALL)["gradients"]

    def broken(*arguments: Any) -> Any:
        from pipeline.distributed import _Gather

        _Gather.backward = staticmethod(  # type: ignore[assignment, method-assign]
            lambda ctx, grad: grad[rank_slice(len(grad))].contiguous()
        )
        return steps(*arguments)

    found = run_ranks(broken, 2, SMALL)[0]["gradients"]
    assert worst(truth, found) > 1e-2
