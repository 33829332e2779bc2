"""BatchNorm over the global batch: the images of all ranks, on any device and backend.

Invariant: in training the result, its gradient and the running buffers are those of `nn.BatchNorm2d` on the global
batch in one process, whatever the number of ranks, and the buffers are the same on every rank. (torch's
SyncBatchNorm refuses CPU tensors.) Statistics are float32 at least, also under autocast.

Norms over the same images, such as those of an adapter's parallel paths, are computed together: one exchange for all.
On a GPU the passes over the images are the kernels of torch's SyncBatchNorm, called as it calls them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pipeline.distributed import gather_statistics, is_distributed, sum_statistics


class GlobalBatchNorm2d(nn.BatchNorm2d):
    """`nn.BatchNorm2d` (same arguments, same state_dict keys) whose training statistics span all ranks.

    Cost a rank: one all-gather of 2C + 1 numbers forward (each rank's count, mean and centred square sum, combined
    exactly as in Chan et al. 1979: no cancellation, and ranks may hold different numbers of images), one all-reduce
    of 2C numbers backward. At W = 1, and in eval mode, it is torch's own kernel.

    Under `torch.utils.checkpoint` the second forward, inside backward, recomputes the same output but leaves the
    running buffers alone: they move once a step. Chunks of the batch would each be normalised by themselves, so
    `PlaceModel.encode` takes its chunks through the blocks in step (pipeline.model.chunked).
    """

    def forward(self, input: Tensor) -> Tensor:
        """[b, C, H, W] -> [b, C, H, W]."""
        return normalised_together([self], input)


def normalised_together(norms: Sequence[GlobalBatchNorm2d], x: Tensor) -> Tensor:
    """Each norm over its own channels of x [b, C, H, W], which are the channels of the first norm, then the second's,
    and so on; in training with one exchange forward and one backward, of all their C channels. -> [b, C, H, W].

    The norms share eps, momentum and mode.
    """
    first = norms[0]
    sizes = [norm.num_features for norm in norms]
    means, variances = [norm.running_mean for norm in norms], [norm.running_var for norm in norms]
    mean, var = _joined(means), _joined(variances)
    weight, bias = _joined([norm.weight for norm in norms]), _joined([norm.bias for norm in norms])
    if not first.training:
        return F.batch_norm(x, mean, var, weight, bias, False, 0.0, first.eps)
    momentum = 0.1 if first.momentum is None else first.momentum
    if is_distributed():
        output, own_mean, own_var = _Normalise.apply(x, weight, bias, first.eps)
        with torch.no_grad():
            mean = mean.lerp(own_mean.to(mean.dtype), momentum)
            var = var.lerp(own_var.to(var.dtype), momentum)
    else:
        # copies, which move: checkpoint wants the same tensors saved in both forwards
        mean, var = mean.clone(), var.clone()
        output = F.batch_norm(x, mean, var, weight, bias, True, momentum, first.eps)
    if not _recomputing():
        with torch.no_grad():
            for kept, moved in zip([*means, *variances], [*mean.split(sizes), *var.split(sizes)], strict=True):
                kept.copy_(moved)  # type: ignore[union-attr]
            for norm in norms:
                norm.num_batches_tracked.add_(1)  # type: ignore[union-attr]
    return output


def _joined(parts: Sequence[Tensor | None]) -> Tensor:
    present = [part for part in parts if part is not None]
    return present[0] if len(present) == 1 else torch.cat(present)


def _recomputing() -> bool:
    """Whether this forward runs inside a backward pass, which is where activation checkpointing recomputes."""
    return torch._C._current_graph_task_id() != -1


def _columns(values: Tensor) -> Tensor:
    return values.view(1, -1, 1, 1)


class _Normalise(torch.autograd.Function):
    """(x [b, C, H, W], weight [C], bias [C], eps) -> (y, mean [C], unbiased variance [C]) over all ranks."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor, eps: float) -> tuple[Tensor, ...]:
        if _on_gpu(x):
            return _forward_on_gpu(ctx, x, weight, bias, eps)
        wide = x if x.dtype == torch.float64 else x.float()
        channels, own = x.shape[1], x.numel() // x.shape[1]
        variance, mean = torch.var_mean(wide, dim=(0, 2, 3), correction=0)
        ranks = gather_statistics(torch.cat((mean, variance * own, mean.new_full((1,), own)))[None])  # [W, 2C + 1]
        counts = ranks[:, -1:]
        count = counts.sum()
        means = ranks[:, :channels]
        mean = (means * counts).sum(0) / count
        squares = ranks[:, channels:-1] + counts * (means - mean) ** 2
        variance = squares.sum(0) / count
        inverse = torch.rsqrt(variance + eps)
        y = (wide - _columns(mean)) * _columns(inverse * weight) + _columns(bias)
        ctx.save_for_backward(x, mean, inverse, weight, count)
        unbiased = variance * (count / (count - 1))
        ctx.mark_non_differentiable(mean, unbiased)
        return y.to(x.dtype), mean, unbiased

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        x, mean, inverse, weight, count = ctx.saved_tensors
        if _on_gpu(x):
            return _backward_on_gpu(x, mean, inverse, weight, count, grads[0])
        grad = grads[0].to(mean.dtype)
        unit = (x.to(mean.dtype) - _columns(mean)) * _columns(inverse)  # x normalised, before weight and bias
        own_sum, own_product = grad.sum((0, 2, 3)), (grad * unit).sum((0, 2, 3))
        total_sum, total_product = sum_statistics(torch.stack((own_sum, own_product))) / count
        inner = grad - _columns(total_sum) - unit * _columns(total_product)
        # weight and bias: this rank's part alone, which the data-parallel wrapper averages like every other
        own_weight, own_bias = own_product.to(weight.dtype), own_sum.to(weight.dtype)
        return (inner * _columns(inverse * weight)).to(x.dtype), own_weight, own_bias, None


