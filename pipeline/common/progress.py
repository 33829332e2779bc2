"""Progress of long work: a bar on a terminal, plain timed lines elsewhere (log files, schedulers, CI).

Invariant: nothing here writes to standard output, which belongs to results.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Sized
from types import TracebackType
from typing import TypeVar

Item = TypeVar("Item")
QUIET = 1.0  # seconds: work shorter than this leaves no line in a log


class Progress:
    """Counts work towards `total`; use as a context manager and call `advance`.

    Args:
        label: what is being done, for example "writing shards".
        total: units of work, or None when unknown.
        unit: name of a unit ("images").
        every: seconds between two plain lines where there is no terminal.
        enabled: False silences it (ranks other than 0).
    """

    def __init__(
        self, label: str, total: int | None, unit: str = "it", every: float = 10.0, enabled: bool = True
    ) -> None:
        self.label, self.total, self.unit, self.every, self.enabled = label, total, unit, every, enabled
        self.done = self._before = 0
        self._note = ""
        self._start = self._last = time.monotonic()
        self._bar = None
        if enabled and sys.stderr.isatty():
            from tqdm import tqdm

            self._bar = tqdm(total=total, desc=label, unit=" " + unit, leave=True, dynamic_ncols=True)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close(failed=kind is not None)

    def advance(self, n: int = 1, note: str = "") -> None:
        """Adds n finished units; `note` is shown beside them."""
        self.done += n
        self._note = note
        if self._bar is not None:
            if note:
                self._bar.set_postfix_str(note, refresh=False)
            self._bar.update(n)
        elif self.enabled and time.monotonic() - self._last >= self.every:
            self._last = time.monotonic()
            self._line()

    def resume_at(self, done: int) -> None:
        """Counts `done` units as finished earlier; the rate leaves them out."""
        self.done = self._before = done
        if self._bar is not None:
            self._bar.n = self._bar.initial = done

    def close(self, failed: bool = False) -> None:
        """Ends the bar, or prints the closing plain line."""
        if self._bar is not None:
            self._bar.close()
        elif self.enabled and not failed and time.monotonic() - self._start >= QUIET:
            self._line()

    def _line(self) -> None:
        seconds = max(time.monotonic() - self._start, 1e-9)
        of = f"/{self.total:,}" if self.total is not None else ""
        rate = (self.done - self._before) / seconds
        print(
            f"{self.label}: {self.done:,}{of} {self.unit}, {rate:,.1f} a second  {self._note}".rstrip(),
            file=sys.stderr,
            flush=True,
        )


def track(items: Iterable[Item], label: str, total: int | None = None, unit: str = "it") -> Iterator[Item]:
    """Yields `items` and shows how far it has come."""
    if total is None and isinstance(items, Sized):
        total = len(items)
    with Progress(label, total, unit) as progress:
        for item in items:
            yield item
            progress.advance()
