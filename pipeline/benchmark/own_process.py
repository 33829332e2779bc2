"""Work in a fresh process of its own, so that its peak memory is its own and a limit on its time can be kept.

Invariant: the peak is the kernel's high-water mark of that process (VmHWM), not of its parent, nor of page cache.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Measured:
    """What came of it."""

    answer: Any
    """What the work returned; None where it did not end."""
    peak: float
    """Largest resident memory, bytes; 0 where it did not end."""
    problem: str = ""
    """Why there is no answer."""


def alone(work: Callable[..., Any], timeout: float | None, *arguments: Any) -> Measured:
    """Runs `work(*arguments)`, a function of a module, in a spawned process, for at most `timeout` seconds if given."""
    context = multiprocessing.get_context("spawn")
    answers: Any = context.SimpleQueue()
    process = context.Process(target=_report, args=(work, answers, arguments))
    process.start()
    process.join(timeout)
    if process.is_alive():
        process.kill()
        process.join()
        return Measured(None, 0.0, f"given up after {timeout:.0f} s")
    if answers.empty():
        return Measured(None, 0.0, f"ended with code {process.exitcode}")
    return Measured(*answers.get())


def peak() -> float:
    """Largest resident memory of this process, bytes; of its own, where getrusage would count its parent's."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        return 1024.0 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        import resource

        return 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _report(work: Callable[..., Any], answers: Any, arguments: tuple[Any, ...]) -> None:
    answer = work(*arguments)
    answers.put((answer, peak()))
