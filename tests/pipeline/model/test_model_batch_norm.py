"""BatchNorm over real gloo processes against `nn.BatchNorm2d` on the whole batch in one."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from processes import run_ranks
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from pipeline.distributed import rank, world_size
from pipeline.model import batch_norm
from pipeline.model.batch_norm import GlobalBatchNorm2d

CHANNELS = 5


def problem() -> tuple[Tensor, Tensor]:
    """Input [6, C, 3, 4] whose means are far from 0 next to their spread, and the weights of a sum as the loss."""
    generator = torch.Generator().manual_seed(2)
    x = torch.randn(6, CHANNELS, 3, 4, generator=generator, dtype=torch.float64)
    offsets = torch.tensor([0.0, 50.0, -3.0, 1e3, 0.1], dtype=torch.float64)
    return x + offsets[:, None, None], torch.randn(x.shape, generator=generator, dtype=torch.float64)


def norm_of(kind: type[nn.BatchNorm2d]) -> nn.BatchNorm2d:
    norm = kind(CHANNELS, eps=1e-3, momentum=0.1).double()
    with torch.no_grad():
        norm.weight.copy_(torch.linspace(0.5, 1.5, CHANNELS))
        norm.bias.copy_(torch.linspace(-1, 1, CHANNELS))
    return norm


def step(norm: nn.BatchNorm2d, x: Tensor, towards: Tensor, recompute: bool = False) -> dict[str, Tensor]:
    x = x.clone().requires_grad_()
    for _ in range(2):  # twice, so that the buffers' momentum counts too
        x.grad = norm.weight.grad = norm.bias.grad = None
        y = checkpoint(norm, x, use_reentrant=False) if recompute else norm(x)
        (y * towards).sum().backward()
    grads = {"x": x.grad, "weight": norm.weight.grad, "bias": norm.bias.grad, "y": y.detach()}
    return {**{k: v for k, v in grads.items() if v is not None}, **{k: v.clone() for k, v in norm.named_buffers()}}


@pytest.mark.parametrize("recompute", [False, True])
def test_one_process_is_torch_batch_norm(recompute: bool) -> None:
    x, towards = problem()
    ours, theirs = norm_of(GlobalBatchNorm2d), norm_of(nn.BatchNorm2d)
    assert list(ours.state_dict()) == list(theirs.state_dict())
    truth = step(theirs, x, towards)
    for name, value in step(ours, x, towards, recompute).items():
        assert torch.equal(value, truth[name]), name
    assert torch.equal(ours.eval()(x), theirs.eval()(x))
    assert ours.num_batches_tracked == 2


def on_a_rank(sizes: list[int], recompute: bool) -> dict[str, Tensor]:
    x, towards = problem()
    assert len(sizes) == world_size()
    r = rank()
    return step(norm_of(GlobalBatchNorm2d), x.split(sizes)[r], towards.split(sizes)[r], recompute)


@pytest.mark.parametrize(
    ("sizes", "recompute"), [([3, 3], False), ([3, 3], True), ([2, 2, 2], False), ([1, 4, 1], False)]
)
def test_statistics_span_all_ranks(sizes: list[int], recompute: bool) -> None:
    """Output, gradients, buffers; also with unequal ranks, and recomputed inside backward (buffers move once)."""
    x, towards = problem()
    truth = step(norm_of(nn.BatchNorm2d), x, towards)
    ranks = run_ranks(on_a_rank, len(sizes), sizes, recompute)
    for name in ("y", "x"):
        together = torch.cat([r[name] for r in ranks])
        assert torch.allclose(together, truth[name], rtol=1e-10, atol=1e-12), name
    for name in ("weight", "bias"):  # each rank holds its own part; the wrapper averages them like all gradients
        together = torch.stack([r[name] for r in ranks]).sum(0)
        assert torch.allclose(together, truth[name], rtol=1e-10, atol=1e-12), name
    for name in ("running_mean", "running_var", "num_batches_tracked"):
        for r in ranks:
            assert torch.allclose(r[name], truth[name], rtol=1e-12, atol=1e-12), name
            assert torch.equal(r[name], ranks[0][name]), name


def torchs_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """What torch's CUDA kernels compute, by their formulas in torch.nn.SyncBatchNorm, for tensors on the CPU."""

    def column(values: Tensor) -> Tensor:
        return values.view(1, -1, 1, 1)

    def stats(x: Tensor, eps: float) -> tuple[Tensor, Tensor]:
        var, mean = torch.var_mean(x, (0, 2, 3), correction=0)
        return mean, (var + eps).rsqrt()

    def gather_stats(
        x: Tensor, means: Tensor, inverses: Tensor, mean: Tensor, var: Tensor, momentum: float, eps: float, n: Tensor
    ) -> tuple[Tensor, Tensor]:
        assert means.is_contiguous() and inverses.is_contiguous() and n.shape == (len(means),)
        whole = (n[:, None] * means).sum(0) / n.sum()
        square = (n[:, None] * (inverses**-2 - eps + (means - whole) ** 2)).sum(0)
        mean.lerp_(whole, momentum)
        var.lerp_(square / (n.sum() - 1), momentum)
        return whole, (square / n.sum() + eps).rsqrt()

    def elemt(x: Tensor, weight: Tensor, bias: Tensor, mean: Tensor, inverse: Tensor, eps: float) -> Tensor:
        return (x - column(mean)) * column(inverse * weight) + column(bias)

    def reduce(grad: Tensor, x: Tensor, mean: Tensor, inverse: Tensor, *_: Any) -> tuple[Tensor, ...]:
        assert grad.stride() == x.stride()
        total, product = grad.sum((0, 2, 3)), (grad * (x - column(mean))).sum((0, 2, 3))
        return total, product, product * inverse, total

    def backward(
        grad: Tensor,
        x: Tensor,
        mean: Tensor,
        inverse: Tensor,
        weight: Tensor,
        total: Tensor,
        product: Tensor,
        n: Tensor,
    ) -> Tensor:
        assert n.dtype == torch.int32
        inner = grad - column(total / n.sum()) - (x - column(mean)) * column(inverse**2 * product / n.sum())
        return inner * column(weight * inverse)

    for name, kernel in {
        "stats": stats, "gather_stats_with_counts": gather_stats, "elemt": elemt,
        "backward_reduce": reduce, "backward_elemt": backward,
    }.items():  # fmt: skip
        monkeypatch.setattr(torch, f"batch_norm_{name}", kernel)
    monkeypatch.setattr(batch_norm, "_on_gpu", lambda x: True)


