"""Seeded edits of files, and what an entry point makes of them: one line with a documented code, or something worse.

    outcomes = [attempt(name, lambda: read(write(changed))) for name, changed in edited_json(state, seed=0, count=60)]
    judge("checkpoints", outcomes)

`attempt` calls in this process (fast: hundreds a second); `attempt_process` runs a real `python -m`. Both give an
`Outcome`; `judge` prints a line of counts and fails for tracebacks, hangs, other codes and errors of several lines.
"""

from __future__ import annotations

import copy
import json
import random
import signal
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from pipeline.common.errors import UserError

ROOT = Path(__file__).resolve().parents[2]
CODES = frozenset({2, 3})  # usage or config, data
ODD: tuple[Any, ...] = (
    None, True, False, -1, 0, 1, 10**9, 10**400, 0.5, -0.0, float("nan"), float("inf"), "", "x", "nul\0byte", "\n",
    "../../x", "/etc/passwd", "x" * 5000, "\x1b[31m", "\udcff", [], [1], [[]], {}, {"a": 1}, "1", "1e400",
)  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """What became of one edited input. `kind`: refused, accepted, traceback, hang, "code ..." or "lines"."""

    name: str
    kind: str
    told: str = ""


class _Hang(BaseException):
    """The time limit; no handler of `Exception` may swallow it."""


def attempt(name: str, action: Callable[[], object], codes: Collection[int] = CODES, limit: float = 20.0) -> Outcome:
    """Calls `action`, which should raise a `UserError` of one of `codes` with one printable line, or work."""

    def ring(number: int, frame: FrameType | None) -> None:
        raise _Hang

    alarm = threading.current_thread() is threading.main_thread()
    former = signal.signal(signal.SIGALRM, ring) if alarm else None
    if alarm:
        signal.setitimer(signal.ITIMER_REAL, limit)
    try:
        action()
        return Outcome(name, "accepted")
    except UserError as error:
        return judged(name, error.exit_code, str(error), codes)
    except _Hang:
        return Outcome(name, "hang", f"more than {limit} s")
    except Exception as error:
        return Outcome(name, "traceback", f"{type(error).__name__}: {error}")
    finally:
        if alarm:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, former)


def attempt_process(
    name: str, arguments: Sequence[str], codes: Collection[int] = CODES, limit: float = 120.0
) -> Outcome:
    """`python -m ARGUMENTS` in a process of its own; accepted where it ends with 0."""
    try:
        done = subprocess.run(
            [sys.executable, "-m", *arguments],
            capture_output=True,
            text=True,
            errors="replace",
            timeout=limit,
            cwd=ROOT,
        )
    except subprocess.TimeoutExpired:
        return Outcome(name, "hang", f"more than {limit} s")
    if "Traceback" in done.stderr:
        return Outcome(name, "traceback", done.stderr[-1000:])
    last = (done.stderr.strip() or "nothing told").split("\n")[-1]
    return Outcome(name, "accepted") if done.returncode == 0 else judged(name, done.returncode, last, codes)


def judged(name: str, code: int, told: str, codes: Collection[int] = CODES) -> Outcome:
    """The outcome of a run that ended with an error of its own."""
    if code not in codes:
        return Outcome(name, f"code {code}", told)
    return Outcome(name, "refused" if told and told.isprintable() else "lines", told)


def judge(what: str, outcomes: Sequence[Outcome], harmless: Callable[[str], bool] = lambda name: False) -> None:
    """Prints the counts and fails where anything but a refusal came, or an acceptance that is not `harmless(name)`."""
    counts = Counter(outcome.kind for outcome in outcomes)
    print(f"{what}: {len(outcomes)} edits: {', '.join(f'{count} {kind}' for kind, count in counts.most_common())}")
    good = {"refused"}
    wrong = [o for o in outcomes if o.kind not in good and not (o.kind == "accepted" and harmless(o.name))]
    assert not wrong, "\n".join(f"{o.name}: {o.kind}: {o.told[:300]!r}" for o in wrong[:20])


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
