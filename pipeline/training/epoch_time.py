"""How long an epoch will take, from two measured parts: a step's computation, and reading its images (`--dry_run`).

Approximate: the model has random weights and no wrapper, so exchanging gradients, the optimiser, validation and saving
are not in it; where the batch is too slow to be tried whole, its time is extrapolated from two smaller ones.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from pipeline.common.cores import available_cores
from pipeline.common.progress import duration
from pipeline.config import RunConfig
from pipeline.data.places import build_loader
from pipeline.data.shard_sets import cache_of
from pipeline.distributed import agreed, on_rank_0, rank, world_size
from pipeline.model.vpr import PlaceModel
from pipeline.training.loss import MultiSimilarityLoss
from shards.index import ShardIndex

ENOUGH = 1.0  # seconds of a pass: a larger batch is not tried


@dataclass(frozen=True)
class StepTime:
    """Seconds of a step on one process.

    Attributes:
        compute: forward and backward pass of its images.
        tried: images they were measured on at most.
        images: of the process in a step.
        read: seconds in which one loader reads these images; None for shards that would have to be fetched.
        workers: loaders beside the step; 0: the process itself reads.
    """

    compute: float
    tried: int
    images: int
    read: float | None
    workers: int

    @property
    def seconds(self) -> float:
        """Of the whole step: workers read while it computes."""
        read = self.read or 0.0
        return max(self.compute, read / self.workers) if self.workers else self.compute + read

    @property
    def bound(self) -> str:
        """What it waits for."""
        read = (self.read or 0.0) / max(self.workers, 1)
        return "computation" if read <= self.compute else "reading images (raise data.workers)"

    def rows(self, steps: int) -> list[tuple[str, str]]:
        """Rows (what, value) for people; `steps`: of an epoch."""
        how = f"measured on {self.tried} of {self.images} images" if self.tried < self.images else "measured"
        read = "fetching shards not measured"
        if self.read is not None:
            by = (
                f"{self.workers} worker{'s' * (self.workers > 1)}"
                if self.workers
                else "the process itself (data.workers 0)"
            )
            read = f"{self.read / max(self.workers, 1):.3g} s to read its images by {by}"
        return [
            ("time a step", f"about {self.compute:.3g} s of computation ({how}), {read}"),
            ("time an epoch", f"about {duration(self.seconds * steps)}, bound by {self.bound}; exchange of gradients, "
                              "validation and saving not counted"),
        ]  # fmt: skip


def step_time(config: RunConfig, index: ShardIndex, model: PlaceModel, accelerator: Any) -> StepTime:
    """Measures a step of the run's model, which is on the accelerator's device. Collective: its forward pass is.

    Raises:
        DataError: the first batch cannot be read.
    """
    images = 4 * config.data.places_per_batch // world_size()
    compute, tried = _compute(config, model, accelerator, images)
    read = agreed(lambda: _read(config, index), what=f"reading a batch of {config.data.shards}")
    cores = available_cores()
    most = max(1, cores // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))
    return StepTime(compute, tried, images, read, min(config.data.workers, most))


def _compute(config: RunConfig, model: PlaceModel, accelerator: Any, images: int) -> tuple[float, int]:
    """(Seconds of forward and backward pass of so many images on each rank, the most that were tried)."""
    loss = MultiSimilarityLoss(config.loss.alpha, config.loss.beta, config.loss.base, config.loss.margin).to(
        accelerator.device
    )

    def once(n: int) -> float:
        inputs = torch.randn(n, 3, *model.input_size.largest, device=accelerator.device)
        labels = torch.arange(n, device=accelerator.device) // 4 + rank() * n
        _wait(accelerator.device)
        start = time.perf_counter()
        with accelerator.autocast():
            found = model(inputs, chunk=config.train.encode_chunk, joint=config.train.passes == "joint")
        loss(found, labels).backward()
        _wait(accelerator.device)
        model.zero_grad(set_to_none=True)
        return time.perf_counter() - start

    n, before = min(4, images), 0.0
    while True:
        once(n)  # the first pass of a shape also allocates
        seconds = once(n)
        if n == images or on_rank_0(lambda: seconds > ENOUGH):  # noqa: B023 (called at once)
            break
        n, before = min(2 * n, images), seconds
    if n == images:
        return seconds, n
    each = (seconds - before) / (n - n // 2) if before else seconds / n
    return seconds + max(each, 0.0) * (images - n), n


def _read(config: RunConfig, index: ShardIndex) -> float | None:
    """Seconds in which this process reads its part of the first batch."""
    if cache_of(index, Path(config.data.cache), 0).remote:
        return None
    alone = replace(config.data, workers=0)
    start = time.perf_counter()
    next(iter(build_loader(index, alone, config.seed, 0, 0, rank(), world_size())))
    return time.perf_counter() - start


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
