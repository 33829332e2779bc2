"""The processes that decode: how they start, and which signals they heed.

Invariant: a worker lives exactly as long as its trainer needs it. It starts from a clean server process (never as a
fork of the trainer, whose gloo, NCCL and CUDA threads would not survive one); it ends when the trainer says so or
dies, however it dies; and a SIGTERM or SIGUSR1 that a scheduler sends to the whole job leaves it running, so that the
trainer can finish its step and save.
"""

from __future__ import annotations

import multiprocessing
import multiprocessing.forkserver
import multiprocessing.resource_tracker
import os
import signal
import threading
from multiprocessing.context import BaseContext

SCHEDULERS = {signal.SIGTERM, signal.SIGUSR1}  # what a scheduler sends to all processes of a job


def context() -> BaseContext:
    """The start method: a fork server that has this package and torch loaded once for all workers and epochs.

    The server and Python's resource tracker start with the schedulers' signals blocked, which their children inherit:
    none is lost, since the trainer's own mask is as before afterwards.
    """
    forkserver = multiprocessing.get_context("forkserver")
    forkserver.set_forkserver_preload(["pipeline.data.places"])
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SCHEDULERS)
    try:
        multiprocessing.resource_tracker.ensure_running()  # leaves SIGTERM unblocked
        signal.pthread_sigmask(signal.SIG_BLOCK, SCHEDULERS)
        multiprocessing.forkserver.ensure_running()  # it loads torch while the trainer builds its model
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return forkserver


def start_worker(_: int) -> None:
    """Runs in each worker first: one thread, and the guard that ends the worker."""
    import torch

    torch.set_num_threads(1)
    # blocked in all threads, so that the guard alone receives them and can see who sent them
    signal.pthread_sigmask(signal.SIG_BLOCK, SCHEDULERS)
    threading.Thread(target=_guard, name="guard", daemon=True).start()


def _guard() -> None:
    trainer = multiprocessing.parent_process()
    assert trainer is not None  # a worker is always started by one
    while trainer.is_alive():
        received = signal.sigtimedwait(SCHEDULERS, 1.0)
        if received is not None and (received.si_signo, received.si_pid) == (signal.SIGTERM, trainer.pid):
            break
    os._exit(0)
