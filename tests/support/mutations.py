"""Tries inputs that were changed on purpose and counts how each ends.

The only good ends are one line with the documented code, or an acceptance that the test has found harmless.
"""

from __future__ import annotations

import signal
import traceback
from collections import Counter
from collections.abc import Callable
from typing import Any

from pipeline.common.errors import UserError


class Hang(BaseException):
    """Not an `Exception`, so that no `except Exception` under test swallows it."""


def _ring(*_: Any) -> None:
    raise Hang


class Tally:
    """`run` tries one case; `faults` names those that ended in a traceback, a hang, or an acceptance in silence."""

    def __init__(self, seconds: float = 20.0) -> None:
        self.seconds, self.faults = seconds, list[str]()
        self.ends: Counter[str] = Counter()

    def run(self, what: str, work: Callable[[], object], codes: tuple[int, ...], harmless: bool = False) -> None:
        """Does the work in this process. `harmless`: that it ends well is no fault."""
        former = signal.signal(signal.SIGALRM, _ring)
        signal.setitimer(signal.ITIMER_REAL, self.seconds)
        try:
            work()
            end, fault = ("harmless", None) if harmless else ("silent acceptance", what)
        except UserError as error:
            line = str(error)
            good = error.exit_code in codes and line.isprintable() and 10 < len(line) < 3000
            end, fault = ("one line", None) if good else ("bad line", f"{what}: code {error.exit_code}, {line!r}")
        except Hang:
            end, fault = "hang", f"{what}: no end after {self.seconds} s"
        except Exception:
            end, fault = "traceback", f"{what}: {traceback.format_exc(limit=-3)}"
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, former)
        self.ends[end] += 1
        if fault is not None:
            self.faults.append(f"{end}: {fault}")

    def __str__(self) -> str:
        told = ("one line", "harmless", "bad line", "traceback", "hang", "silent acceptance")
        return f"{self.ends.total()} cases: " + ", ".join(f"{self.ends[end]} {end}" for end in told)
