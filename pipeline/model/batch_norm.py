"""BatchNorm over the global batch: the images of all ranks, on any device and backend.

Invariant: in training the result, its gradient and the running buffers are those of `nn.BatchNorm2d` on the global
batch in one process, whatever the number of ranks, and the buffers are the same on every rank. (torch's
SyncBatchNorm refuses CPU tensors.) Statistics are float32 at least, also under autocast.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pipeline.distributed import gather, global_sum, is_distributed


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
        if not self.training:
            return super().forward(input)
        update = not _recomputing()
        if update and self.num_batches_tracked is not None:
            self.num_batches_tracked.add_(1)
        momentum = 0.1 if self.momentum is None else self.momentum
        if not is_distributed():
            mean, var = self.running_mean, self.running_var
            if not update and mean is not None and var is not None:
                mean, var = mean.clone(), var.clone()  # checkpoint wants the same tensors saved in both forwards
            return F.batch_norm(input, mean, var, self.weight, self.bias, True, momentum, self.eps)
        output, mean, variance, count = _Normalise.apply(input, self.weight, self.bias, self.eps)
        if update and self.running_mean is not None and self.running_var is not None:
            with torch.no_grad():
                unbiased = variance * (count / (count - 1))
                self.running_mean.lerp_(mean.to(self.running_mean.dtype), momentum)
                self.running_var.lerp_(unbiased.to(self.running_var.dtype), momentum)
        normalised: Tensor = output
        return normalised


def _recomputing() -> bool:
    """Whether this forward runs inside a backward pass, which is where activation checkpointing recomputes."""
    return torch._C._current_graph_task_id() != -1


def _columns(values: Tensor) -> Tensor:
    return values.view(1, -1, 1, 1)


class _Normalise(torch.autograd.Function):
    """(x [b, C, H, W], weight [C], bias [C], eps) -> (y, mean [C], biased variance [C], count []) over all ranks."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor, eps: float) -> tuple[Tensor, ...]:
        wide = x if x.dtype == torch.float64 else x.float()
        channels, own = x.shape[1], x.numel() // x.shape[1]
        variance, mean = torch.var_mean(wide, dim=(0, 2, 3), correction=0)
        ranks = gather(torch.cat((mean, variance * own, mean.new_full((1,), own)))[None])  # [W, 2C + 1]
        counts = ranks[:, -1:]
        count = counts.sum()
        means = ranks[:, :channels]
        mean = (means * counts).sum(0) / count
        squares = ranks[:, channels:-1] + counts * (means - mean) ** 2
        variance = squares.sum(0) / count
        inverse = torch.rsqrt(variance + eps)
        y = (wide - _columns(mean)) * _columns(inverse * weight) + _columns(bias)
        ctx.save_for_backward(x, mean, inverse, weight, count)
        ctx.mark_non_differentiable(mean, variance, count)
        return y.to(x.dtype), mean, variance, count

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        x, mean, inverse, weight, count = ctx.saved_tensors
        grad = grads[0].to(mean.dtype)
        unit = (x.to(mean.dtype) - _columns(mean)) * _columns(inverse)  # x normalised, before weight and bias
        own_sum, own_product = grad.sum((0, 2, 3)), (grad * unit).sum((0, 2, 3))
        total_sum, total_product = global_sum(torch.stack((own_sum, own_product))) / count
        inner = grad - _columns(total_sum) - unit * _columns(total_product)
        # weight and bias: this rank's part alone, which the data-parallel wrapper averages like every other
        own_weight, own_bias = own_product.to(weight.dtype), own_sum.to(weight.dtype)
        return (inner * _columns(inverse * weight)).to(x.dtype), own_weight, own_bias, None
