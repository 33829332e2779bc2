"""Imported first by the fork server of the loader workers: the system ends that server together with its trainer.

The server itself looks for its trainer only after its imports, and importing torch takes seconds on a busy machine.
"""

from __future__ import annotations

import contextlib
import ctypes
import signal

PR_SET_PDEATHSIG = 1  # Linux: the signal that a process gets when the thread that started it ends; forks do not have it

with contextlib.suppress(AttributeError, OSError):  # elsewhere it notices later
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
