"""Progress: a live display on a terminal, plain lines elsewhere; the time that is left."""

from __future__ import annotations

import io
import sys
import threading

import pytest

from pipeline.common import progress
from pipeline.common.progress import Progress, duration


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """A clock that a test moves."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_plain_lines_tell_rate_and_time_left(clock: list[float], capsys: pytest.CaptureFixture[str]) -> None:
    with Progress("epoch 2", 300, "steps") as bar:
        bar.resume_at(100)
        clock[0] += 5
        bar.advance(5, "loss 0.9")  # too soon for a line
        clock[0] += 5
        bar.advance(5, "loss 0.8")
        clock[0] += 190
        bar.advance(190)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "epoch 2: 110/300 steps, 1.0 a second, 3 min 10 s left  loss 0.8"
    assert lines[1:] == ["epoch 2: 300/300 steps, 1.0 a second"] * 2


def test_a_terminal_has_one_live_display_and_no_thread(clock: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "80")
    threads = threading.active_count()
    with Progress("epoch 1", 10, "steps") as bar:
        clock[0] += 1
        bar.advance(2, "loss 0.7  R@5 61.0")
        assert threading.active_count() == threads
        with Progress("validating", 50, "images") as inner:  # not a second display
            clock[0] += 10
            inner.advance(20)
    told = terminal.getvalue()
    assert "epoch 1: 2/10 steps, 2.0 a second, 4 s left  loss 0.7  R@5 61.0" in told and "\x1b[" in told
    assert "validating: 20/50 images" in told
    assert Progress._live is None
    with Progress("next", None) as bar:
        clock[0] += 1
        bar.advance(3)
    assert "next: 3 it, 3.0 a second" in terminal.getvalue()


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.2, "0 s"), (59.4, "59 s"), (60, "1 min"), (150, "2 min 30 s"), (12_000, "3 h 20 min"), (187_200, "2 d 4 h")],
)
def test_durations_have_two_units(seconds: float, words: str) -> None:
    assert duration(seconds) == words