@pytest.mark.parametrize("sizes", [[3, 3], [1, 4, 1]])
def test_the_way_of_a_gpu_gives_the_same(sizes: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """How torch's kernels are put together, without a GPU; that they are what is written here, tests/gpu shows."""
    torchs_kernels(monkeypatch)
    test_statistics_span_all_ranks(sizes, False)


def in_half_precision() -> tuple[Tensor, Tensor]:
    x, _ = problem()
    norm = norm_of(GlobalBatchNorm2d).float()
    own = x.float().bfloat16().chunk(world_size())[rank()].requires_grad_()
    y = norm(own)
    y.sum().backward()
    assert y.dtype == torch.bfloat16 and own.grad is not None and own.grad.dtype == torch.bfloat16
    return y.detach(), norm.running_var.clone()  # type: ignore[union-attr]


def test_half_precision_keeps_float32_statistics() -> None:
    """A mean of 1000 has steps of 4 in bfloat16: statistics in that precision would be far off."""
    x, _ = problem()
    rounded = x.float().bfloat16().double()
    theirs = norm_of(nn.BatchNorm2d)
    truth = theirs(rounded)
    for results in ([in_half_precision()], run_ranks(in_half_precision, 2)):
        y = torch.cat([y for y, _ in results])
        assert torch.allclose(y.double(), truth, rtol=1e-2, atol=1e-2)
        assert torch.allclose(results[0][1].double(), theirs.running_var, rtol=1e-4)  # type: ignore[arg-type]
