"""Products of activations and weights: `F.linear`, through oneDNN where a CPU computes float32.

torch computes them with MKL, which uses half the width of other makers' AVX-512 units. oneDNN, which torch brings for
its convolutions, uses the whole: on an AMD EPYC twice as fast, forward and backward. Invariant: the same sums in
float32, in another order; everywhere else (GPUs, autocast, float64, compiled or exported models) it is `F.linear`.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

# the operator behind torch.compile's products on CPUs: torch has no public name for it
_ONEDNN: Any = getattr(torch.ops.mkldnn, "_linear_pointwise", None)
WIDE = (
    _ONEDNN is not None and torch.backends.mkldnn.is_available() and "AVX512" in torch.backends.cpu.get_cpu_capability()
)


class Linear(nn.Linear):
    """`nn.Linear` through `linear`; same parameters, same names."""

    def forward(self, input: Tensor) -> Tensor:
        """[..., in] -> [..., out]."""
        return linear(input, self.weight, self.bias)


def use_products(model: nn.Module) -> None:
    """Makes every `nn.Linear` inside compute through `linear`; nothing else of it changes."""
    for module in model.modules():
        if type(module) is nn.Linear:
            module.__class__ = Linear


def linear(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """x [..., in], weight [out, in], bias [out] -> x @ weight.T + bias [..., out]."""
    if not taken(x, weight):
        return F.linear(x, weight, bias)
    if torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in (x, weight, bias)):
        out: Tensor = _Linear.apply(x, weight, bias)
        return out
    return _product(x, weight, bias)


def taken(x: Tensor, weight: Tensor) -> bool:
    """Whether this product goes through oneDNN."""
    return (
        WIDE
        and x.device.type == "cpu"
        and x.dtype == weight.dtype == torch.float32
        and x.numel() > 0
        and not torch.is_autocast_enabled("cpu")
        and not torch.compiler.is_compiling()
        and not torch.jit.is_tracing()
    )


def _product(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    out: Tensor = _ONEDNN(x, weight, bias, "none", [], "")
    return out


class _Linear(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        ctx.save_for_backward(x, weight)
        return _product(x, weight, bias)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        x, weight = ctx.saved_tensors
        grad = grads[0].contiguous()
        rows = grad.flatten(0, -2)
        wanted = ctx.needs_input_grad
        return (
            _product(grad, weight.T) if wanted[0] else None,
            _product(rows.T, x.flatten(0, -2).T) if wanted[1] else None,
            rows.sum(0) if wanted[2] else None,
        )
