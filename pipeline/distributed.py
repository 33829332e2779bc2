"""The global batch over processes: slices, gather with gradient, global sums. Identity at world size 1.

Invariant: with equal slices on every rank and a data-parallel wrapper that *averages* gradients (DDP, FSDP2, ZeRO),
a loss that is each rank's mean over its own images has exactly the gradient of the mean over the global batch.
The backward of `gather` is therefore a plain sum over ranks (reduce-scatter), with no extra factor.

Shapes: `B` images in the global batch, `b = B / W` on this rank, rank r holds rows [r*b, (r+1)*b).
"""

from __future__ import annotations

from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor


def is_distributed() -> bool:
    """Whether a process group of more than one rank runs."""
    return dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1


def world_size() -> int:
    """W, 1 without a process group."""
    return dist.get_world_size() if is_distributed() else 1


def rank() -> int:
    """This process's rank, 0 without a process group."""
    return dist.get_rank() if is_distributed() else 0


def rank_slice(total: int, r: int | None = None, w: int | None = None) -> slice:
    """The contiguous part of `total` items that rank r of w owns; parts differ by at most one item.

    For training `total` is a multiple of w (checked by the config), so all parts are equal.
    """
    r = rank() if r is None else r
    w = world_size() if w is None else w
    return slice(total * r // w, total * (r + 1) // w)


# torch 2.13 renamed the two and warns about the old names; earlier ones know only those
_all_gather = getattr(dist, "all_gather_single", None) or dist.all_gather_into_tensor
_reduce_scatter = getattr(dist, "reduce_scatter_single", None) or dist.reduce_scatter_tensor


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, local: Tensor) -> Tensor:
        w = dist.get_world_size()
        local = local.contiguous()
        gathered = local.new_empty((w * local.shape[0], *local.shape[1:]))
        _all_gather(gathered, local)
        return gathered

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:  # [B, ...] -> [b, ...]
        grad = grads[0].contiguous()
        own = grad.new_empty((grad.shape[0] // dist.get_world_size(), *grad.shape[1:]))
        _reduce_scatter(own, grad, op=dist.ReduceOp.SUM)
        return own


class _Sum(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, local: Tensor) -> Tensor:
        total = local.clone()
        dist.all_reduce(total, op=dist.ReduceOp.SUM)
        return total

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        grad = grads[0].clone()
        dist.all_reduce(grad, op=dist.ReduceOp.SUM)
        return grad


def gather(local: Tensor) -> Tensor:
    """Rows of all ranks in rank order, with gradient: [b, ...] -> [B, ...]. All ranks hold the same b.

    Cost a rank: receives (W-1)*b rows forward, reduce-scatters B rows backward.
    """
    return _Gather.apply(local) if is_distributed() else local


def global_sum(local: Tensor) -> Tensor:
    """Sum over ranks of a tensor of the same shape on each, with gradient (backward: sum over ranks)."""
    return _Sum.apply(local) if is_distributed() else local


@torch.no_grad()
def gather_uneven(local: Tensor) -> Tensor:
    """Rows of all ranks in rank order where ranks hold different numbers of rows; no gradient."""
    if not is_distributed():
        return local
    count = torch.tensor([local.shape[0]], device=local.device)
    counts = [torch.zeros_like(count) for _ in range(world_size())]
    dist.all_gather(counts, count)
    longest = int(max(int(c) for c in counts))
    padded = local.new_zeros((longest, *local.shape[1:]))
    padded[: local.shape[0]] = local
    parts = [torch.empty_like(padded) for _ in counts]
    dist.all_gather(parts, padded)
    return torch.cat([part[: int(c)] for part, c in zip(parts, counts, strict=True)])


def barrier() -> None:
    """Waits for all ranks."""
    if is_distributed():
        dist.barrier()


def broadcast_object(value: Any) -> Any:
    """Rank 0's value on all ranks (a small picklable object made by ourselves)."""
    if not is_distributed():
        return value
    box = [value]
    dist.broadcast_object_list(box, src=0)
    return box[0]


def any_rank(flag: bool, device: torch.device | str = "cpu") -> bool:
    """Whether the flag is set on at least one rank; the same answer on all."""
    if not is_distributed():
        return flag
    value = torch.tensor([int(flag)], device=device)
    dist.all_reduce(value, op=dist.ReduceOp.MAX)
    return bool(value.item())
