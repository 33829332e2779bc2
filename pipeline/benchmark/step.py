"""The training step and inference: precisions, chunks, parts of a step, compiled blocks.

Invariant: it needs torch and transformers alone, so it runs on a machine that has neither data nor trackers; what is
timed is the trainer's own step (forward under autocast, loss, backward, optimiser) without the reading of images.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial

import torch
from torch import Tensor

from pipeline.benchmark.sizes import Size, batch, build
from pipeline.benchmark.timing import Comparison, clock, compare, from_seconds
from pipeline.config import TrainConfig
from pipeline.model.bank import make_bank
from pipeline.model.vpr import PlaceModel
from pipeline.training.loss import MultiSimilarityLoss
from pipeline.training.schedule import build_optimizer


class Step:
    """A model with its optimiser and one batch; calling it is one training step."""

    def __init__(self, model: PlaceModel, images: Tensor, labels: Tensor, device: torch.device) -> None:
        self.model, self.images, self.labels, self.device = model.to(device), images, labels, device
        self.optimizer = build_optimizer(TrainConfig(lr=1e-6), model.parameters())
        self.loss = MultiSimilarityLoss()
        self.precision: torch.dtype | None = None
        self.chunk: int | None = None
        self.parts: dict[str, float] = {}

    def way(self, precision: torch.dtype | None = None, chunk: int | None = None) -> Callable[[], None]:
        """The step in a precision, in chunks."""

        def run() -> None:
            self.precision, self.chunk = precision, chunk
            self()

        return run

    def __call__(self) -> None:
        """One step; its parts' seconds are in `parts` afterwards."""
        marks = [clock(self.device)]
        with autocast(self.device, self.precision):
            descriptors = self.model(self.images, chunk=self.chunk)
        marks.append(clock(self.device))
        loss = self.loss(descriptors, self.labels)
        marks.append(clock(self.device))
        loss.backward()
        marks.append(clock(self.device))
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        marks.append(clock(self.device))
        names = ("forward", "loss", "backward", "optimiser")
        self.parts = {name: marks[i + 1] - marks[i] for i, name in enumerate(names)}


def autocast(device: torch.device, dtype: torch.dtype | None) -> torch.autocast | nullcontext[None]:
    """Autocast to `dtype`; None computes in float32."""
    return nullcontext() if dtype is None else torch.autocast(device.type, dtype)


def measure(size: Size, device: torch.device, rounds: int, images: int, full: bool) -> list[Comparison]:
    """All comparisons of the step at a size."""
    pixels, labels = batch(size, images, device)
    step = Step(build(size), pixels, labels, device)
    found = [
        compare(
            f"training step, {images} images",
            {"float32": step.way(), "bf16 autocast": step.way(torch.bfloat16)},
            images, rounds, device,
        ),
        parts(step, rounds, images),
        inference(step, rounds, images),
        contexts(step, rounds, images),
    ]  # fmt: skip
    chunk = min(size.chunk, max(1, images // 2))
    found.append(
        compare(
            f"training step, BatchNorm in the adapters, {images} images",
            {"all at once": step.way(), f"{chunk} at a time, in step": step.way(chunk=chunk)},
            images, rounds, device,
        )
    )  # fmt: skip
    if full:
        found.append(compiled(size, step, rounds, images))
    del step
    step = Step(build(size, "group"), pixels, labels, device)
    found.append(
        compare(
            f"training step, GroupNorm in the adapters, {images} images",
            {"all at once": step.way(), f"{chunk} at a time": step.way(chunk=chunk)},
            images, rounds, device,
        )
    )  # fmt: skip
    return found


def parts(step: Step, rounds: int, images: int) -> Comparison:
    """Parts of a float32 step held against the whole of it: a speed of 4 is a quarter of the time."""
    run = step.way()
    run()
    seconds: dict[str, list[float]] = {"whole step": []}
    for _ in range(rounds):
        run()
        seconds["whole step"].append(sum(step.parts.values()))
        for name, taken in step.parts.items():
            seconds.setdefault(name, []).append(taken)
    whole = statistics.median(seconds["whole step"])
    named = {
        f"{name}: {100 * statistics.median(s) / whole:.1f} %" if name != "whole step" else name: s
        for name, s in seconds.items()
    }
    return from_seconds("its parts (float32)", named, images)


def inference(step: Step, rounds: int, images: int) -> Comparison:
    """Descriptors of one group in eval mode."""

    def way(dtype: torch.dtype | None) -> Callable[[], None]:
        def run() -> None:
            step.model.eval()
            with torch.inference_mode(), autocast(step.device, dtype):
                step.model(step.images)
            step.model.train()

        return run

    ways = {"float32": way(None), "bf16 autocast": way(torch.bfloat16)}
    return compare(f"inference, {images} images", ways, images, rounds, step.device)


def contexts(step: Step, rounds: int, images: int) -> Comparison:
    """Descriptors of images in one group, each alone, and each beside a bank of 64; float32, backbone included."""
    model = step.model.eval()
    with torch.inference_mode():
        bank = make_bank(torch.randn(64, model.regions, model.pooling.dim), "train")
        memory = model.remember(bank)

    def way(correlate: Callable[[Tensor], Tensor]) -> Callable[[], None]:
        def run() -> None:
            model.eval()
            with torch.inference_mode():
                correlate(model.encode(step.images))
            model.train()

        return run

    ways = {
        "in one group": way(model.correlate),
        "each alone": way(partial(model.correlate, alone=True)),
        "beside a bank of 64": way(partial(model.correlate_beside, memory=memory)),
    }
    return compare(f"inference by context, {images} images", ways, images, rounds, step.device)


def compiled(size: Size, step: Step, rounds: int, images: int) -> Comparison:
    """torch.compile on the blocks, once the first step has compiled them."""
    other = Step(build(size), step.images, step.labels, step.device)
    for block in other.model.backbone.blocks:
        block.compile()
    ways = {"as written": step.way(), "blocks compiled": other.way()}
    return compare(f"training step, torch.compile, {images} images", ways, images, rounds, step.device)
