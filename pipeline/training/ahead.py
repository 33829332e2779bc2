"""A loader's batches on the device, one ahead: the next one is copied there while a step computes.

Invariant: the same batches in the same order. On a GPU a stream of its own copies from pinned memory into one of two
buffers, once the step that last read this buffer has done so; the host waits for neither. On a CPU nothing is copied.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from pipeline.data.images import normalise
from pipeline.data.places import Batch


class Ready(NamedTuple):
    """This rank's part of a global batch on the device, b images."""

    images: Tensor
    """float32 [b, 3, S, S], normalised."""
    labels: Tensor
    """int64 [b]."""
    keys: list[str]
    """Sample keys, one a place."""
    copy_wait: Callable[[], float]
    """Seconds for which the device waited for the copy; call it once the step's forward is over."""


class OnDevice:
    """Batches of a loader on a device.

    Args:
        batches: of the loader.
        device: where steps compute.
    """

    def __init__(self, batches: Iterator[Batch], device: torch.device) -> None:
        self.batches, self.device = batches, device
        self.copies = [_Copy(device), _Copy(device)] if device.type == "cuda" else []
        self.fetched = 0

    def fetch(self) -> Callable[[], Ready] | None:
        """Takes the next batch from the loader and begins to copy it; None at the loader's end. Call what it returns
        where the step begins, before the next but one is fetched. Raises what the loader raises."""
        batch = next(self.batches, None)
        if batch is None:
            return None
        if not self.copies:
            return lambda: Ready(
                normalise(batch.images.to(self.device)), batch.labels.to(self.device), batch.keys, _no_wait
            )
        copy = self.copies[self.fetched % len(self.copies)]
        self.fetched += 1
        copy.begin(batch)
        return copy.ready


def _no_wait() -> float:
    return 0.0


class _Copy:
    """One buffer of a GPU, and the stream that fills it."""

    def __init__(self, device: torch.device) -> None:
        self.stream = torch.cuda.Stream(device)
        self.copied, self.read = torch.cuda.Event(), torch.cuda.Event()
        self.batch: Batch | None = None
        self.images, self.labels = torch.empty(0, device=device), torch.empty(0, device=device)

    def begin(self, batch: Batch) -> None:
        """Begins to copy a batch, after what last read the buffer."""
        self.batch = batch  # also keeps its pinned memory
        if self.images.shape != batch.images.shape:
            self.images, self.labels = (torch.empty_like(t, device=self.images.device) for t in batch[:2])
            self.stream.wait_stream(torch.cuda.current_stream())  # this memory may have been another tensor's
        self.stream.wait_event(self.read)
        with torch.cuda.stream(self.stream):
            self.images.copy_(batch.images, non_blocking=True)
            self.labels.copy_(batch.labels, non_blocking=True)
            self.copied.record()

    def ready(self) -> Ready:
        """The batch, for the current stream, which waits for the copy; the host does not."""
        assert self.batch is not None
        before, after = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        before.record()
        torch.cuda.current_stream().wait_event(self.copied)
        after.record()
        images, labels = normalise(self.images), self.labels.clone()
        self.read.record()
        return Ready(images, labels, self.batch.keys, lambda: before.elapsed_time(after) / 1e3)
