"""Memory of a training step against the number of images, with and without chunks.

Invariant: bytes are counted, not guessed: every tensor storage that an operation makes is counted from its making to
its release, through forward, loss and backward, on the model's real shapes. Counting also works on fake tensors (shapes
without data), so a batch that no machine here holds is counted in the same way as one that is run. Weights, gradients
of weights and optimiser moments, which do not depend on the batch, are left out; so is what a kernel allocates inside.
"""

from __future__ import annotations

import gc
import sys
import weakref
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from pipeline.benchmark.own_process import alone, peak
from pipeline.benchmark.sizes import SIZES, Norm, Size, bare, batch, build
from pipeline.common.text import Table
from pipeline.model.vpr import PlaceModel


class Living(TorchDispatchMode):
    """Counts the bytes of tensors that are made while it is entered.

    Attributes:
        now: bytes alive.
        peak: the most bytes that were alive at once.
    """

    def __init__(self) -> None:
        super().__init__()
        self.now = self.peak = 0
        self._known: weakref.WeakSet[Any] = weakref.WeakSet()

    def ignore(self, tensor: Tensor) -> None:
        """Leaves a tensor that was there before out of the count."""
        self._known.add(tensor.untyped_storage())

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        for tensor in tree_leaves(out):
            if isinstance(tensor, Tensor):
                storage = tensor.untyped_storage()
                if storage not in self._known:
                    self._known.add(storage)
                    self.now += storage.nbytes()
                    self.peak = max(self.peak, self.now)
                    weakref.finalize(storage, self._release, storage.nbytes())
        return out

    def _release(self, nbytes: int) -> None:
        self.now -= nbytes


@dataclass(frozen=True)
class Bytes:
    """Of one step.

    Attributes:
        kept: alive between forward and backward (images and weights left out).
        peak: most alive at any moment.
    """

    kept: int
    peak: int


def count(model: PlaceModel, images: Tensor, chunk: int | None = None) -> Bytes:
    """Bytes of a forward and backward of these images; the weights' own gradients are left out."""
    for parameter in model.parameters():
        parameter.grad = torch.zeros_like(parameter) if parameter.requires_grad else None
    living = Living()
    for tensor in (*model.parameters(), *model.buffers(), images):
        living.ignore(tensor)
    with living:
        descriptors = model(images, chunk=chunk)
        gc.collect()
        kept = living.now
        descriptors.square().sum().backward()
    del descriptors
    model.zero_grad(set_to_none=True)
    return Bytes(kept, living.peak)


def count_fake(size: Size, norm: Norm, images: int, chunk: int | None) -> Bytes:
    """`count` of a model and batch that exist as shapes alone."""
    with torch.device("meta"):
        model = bare(size, norm)
    with FakeTensorMode(allow_non_fake_inputs=True):
        model.to_empty(device="cpu")
        return count(model, torch.empty(images, 3, size.image_size, size.image_size), chunk)


def resident(name: str, norm: Norm, images: int, chunk: int | None) -> float:
    """Bytes by which a fresh process's peak resident memory grows over its state before the step, on the CPU."""
    got = alone(_resident, None, name, norm, images, chunk)
    if got.problem:
        raise MemoryError(f"the process of {images} images {got.problem}: out of memory?")
    return float(got.peak - got.answer)


def _resident(name: str, norm: Norm, images: int, chunk: int | None) -> float:
    size = SIZES[name]
    model = build(size, norm)
    pixels, _ = batch(size, images)
    model(pixels[:8], chunk=chunk and min(chunk, 8)).sum().backward()  # libraries and weight gradients in memory
    before = peak()
    model(pixels, chunk=chunk).square().sum().backward()
    return before


BATCHES = {"demo": (72, 288, 1152), "vitb": (8, 32, 288), "tiny": (8, 32)}  # images of the steps, by size


def measure(name: str, limit: float) -> str:
    """The memory table of a size.

    Args:
        name: of the size.
        limit: bytes; a step is also run, in a fresh process, where its counted peak stays below.
    """
    size = SIZES[name]
    lines: list[tuple[str, ...]] = [("", "images", "kept", "peak", "peak an image", "resident, run")]
    for norm, chunk in ((n, c) for n in ("batch", "group") for c in (None, size.memory_chunk)):
        for images in BATCHES[name]:
            counted = count_fake(size, norm, images, chunk)  # type: ignore[arg-type]
            run = counted.peak < limit
            ran = _mb(resident(name, norm, images, chunk)) if run else "not run"  # type: ignore[arg-type]
            way = f"{norm} norm, {'all at once' if chunk is None else f'{chunk} at a time'}"
            print(f"{way}, {images} images", file=sys.stderr, flush=True)  # minutes of work: say where it is
            lines.append(
                (way, f"{images:,}", _mb(counted.kept), _mb(counted.peak), _mb(counted.peak / images), ran)
            )  # fmt: skip
    return Table(lines[0], lines[1:]).text()


def _mb(n: float) -> str:
    return f"{n / 1e6:,.1f} MB"
