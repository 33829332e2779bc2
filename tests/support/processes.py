"""Real processes for tests: the same function on W forked gloo ranks, results back in rank order."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import random
import socket
import tempfile
import traceback
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist


def free_port() -> int:
    """A port nobody listens on at this moment, below those that the system gives to clients and to other tests' groups
    until the caller listens."""
    while True:
        port = random.SystemRandom().randrange(10_000, 32_000)
        with socket.socket() as s, contextlib.suppress(OSError):
            s.bind(("127.0.0.1", port))
            return port


def alive(pid: int) -> bool:
    """Whether a process runs (one that waits to be reaped does not)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def run_ranks(function: Callable[..., Any], world: int, *arguments: Any, timeout: float = 120.0) -> list[Any]:
    """Calls `function(*arguments)` on `world` ranks of a gloo group; returns what each returned (torch-saveable).

    Forked, so the function may be local; one thread a rank, as OpenMP does not survive a fork with more.
    """
    with tempfile.TemporaryDirectory() as folder:
        context = multiprocessing.get_context("fork")
        processes = [
            context.Process(target=_rank, args=(function, arguments, r, world, Path(folder))) for r in range(world)
        ]
        for process in processes:
            process.start()
        for process in processes:
            process.join(timeout)
        late = [r for r, process in enumerate(processes) if process.is_alive()]
        for process in processes:
            process.kill()
        errors = [f"rank {r}:\n{p.read_text()}" for r in range(world) if (p := Path(folder) / f"{r}.error").exists()]
        assert not errors, "\n".join(errors)
        assert not late, f"ranks {late} did not finish within {timeout} s"
        return [torch.load(Path(folder) / f"{r}.pt", weights_only=False) for r in range(world)]


def _rank(function: Callable[..., Any], arguments: tuple[Any, ...], r: int, world: int, folder: Path) -> None:
    torch.set_num_threads(1)  # OpenMP's threads do not survive a fork; so a search must find one core, too
    os.sched_getaffinity = lambda pid: {0}
    from accelerate.state import AcceleratorState, PartialState

    AcceleratorState._reset_state(True)  # what an earlier test in the parent launched is not what this process is
    PartialState._reset_state()
    os.environ |= {"RANK": str(r), "LOCAL_RANK": str(r), "WORLD_SIZE": str(world)}
    try:
        dist.init_process_group(
            "gloo", store=dist.FileStore(str(folder / "store"), world), rank=r, world_size=world,
            timeout=timedelta(seconds=60),
        )  # fmt: skip
        torch.save(function(*arguments), folder / f"{r}.pt")
        dist.barrier()
        code = 0
    except BaseException:
        (folder / f"{r}.error").write_text(traceback.format_exc())
        code = 1
    os._exit(code)  # gloo's threads can abort an orderly exit
