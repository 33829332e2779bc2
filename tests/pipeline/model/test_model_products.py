"""Linear layers through oneDNN: the numbers of `F.linear`, at least as near to float64, where they are taken at all."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from pipeline.model import products
from pipeline.model.products import linear, use_products


@pytest.mark.skipif(not products.WIDE, reason="a CPU without AVX-512, or a torch without oneDNN")
@pytest.mark.parametrize(("shape", "bias"), [((3, 5, 24), True), ((7, 24), False)])
def test_value_and_gradients_are_those_of_float64(shape: tuple[int, ...], bias: bool) -> None:
    torch.manual_seed(0)
    x = torch.randn(*shape, dtype=torch.float64)[..., ::2]  # not contiguous
    weight, shift = torch.randn(9, 12, dtype=torch.float64), torch.randn(9, dtype=torch.float64) if bias else None
    given = [t for t in (x, weight, shift) if t is not None]
    outcome = torch.randn(*shape[:-1], 9, dtype=torch.float64)

    def run(function: object, dtype: torch.dtype) -> list[torch.Tensor]:
        leaves = [t.to(dtype).detach().requires_grad_() for t in given]
        out = function(*leaves, *([] if bias else [None]))  # type: ignore[operator]
        (out * outcome.to(dtype)).sum().backward()
        return [out.detach(), *(leaf.grad for leaf in leaves if leaf.grad is not None)]

    truth = run(F.linear, torch.float64)
    found, plain = run(linear, torch.float32), run(F.linear, torch.float32)
    assert len(found) == len(truth) == len(given) + 1
    for ours, torchs, true in zip(found, plain, truth, strict=True):
        worst = (torchs - true).abs().max()
        assert (ours - true).abs().max() <= 4 * worst + 1e-6
    assert products.taken(x.float(), weight.float())


def test_elsewhere_it_is_torchs_own() -> None:
    x, weight = torch.randn(4, 6), torch.randn(5, 6)
    assert not products.taken(x.double(), weight.double())
    assert not products.taken(x[:0], weight)
    with torch.autocast("cpu", torch.bfloat16):
        assert linear(x, weight, None).dtype == torch.bfloat16
    assert linear(x[:0], weight, None).shape == (0, 5)


def test_a_frozen_weight_gets_no_gradient_and_names_stay() -> None:
    model = nn.Sequential(nn.Linear(6, 5), nn.Linear(5, 2))
    names = list(model.state_dict())
    model[0].requires_grad_(False)
    use_products(model)
    assert list(model.state_dict()) == names and all(isinstance(m, products.Linear) for m in model)
    x = torch.randn(3, 6, requires_grad=True)
    model(x).sum().backward()
    assert x.grad is not None and model[0].weight.grad is None and model[1].weight.grad is not None
