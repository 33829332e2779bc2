"""What half precision does to descriptors, loss and gradients: errors against float64.

Invariant: the same weights and images in every precision; the truth is the same model computed in float64 throughout.
Errors are relative, the norm of the difference over the norm of the truth, so they do not depend on a tensor's scale.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import torch
from torch import Tensor

from pipeline.benchmark.sizes import Size, batch, build
from pipeline.benchmark.step import autocast
from pipeline.common.text import Table
from pipeline.model.vpr import PlaceModel
from pipeline.training.loss import MultiSimilarityLoss

PRECISIONS: dict[str, torch.dtype | None] = {"float32": None, "bf16": torch.bfloat16, "fp16": torch.float16}
# fp16's smallest number is 6e-8: gradients are multiplied before they are rounded to it, and divided afterwards
FP16_SCALE = 1024.0


@dataclass(frozen=True)
class Errors:
    """Of one precision against float64.

    Attributes:
        descriptor: relative error of the descriptors.
        descriptor_max: largest difference of one number of a descriptor (descriptors have length 1).
        similarity: largest difference of a cosine between two images of the batch.
        loss: relative error of the loss.
        gradient: relative error of all trained parameters' gradients as one vector.
        worst: the largest relative error of one parameter's gradient, of those that hold 0.1 % of the whole's norm.
        worst_name: that parameter.
        finite: whether every gradient is.
    """

    descriptor: float
    descriptor_max: float
    similarity: float
    loss: float
    gradient: float
    worst: float
    worst_name: str
    finite: bool


@dataclass(frozen=True)
class Result:
    """Descriptors [b, dim], the loss and the gradients by name, all float64."""

    descriptors: Tensor
    loss: Tensor
    gradients: dict[str, Tensor]


def run(model: PlaceModel, images: Tensor, labels: Tensor, dtype: torch.dtype | None, joint: bool = False) -> Result:
    """One forward and backward; `dtype` is autocast's, None computes as the model's own type."""
    scale = FP16_SCALE if dtype == torch.float16 else 1.0
    with autocast(images.device, dtype):
        descriptors = model(images, joint=joint)
    loss = MultiSimilarityLoss()(descriptors, labels)
    model.zero_grad(set_to_none=True)
    (loss * scale).backward()
    gradients = {n: p.grad.double() / scale for n, p in model.named_parameters() if p.grad is not None}
    return Result(descriptors.detach().double(), loss.detach().double(), gradients)


def errors(truth: Result, found: Result) -> Errors:
    """`found` held against `truth`."""
    whole = sum(g.square().sum().item() for g in truth.gradients.values()) ** 0.5
    apart = {n: (found.gradients[n] - g).norm().item() for n, g in truth.gradients.items()}
    large = {n: apart[n] / g.norm().item() for n, g in truth.gradients.items() if g.norm().item() > 1e-3 * whole}
    worst = max(large, key=lambda n: large[n])
    difference = found.descriptors - truth.descriptors
    cosines = [r.descriptors @ r.descriptors.T for r in (found, truth)]
    return Errors(
        descriptor=(difference.norm() / truth.descriptors.norm()).item(),
        descriptor_max=difference.abs().max().item(),
        similarity=(cosines[0] - cosines[1]).abs().max().item(),
        loss=((found.loss - truth.loss).abs() / truth.loss.abs()).item(),
        gradient=sum(e * e for e in apart.values()) ** 0.5 / whole,
        worst=large[worst],
        worst_name=worst,
        finite=all(torch.isfinite(g).all().item() for g in found.gradients.values()),
    )


def compare(size: Size, images: int, device: torch.device, joint: bool = False) -> dict[str, Errors]:
    """Errors of each precision at a size, in training mode (batch statistics, attention over the batch)."""
    pixels, labels = batch(size, images, device)
    model = build(size).to(device)
    exact = copy.deepcopy(model).double()
    truth = run(exact, pixels.double(), labels, None, joint)
    del exact
    return {name: errors(truth, run(model, pixels, labels, dtype, joint)) for name, dtype in PRECISIONS.items()}


def show(found: dict[str, Errors]) -> str:
    """The errors as a table."""
    lines: list[tuple[str, ...]] = [
        ("against float64", "descriptor", "its largest", "cosine, largest", "loss", "gradient", "worst parameter", "")
    ]
    for name, e in found.items():
        numbers = (e.descriptor, e.descriptor_max, e.similarity, e.loss, e.gradient, e.worst)
        lines.append((name, *(f"{n:.1e}" for n in numbers), e.worst_name if e.finite else "not finite"))
    return Table(lines[0], lines[1:]).text()
