"""Changes inputs on purpose (seeded), tries them and counts how each ends.

The only good ends are one line with the documented code, or an acceptance that the test has found harmless.

    tally = Tally()
    for what, changed in edited_json(told, seed=0, count=60):
        tally.run(what, lambda: read(written(changed)), codes=(3,))
    assert not tally.faults
"""

from __future__ import annotations

import copy
import json
import random
import signal
import subprocess
import sys
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from pipeline.common.errors import UserError

ROOT = Path(__file__).resolve().parents[2]
ODD: tuple[Any, ...] = (
    None, True, False, -1, 0, 1, 10**9, 10**400, 0.5, -0.0, float("nan"), float("inf"), "", "x", "nul\0byte", "\n",
    "../../x", "/etc/passwd", "x" * 5000, "\x1b[31m", "\udcff", [], [1], [[]], {}, {"a": 1}, "1", "1e400",
)  # fmt: skip


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

    def run_process(self, what: str, arguments: Sequence[str], codes: tuple[int, ...], harmless: bool = False) -> None:
        """The same for `python -m ARGUMENTS`, a process of its own."""

        def work() -> None:
            command = [sys.executable, "-m", *arguments]
            try:
                done = subprocess.run(
                    command, capture_output=True, text=True, errors="replace", timeout=self.seconds, cwd=ROOT
                )
            except subprocess.TimeoutExpired:
                raise Hang from None
            if "Traceback" in done.stderr:
                raise RuntimeError(done.stderr[-2000:])
            if done.returncode:
                error = UserError((done.stderr.strip() or "nothing told").split("\n")[-1])
                error.exit_code = done.returncode
                raise error

        former, self.seconds = self.seconds, max(self.seconds, 120.0)
        try:
            self.run(what, work, codes, harmless)
        finally:
            self.seconds = former

    def __str__(self) -> str:
        told = ("one line", "harmless", "bad line", "traceback", "hang", "silent acceptance")
        return f"{self.ends.total()} cases: " + ", ".join(f"{self.ends[end]} {end}" for end in told)


def edited_bytes(content: bytes, seed: int, count: int) -> Iterator[tuple[str, bytes]]:
    """(what was done, changed bytes): cut, emptied, bits flipped, ranges zeroed, doubled, removed, garbage put in."""
    draw = random.Random(seed)
    yield "empty", b""
    yield "one byte", content[:1]
    yield "garbage", draw.randbytes(len(content))
    yield "doubled", content + content
    for number in range(max(0, count - 4)):
        at = draw.randrange(max(1, len(content)))
        length = draw.randint(1, max(1, len(content) // 8))
        kind = draw.choice(["cut", "flip", "zero", "remove", "insert", "early flip", "end"])
        if kind == "early flip":
            at = draw.randrange(min(64, max(1, len(content))))
        changed = _edited(content, kind, at, length, draw.randbytes(length), 1 << draw.randrange(8))
        if changed != content:
            yield f"{number} {kind} at {at}", changed


def _edited(content: bytes, kind: str, at: int, length: int, noise: bytes, bit: int) -> bytes:
    before, after, behind = content[:at], content[at:], content[at + length :]
    if kind == "cut":
        return before
    if kind in ("flip", "early flip"):
        return before + bytes([content[at] ^ bit]) + content[at + 1 :]
    if kind == "zero":
        return before + bytes(min(length, len(after))) + behind
    return {"remove": before + behind, "insert": before + noise + after, "end": content + noise}[kind]


def edited_json(value: Any, seed: int, count: int) -> Iterator[tuple[str, Any]]:
    """(what was done, changed copy): odd values at random places, keys removed, renamed and added, another top."""
    draw = random.Random(seed)
    for odd in (None, [], {}, 3, "text"):
        yield f"whole = {odd!r}", odd
    places = list(_places(value))
    for number in range(max(0, count - 5)):
        changed = copy.deepcopy(value)
        path = draw.choice(places)
        parent = changed
        for key in path[:-1]:
            parent = parent[key]
        where = ".".join(map(str, path))
        kind = draw.choice(["odd", "odd", "odd", "remove", "rename"])
        if kind == "odd" or not isinstance(parent, dict):
            odd = draw.choice(ODD)
            parent[path[-1]] = copy.deepcopy(odd)
            yield f"{number} {where} = {odd!r}"[:120], changed
        elif kind == "remove":
            del parent[path[-1]]
            yield f"{number} {where} removed", changed
        else:
            parent[f"{path[-1]}x"] = parent.pop(path[-1])
            yield f"{number} {where} renamed", changed


def _places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield (*path, key)
        yield from _places(inner, (*path, key))


def as_json(value: Any) -> bytes:
    """JSON, also of values that JSON proper has not (NaN, lone surrogates)."""
    return json.dumps(value).encode()
