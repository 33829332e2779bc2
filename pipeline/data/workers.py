"""The processes that decode: how they start, and which signals they heed.

Invariant: a worker lives exactly as long as its trainer needs it. It starts from a clean server process (never as a
fork of the trainer, whose gloo, NCCL and CUDA threads would not survive one); it ends when the trainer says so or
dies, however it dies; and a SIGTERM, SIGUSR1 or Ctrl-C that reaches the whole job leaves it running, so that the
trainer can finish its step and save. A batch that a worker cannot hand over is an error, never a wait without end.
"""

from __future__ import annotations

import multiprocessing
import multiprocessing.forkserver
import multiprocessing.resource_tracker
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.context import BaseContext
from typing import TYPE_CHECKING, Any

from pipeline.common.errors import DataError, UserError

if TYPE_CHECKING:
    from torch import Tensor
    from torch.utils.data import DataLoader

STOPS = {signal.SIGTERM, signal.SIGUSR1, signal.SIGINT}  # what a scheduler or a terminal sends to a whole job
LOOK = 1.0  # seconds between two looks at signals while no batch comes
LOST = 600.0  # seconds without any batch after which it is given up
SHARED = (
    "/dev/shm, through which loader workers hand over their batches, is full or too small: give the container more "
    "(docker run --shm-size 8g), or lower data.workers, data.prefetch or validate.workers (0: no worker processes)"
)


def context() -> BaseContext:
    """The start method: a fork server that has this package and torch loaded once for all workers and epochs.

    The server and Python's resource tracker start with these signals blocked, which their children inherit:
    none is lost, since the trainer's own mask is as before afterwards.
    """
    forkserver = multiprocessing.get_context("forkserver")
    forkserver.set_forkserver_preload(["pipeline.data.fork_server", "pipeline.data.places"])
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPS)
    try:
        multiprocessing.resource_tracker.ensure_running()  # leaves SIGTERM unblocked
        signal.pthread_sigmask(signal.SIG_BLOCK, STOPS)
        multiprocessing.forkserver.ensure_running()  # it loads torch while the trainer builds its model
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return forkserver


def start_worker(_: int) -> None:
    """Runs in each worker first: one thread, and the guard that ends the worker."""
    import torch

    torch.set_num_threads(1)
    # blocked in all threads, so that the guard alone receives them and can see who sent them
    signal.pthread_sigmask(signal.SIG_BLOCK, STOPS)
    threading.Thread(target=_guard, name="guard", daemon=True).start()


def _guard() -> None:
    trainer = multiprocessing.parent_process()
    assert trainer is not None and trainer.pid is not None  # a worker is always started by one
    # its pipe tells of its end, unless a child of its own still holds the other side; its number does then
    while trainer.is_alive() and _exists(trainer.pid):
        received = signal.sigtimedwait(STOPS, 1.0)
        if received is not None and (received.si_signo, received.si_pid) == (signal.SIGTERM, trainer.pid):
            break
    os._exit(0)


def _exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def hand_over(*tensors: Tensor) -> None:
    """In a worker: moves what it is about to give into shared memory. Nothing elsewhere.

    torch would do so in a thread whose errors the trainer never sees: it would wait for the batch for ever.

    Raises:
        DataError: shared memory is full.
    """
    from torch.utils.data import get_worker_info

    if get_worker_info() is None:
        return
    try:
        for tensor in tensors:
            tensor.share_memory_()
    except (RuntimeError, OSError):
        raise DataError(SHARED) from None


def options(workers: int, prefetch: int) -> dict[str, Any]:
    """The arguments of a `DataLoader` whose workers live and die as this module says; read it with `batches`.

    Where there is a GPU, batches come in pinned memory, from which they are copied to it while it computes.
    """
    import torch

    pinned = {"pin_memory": torch.cuda.is_available()}
    if workers == 0:
        return {"num_workers": 0, **pinned}
    return {
        **pinned,
        "num_workers": workers,
        "prefetch_factor": prefetch,
        "multiprocessing_context": context(),
        "worker_init_fn": start_worker,
        "timeout": LOOK,
    }


def batches(loader: DataLoader[Any], stop: Callable[[], bool] = lambda: False) -> Iterator[Any]:
    """A loader's batches; ends early where `stop()` is true while it waits for one.

    Raises:
        DataError: a worker died, shared memory is too small, or no batch came for `LOST` seconds.
    """
    try:
        iterator = iter(loader)
    except OSError as error:  # its queues lie in /dev/shm, too
        raise DataError(f"loader workers cannot be started ({error.strerror}); {SHARED}") from error
    except EOFError as error:
        raise DataError(
            "loader workers cannot be started: the process that starts them died; out of memory?"
        ) from error
    since = time.monotonic()
    while True:
        try:
            batch = next(iterator)
        except StopIteration:
            return
        except UserError as error:  # raised in a worker: torch put its traceback into the text
            text = str(error.args[0]).strip().splitlines()
            raise (type(error)(text[-1].partition(": ")[2]) if text[0].startswith("Caught ") else error) from None
        except RuntimeError as error:
            if "timed out" in str(error) and loader.timeout:
                if stop():
                    return
                if time.monotonic() - since > LOST:
                    raise DataError(f"no batch came from the loader's workers for {LOST:.0f} seconds") from None
                continue
            if "worker" in str(error):  # torch only says that a process went away
                first = str(error).splitlines()[0]
                raise DataError(f"{first}: out of memory, or /dev/shm is full? Lower data.workers") from error
            raise
        yield batch
        since = time.monotonic()
