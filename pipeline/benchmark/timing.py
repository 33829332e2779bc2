"""Times of several ways to do one thing, as ratios within one run.

Invariant: the ways are timed in turn, round after round, forwards and backwards, so that a machine that slows down
slows all of them; what is compared is the ratio within a round, and its median with the lowest and highest is reported.
"""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch

from pipeline.common.cores import available_cores
from pipeline.common.text import Table

HEADER = ("", "ms", "per second", "speed (lowest-highest)")


@dataclass(frozen=True)
class Row:
    """One way of doing it.

    Attributes:
        name: what it is.
        seconds: median of a call.
        per_second: items (images) a second at that median.
        ratios: for each round, its speed over the first way's; above 1 is faster.
    """

    name: str
    seconds: float
    per_second: float
    ratios: tuple[float, ...]


@dataclass(frozen=True)
class Comparison:
    """Several ways of doing one thing; the first is what the others are held against."""

    title: str
    rows: tuple[Row, ...]

    def ratio(self, name: str) -> float:
        """Median speed of a way over the first's."""
        return statistics.median(next(row.ratios for row in self.rows if row.name == name))


def clock(device: torch.device) -> float:
    """Seconds, once the device has done all that it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def processor_clock(device: torch.device) -> float:
    """Seconds of work of this process on a CPU, whatever else the machine does; on a GPU as `clock`."""
    return time.process_time() if device.type == "cpu" else clock(device)


def compare(
    title: str,
    ways: Mapping[str, Callable[[], object]],
    items: int,
    rounds: int,
    device: torch.device,
    now: Callable[[torch.device], float] = clock,
) -> Comparison:
    """Calls each way once to warm up, then once a round.

    Args:
        title: of the comparison.
        ways: by name; the first is the reference.
        items: images that one call works on.
        rounds: how often.
        device: waited for at the ends of each call.
        now: the clock.
    """
    for way in ways.values():
        way()
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for number in range(rounds):
        for name in list(ways)[:: -1 if number % 2 else 1]:
            start = now(device)
            ways[name]()
            seconds[name].append(now(device) - start)
    return from_seconds(title, seconds, items)


def from_seconds(title: str, seconds: Mapping[str, list[float]], items: int) -> Comparison:
    """A comparison of times taken elsewhere: seconds of each way, round by round."""
    first = next(iter(seconds.values()))
    rows = []
    for name, mine in seconds.items():
        median = statistics.median(mine)
        rows.append(Row(name, median, items / median, tuple(a / b for a, b in zip(first, mine, strict=True))))
    return Comparison(title, tuple(rows))


def show(comparisons: list[Comparison]) -> str:
    """All comparisons as one aligned table."""
    lines: list[tuple[str, ...]] = []
    for comparison in comparisons:
        lines.append((comparison.title, "", "", ""))
        for number, row in enumerate(comparison.rows):
            ratio = f"{statistics.median(row.ratios):.2f} ({min(row.ratios):.2f}-{max(row.ratios):.2f})"
            lines.append(
                (f"  {row.name}", f"{1e3 * row.seconds:,.1f}", f"{row.per_second:,.0f}", ratio if number else "1")
            )
    return Table(HEADER, lines).text()


def machine(device: torch.device) -> str:
    """One line: what these figures were measured on."""
    cores = available_cores()
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    named = f"{torch.cuda.get_device_name(device)}, " if device.type == "cuda" else "no GPU, "
    return (
        f"{named}{cores} CPU cores ({platform.machine()}{load}), {torch.get_num_threads()} threads, "
        f"torch {torch.__version__}, Python {platform.python_version()}"
    )
