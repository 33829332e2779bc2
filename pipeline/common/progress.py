"""Progress of long work: a live line on a terminal, plain timed lines elsewhere (log files, schedulers, CI).

Invariant: nothing here writes to standard output, which belongs to results. No thread is started: the live line is
drawn by the work itself.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Sized
from types import TracebackType
from typing import Any, ClassVar, TypeVar

Item = TypeVar("Item")
QUIET = 1.0  # seconds: work shorter than this leaves no line in a log
REDRAW = 0.2  # seconds between two drawings of the live line


class Progress:
    """Counts work towards `total`; use as a context manager and call `advance`.

    Args:
        label: what is being done, for example "writing shards".
        total: units of work, or None when unknown.
        unit: name of a unit ("images").
        every: seconds between two plain lines where there is no terminal.
        enabled: False silences it (ranks other than 0).
    """

    _live: ClassVar[Progress | None] = None  # a terminal has room for one; work inside of other work has plain lines

    def __init__(
        self, label: str, total: int | None, unit: str = "it", every: float = 10.0, enabled: bool = True
    ) -> None:
        self.label, self.total, self.unit, self.every, self.enabled = label, total, unit, every, enabled
        self.done = self._before = 0
        self._note = ""
        self._start = self._last = time.monotonic()
        self._bar: Any = None
        if enabled and sys.stderr.isatty() and Progress._live is None:
            self._bar = _bar(self)
            Progress._live = self
            self._bar.start()

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close(failed=kind is not None)

    def advance(self, n: int = 1, note: str = "") -> None:
        """Adds n finished units; `note` is shown beside them."""
        self.done += n
        self._note = note
        if self.enabled and time.monotonic() - self._last >= (self.every if self._bar is None else REDRAW):
            self._last = time.monotonic()
            self._show()

    def resume_at(self, done: int) -> None:
        """Counts `done` units as finished earlier; the rate leaves them out."""
        self.done = self._before = done

    def close(self, failed: bool = False) -> None:
        """Ends the live line, or prints the closing plain line."""
        if self._bar is not None:
            self._show()
            self._bar.live.transient = time.monotonic() - self._start < QUIET  # leaves nothing behind
            self._bar.stop()
            self._bar, Progress._live = None, None
        elif self.enabled and not failed and time.monotonic() - self._start >= QUIET:
            self._show()
        self.enabled = False

    def text(self) -> str:
        """How far it is, as one line: `epoch 2: 120/300 steps, 1.2 a second, 2 min 30 s left  loss 0.8`."""
        seconds = max(time.monotonic() - self._start, 1e-9)
        of = f"/{self.total:,}" if self.total is not None else ""
        rate = (self.done - self._before) / seconds
        left = (
            f", {duration((self.total - self.done) / rate)} left" if self.total and 0 < self.done < self.total else ""
        )
        return (
            f"{self.label}: {self.done:,}{of} {self.unit}, {rate:,.1f} a second{left if rate else ''}  {self._note}"
        ).rstrip()

    def _show(self) -> None:
        if self._bar is None:
            print(self.text(), file=sys.stderr, flush=True)
        else:
            self._bar.update(0, completed=self.done)
            self._bar.refresh()


def _bar(progress: Progress) -> Any:
    """A live display by `rich`: a bar, and `progress.text()` below it."""
    from rich import progress as rich
    from rich.console import Console, RenderableType
    from rich.text import Text

    class Bar(rich.Progress):
        def get_renderables(self) -> Iterable[RenderableType]:
            yield self.make_tasks_table(self.tasks)
            yield Text(progress.text(), no_wrap=True, overflow="ellipsis")

    columns = (rich.BarColumn(bar_width=None), rich.TaskProgressColumn())
    bar = Bar(*columns, console=Console(stderr=True), auto_refresh=False, expand=True)
    bar.add_task("", total=progress.total)
    return bar


def duration(seconds: float) -> str:
    """`40 s`, `2 min 30 s`, `3 h 20 min`, `2 d 4 h`."""
    whole = round(seconds)
    for unit, size, smaller, part in (("d", 86_400, "h", 3_600), ("h", 3_600, "min", 60), ("min", 60, "s", 1)):
        if whole >= size:
            rest = whole % size // part
            return f"{whole // size} {unit}" + (f" {rest} {smaller}" if rest else "")
    return f"{whole} s"


def track(items: Iterable[Item], label: str, total: int | None = None, unit: str = "it") -> Iterator[Item]:
    """Yields `items` and shows how far it has come."""
    if total is None and isinstance(items, Sized):
        total = len(items)
    with Progress(label, total, unit) as progress:
        for item in items:
            yield item
            progress.advance()