def _on_gpu(x: Tensor) -> bool:
    return x.is_cuda


def _forward_on_gpu(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor, eps: float) -> tuple[Tensor, ...]:
    """As `_Normalise.forward`, in torch's kernels: one pass for the statistics, one for the result."""
    x, channels = x.contiguous(memory_format=_layout(x)), x.shape[1]
    mean, inverse = torch.batch_norm_stats(x, eps)
    ranks = gather_statistics(torch.cat((mean, inverse, mean.new_full((1,), x.numel() // channels)))[None])
    means, inverses, counts = (part.contiguous() for part in ranks.split((channels, channels, 1), dim=1))
    # with momentum 1 the kernel's running buffers become this batch's own; without them it would count in x's precision
    whole_mean, unbiased = torch.zeros_like(mean), torch.zeros_like(mean)
    mean, inverse = torch.batch_norm_gather_stats_with_counts(
        x, means, inverses, whole_mean, unbiased, 1.0, eps, counts.flatten()
    )
    y = torch.batch_norm_elemt(x, weight, bias, mean, inverse, eps)
    ctx.save_for_backward(x, mean, inverse, weight, counts.flatten().to(torch.int32))
    ctx.mark_non_differentiable(whole_mean, unbiased)
    return y, whole_mean, unbiased


def _backward_on_gpu(
    x: Tensor, mean: Tensor, inverse: Tensor, weight: Tensor, counts: Tensor, grad: Tensor
) -> tuple[Tensor | None, ...]:
    grad = grad.contiguous(memory_format=_layout(x))
    total, product, own_weight, own_bias = torch.batch_norm_backward_reduce(
        grad, x, mean, inverse, weight, True, True, True
    )
    total, product = sum_statistics(torch.stack((total, product))).unbind()
    inner = torch.batch_norm_backward_elemt(grad, x, mean, inverse, weight, total, product, counts)
    return inner, own_weight, own_bias, None


def _layout(x: Tensor) -> torch.memory_format:
    """The layout that the kernels take x in: channels last where it is so already, else channels first."""
    last = x.is_contiguous(memory_format=torch.channels_last)
    return torch.channels_last if last else torch.contiguous_format
