"""What a person watches while training: step, time left, loss, recall so far, mined anchors, images a second, time
spent waiting for data.

Invariant: measuring adds no synchronisation of its own; the loop reads a step's numbers once.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import TypeVar

from pipeline.common.progress import Progress
from pipeline.training.checkpoint import RunState

Item = TypeVar("Item")


@dataclass(frozen=True)
class Report:
    """Means since the last report.

    Attributes:
        loss: of the global batch.
        mined: percent of anchors with a mined pair, for each description of an image (joint training has two).
        negatives: mined negative pairs an anchor.
        images_per_second: over all ranks.
        data_wait: percent of the time spent waiting for the loader.
        copy_wait: percent of the time in which the device waited for a batch that the loader had given already.
    """

    loss: float
    mined: tuple[float, ...]
    negatives: float
    images_per_second: float
    data_wait: float
    copy_wait: float


class Meter:
    """Times steps and shows a progress line; a context manager around an epoch.

    Args:
        images: in a global batch.
        total: steps of the run.
        state: of the run (its step and epoch are shown).
        enabled: False on ranks that show nothing.
    """

    def __init__(self, images: int, total: int, state: RunState, enabled: bool) -> None:
        self.images, self.state = images, state
        self._bar = Progress(f"epoch {state.epoch + 1}", total, "steps", enabled=enabled)
        self._bar.resume_at(state.step)
        self._losses: list[float] = []
        self._mined: list[tuple[float, ...]] = []
        self._negatives: list[float] = []
        self._waited = self._copying = 0.0
        self._since = time.perf_counter()
        self._shown: Report | None = None

    def __enter__(self) -> Meter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._bar.close(failed=kind is not None)

    def wait(self, loader: Iterable[Item]) -> Iterator[Item]:
        """The loader's batches; the time spent in it counts as waiting."""
        batches = iter(loader)
        while True:
            start = time.perf_counter()
            try:
                batch = next(batches)
            except StopIteration:
                return
            self._waited += time.perf_counter() - start
            yield batch

    def record(self, loss: float, mined: tuple[float, ...], negatives: float, copy_wait: float = 0.0) -> None:
        """One step's loss, shares of anchors with a mined pair, mined negatives an anchor, seconds in which the device
        waited for the batch; moves the progress line."""
        self._copying += copy_wait
        self._losses.append(loss)
        self._negatives.append(negatives)
        self._mined.append(tuple(100 * share for share in mined))
        now = self._current()
        mined_now = " and alone ".join(f"{percent:.0f}%" for percent in now.mined)
        self._bar.advance(
            1,
            f"loss {now.loss:.4f}  {recall_so_far(self.state)}mined {mined_now}, {now.negatives:.1f} negatives each  "
            f"{now.images_per_second:.0f} images/s  data wait {now.data_wait:.0f}%  "
            f"copy wait {now.copy_wait:.0f}%",
        )

    def report(self) -> Report:
        """Means since the last report, and a new start."""
        report = self._current()
        self._losses, self._mined, self._negatives = [], [], []
        self._waited, self._copying, self._since = 0.0, 0.0, time.perf_counter()
        return report

    def _current(self) -> Report:
        n = max(1, len(self._losses))
        seconds = max(time.perf_counter() - self._since, 1e-9)
        return Report(
            sum(self._losses) / n,
            tuple(sum(kind) / n for kind in zip(*self._mined, strict=True)),
            sum(self._negatives) / n,
            self.images * len(self._losses) / seconds,
            100 * self._waited / seconds,
            100 * self._copying / seconds,
        )


def recall_so_far(state: RunState) -> str:
    """`R@5 61.0 (best 64.5 at step 200)  `, of the last validation; "" before the first."""
    last = [value for name, value in state.validated.items() if name.endswith("recall_at_5")]
    if not last:
        return ""
    best = "" if state.best is None else f" (best {state.best:.1f} at step {state.best_step})"
    return f"R@5 {last[0]:.1f}{best}  "
