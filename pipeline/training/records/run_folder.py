"""A run's folder while a training works in it: its lock, and `status.json`, which says how the run stands or ended.

Invariant: one training at a time works in a folder. `status.json` says "running" from the first moment, and how it
ended afterwards; a run that was killed leaves "running" behind, and `state_of` tells the difference by the lock. The
room for its end is taken on the disk from the start, since a full disk may be the cause of that end.
"""

from __future__ import annotations

import errno
import json
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import Any

from pipeline.common.errors import DataError, Diverged, Interrupted, Preempted, UsageError, UserError, told
from pipeline.common.files import locked, write_atomically
from pipeline.distributed import held_on_rank_0, lost, rank, world_size

STATUS, LOCK = "status.json", ".lock"
ROOM = ".room"  # a file of some kB that is removed to write the end of a run that a full disk ended
STOPS = (signal.SIGTERM, signal.SIGUSR1)  # a scheduler's
ENDING = 10.0  # seconds that a former training, told to stop, may take to leave the folder
_STATES = {Diverged: "diverged", Preempted: "preempted", Interrupted: "interrupted"}


@dataclass
class Status:
    """What `status.json` holds.

    Attributes:
        state: running, done, failed, diverged, preempted or interrupted.
        exit_code: None while it runs; a launcher may turn it into another.
        message: for people.
        pid: of rank 0.
        world_size: number of processes.
        started, ended: UTC, ISO 8601.
    """

    state: str = "running"
    exit_code: int | None = None
    message: str = ""
    pid: int = 0
    world_size: int = 1
    started: str = ""
    ended: str = ""

    def end(self, error: BaseException | None) -> None:
        """Fills in how it ended."""
        self.ended = _now()
        if error is None:
            self.state, self.exit_code = "done", 0
            return
        mended = lost(error) or told(error)
        if mended is not None:
            self.state = _STATES.get(type(mended), "failed")
            self.exit_code, self.message = mended.exit_code, str(mended)
        elif isinstance(error, KeyboardInterrupt):
            self.state, self.exit_code, self.message = "interrupted", Interrupted.exit_code, "interrupted"
        else:
            self.state, self.exit_code = "failed", 1
            self.message = f"ended by an unexpected error ({type(error).__name__})"


@contextmanager
def working_in(run: Path) -> Iterator[Status]:
    """Holds a run's folder, made where it is missing, and keeps its `status.json`; rank 0 writes. Collective.

    Raises:
        UsageError: another training works in it, or it cannot be written.
    """
    with held_on_rank_0(lambda: _held(run), what=f"opening the run's folder {run}"):
        status = Status(pid=os.getpid(), world_size=world_size(), started=_now())

        def leave(number: int, frame: FrameType | None) -> None:
            """A signal while there is nothing to save: the training loop has a handler of its own."""
            error = Preempted(f"signal {number} outside of the training steps: nothing to save; start again")
            status.end(error)
            _tell(run, status)
            os._exit(error.exit_code)

        before = {number: signal.signal(number, leave) for number in STOPS}
        try:
            try:
                yield status
                error = None
            except BaseException as raised:
                error = raised
            for number in STOPS:  # a launcher stops its other ranks: this one is ending already
                signal.signal(number, signal.SIG_IGN)
            status.end(error)
            _tell(run, status)
            if error is not None:
                raise error
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def _tell(run: Path, status: Status) -> None:
    """Rank 0 writes; that the file cannot be written does not change how the run ended."""
    if rank() != 0:
        return
    try:
        _write(run / STATUS, status)
    except OSError as error:
        print(f"warning: {run / STATUS} cannot be written: {error}", file=sys.stderr, flush=True)


def read_status(run: Path) -> dict[str, Any]:
    """What `status.json` says, {} where there is none that can be read."""
    try:
        found = json.loads((run / STATUS).read_text())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def state_of(run: Path) -> str:
    """The state in `status.json`, but "killed" where it says running and nobody works there; "" where there is none."""
    state = str(read_status(run).get("state", ""))
    if state != "running" or not (run / LOCK).exists():
        return state
    try:
        with locked(run / LOCK, "at work"):
            return "killed"
    except (UserError, OSError):
        return state


@contextmanager
def _held(run: Path) -> Iterator[None]:
    refusal = f"{run}: another training works in this folder; wait for it, or choose another --name"
    try:
        run.mkdir(parents=True, exist_ok=True)
        lock = locked(run / LOCK, refusal, ENDING)
        lock.__enter__()
    except OSError as error:
        raise _refused(run, error) from error
    try:
        try:
            _write(run / STATUS, Status(pid=os.getpid(), world_size=world_size(), started=_now()))
            (run / ROOM).write_bytes(bytes(16_384))
        except OSError as error:
            raise _refused(run, error) from error
        yield
    finally:
        lock.__exit__(None, None, None)


def _refused(run: Path, error: OSError) -> UserError:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return DataError(f"{run}: {error.strerror}; make room, or choose another --output")
    return UsageError(f"{run}: the run's folder cannot be written ({error.strerror}); choose another --output")


def _write(path: Path, status: Status) -> None:
    """Whole or not at all."""
    path.with_name(ROOM).unlink(missing_ok=True)  # on a full disk, the room for what follows
    data = json.dumps(asdict(status), indent=1) + "\n"
    write_atomically(path, data, path.with_name(f".status-{os.getpid()}"))


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
