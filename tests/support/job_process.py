"""A job in a process of its own, forked from the test's: a real process to signal, kill and wait for, without paying
the seconds of importing torch and transformers each time. Launchers and loader workers need a fresh interpreter."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import sys
import time
import traceback
from pathlib import Path

# what jobs import when they need it, imported once, in the parent
IMPORTED = (
    "accelerate", "faiss", "pandas", "pipeline.evaluation.evaluate", "pipeline.training.trainer", "pyarrow.parquet",
    "transformers.models.dinov2.modeling_dinov2",
)  # fmt: skip


class JobProcess:
    """`python -m MODULE ARGUMENTS`, its output in a file."""

    def __init__(
        self, module: str, arguments: list[str], output: Path, environment: dict[str, str] | None = None
    ) -> None:
        for name in (*IMPORTED, module):
            importlib.import_module(name)
        self.output = output
        self._process = multiprocessing.get_context("fork").Process(
            target=_run, args=(module, arguments, output, environment or {})
        )
        self._process.start()

    def alive(self) -> bool:
        return self._process.is_alive()

    def send(self, number: int) -> None:
        assert self._process.pid is not None
        os.kill(self._process.pid, number)

    def wait(self, timeout: float = 120.0) -> int:
        """The exit code (negative: the signal that ended it)."""
        self._process.join(timeout)
        if self._process.is_alive():
            self._process.kill()
            raise AssertionError(f"still running after {timeout} s:\n{self.text()[-3000:]}")
        assert self._process.exitcode is not None
        return self._process.exitcode

    def text(self) -> str:
        """What it has printed, both streams."""
        return self.output.read_text() if self.output.exists() else ""

    def kill_when(self, ready: object, number: int = signal.SIGKILL, timeout: float = 120.0) -> None:
        """Sends a signal as soon as `ready()` is true."""
        self.until(ready, timeout)
        self.send(number)

    def until(self, ready: object, timeout: float = 120.0) -> None:
        """Waits until `ready()` is true."""
        assert callable(ready)
        deadline = time.monotonic() + timeout
        while not ready():
            assert self.alive(), f"it ended by itself:\n{self.text()[-3000:]}"
            assert time.monotonic() < deadline, self.text()[-3000:]
            time.sleep(0.002)


def _run(module: str, arguments: list[str], output: Path, environment: dict[str, str]) -> None:
    import torch

    os.environ.update(environment)
    os.setpgrp()
    descriptor = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    sys.stdout, sys.stderr = os.fdopen(1, "w", buffering=1), os.fdopen(2, "w", buffering=1)
    for number in (signal.SIGTERM, signal.SIGUSR1, signal.SIGINT):
        signal.signal(number, signal.SIG_DFL if number != signal.SIGINT else signal.default_int_handler)
    from accelerate.state import AcceleratorState, PartialState

    AcceleratorState._reset_state(True)  # what an earlier test in the parent launched is not what this process is
    PartialState._reset_state()
    torch.set_num_threads(1)  # OpenMP's threads do not survive a fork; so the search must find one core, too
    os.sched_getaffinity = lambda pid: {0}
    os.environ["OMP_NUM_THREADS"] = "1"
    job = importlib.import_module(module)
    sys.modules["__main__"] = job
    sys.argv = [module, *arguments]
    code: object = 1
    try:
        from jobs.cli import run_job

        run_job(job.main)
    except SystemExit as end:
        code = end.code
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code if isinstance(code, int) else 1)
