"""Errors that a person caused and can mend, each with the exit code a scheduler sees.

Invariant: whoever raises one of these has written the whole message for the user - what was found, in which
file, what to do - because the jobs print it as one line, without a traceback (`jobs.run_job`).
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from pathlib import Path

from pipeline.common.text import message


class UserError(Exception):
    """Base of the errors shown as one line; `exit_code` becomes the status of the process.

    Its text is one printable line of bearable length, whatever names and values it quotes (`text.message`).
    """

    exit_code = 2

    def __str__(self) -> str:
        return message(super().__str__())


class UsageError(UserError):
    """The command line or the configuration asks for something that cannot be (exit code 2)."""


class DataError(UserError):
    """Data is missing, broken or not what its manifest says (exit code 3)."""

    exit_code = 3


class Diverged(UserError):
    """The loss is not finite, agreed over all ranks (exit code 4)."""

    exit_code = 4


class Preempted(UserError):
    """A signal asked to stop; everything is saved and the job should be requeued (exit code 75)."""

    exit_code = 75


class Interrupted(UserError):
    """Ctrl-C; everything is saved and the same command continues (exit code 130)."""

    exit_code = 130


class Unexpected(UserError):
    """Another rank met an error that no user can mend; its traceback stands with that rank's messages (exit code 1)."""

    exit_code = 1


def tell_launcher(line: str) -> None:
    """Leaves the error for torch's launcher (torchrun, accelerate), which ends with a summary of the failed ranks.

    The file and its form are those of `torch.distributed.elastic.multiprocessing.errors`; without a launcher, nothing.
    """
    file = os.environ.get("TORCHELASTIC_ERROR_FILE")
    if not file:
        return
    told = {"message": {"message": line, "extraInfo": {"timestamp": str(int(time.time()))}}}
    with contextlib.suppress(OSError):  # the line stands on stderr in any case
        Path(file).write_text(json.dumps(told))


_LIBRARIES = (
    "safetensors",
    "safetensors_rust",
    "pyarrow",
)  # they wrap a full disk or a broken file in errors of their own
_MISUSE = (TypeError, KeyError, IndexError, NotImplementedError)


def told(error: BaseException, what: str = "") -> UserError | None:
    """The one-line `UserError` for what a user can mend; None for an error of the program.

    A full disk, a folder without permission, a read-only file system, an unreadable file and too little memory are
    `DataError`, with the file where the error knows it and `what` was being done where it does not.
    """
    if isinstance(error, UserError):
        return error
    if isinstance(error, OSError) and not isinstance(error, (ConnectionError, TimeoutError, ChildProcessError)):
        reason = error.strerror or str(error).splitlines()[0] if str(error) else type(error).__name__
        named = f"{error.filename}: {reason}" if error.filename is not None else reason
        if error.filename is not None and what and str(error.filename) in what:
            named = reason
        return DataError(f"{what}: {named}" if what else named)
    library = type(error).__module__.split(".")[0] in _LIBRARIES and not isinstance(error, _MISUSE)
    if isinstance(error, MemoryError) or library:
        reason = "out of memory" if isinstance(error, MemoryError) else str(error).splitlines()[0]
        return DataError(f"{what}: {reason}" if what else reason)
    return None
