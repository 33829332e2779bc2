"""The start of a distributed job: checks that what was launched is what runs, and ends it cleanly.

Invariant: a process never trains alone while believing it is one of several. Every silent wrong way to launch (two
independent copies, one process instead of two) ends here with exit code 2 and the right command.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from types import FrameType
from typing import Any

import torch
import torch.distributed as dist

from pipeline.common.errors import UsageError, UserError
from pipeline.distributed import is_distributed

ADVICE = "launch with: accelerate launch --config_file jobs/accelerate/<engine>.yaml -m jobs.train --config FILE"


def start(timeout: float) -> Any:
    """The Accelerator of this process: gloo on CPU, NCCL on GPUs.

    Args:
        timeout: seconds a collective waits for the other ranks.

    Raises:
        UsageError: the number of processes that runs is not the number that was launched.
    """
    from accelerate import Accelerator, DistributedDataParallelKwargs, InitProcessGroupKwargs

    # Accelerate still says broadcast_buffers, which torch 2.13 renames; and the gradient of a 1x1 convolution has
    # strides that DDP remarks upon once, at no cost here
    warnings.filterwarnings("ignore", message=".*broadcast_buffers.*", category=FutureWarning)
    warnings.filterwarnings("ignore", message="This DataLoader will create .* worker processes")
    warnings.filterwarnings("ignore", message="Grad strides do not match bucket view strides.*")
    # DeepSpeed calls collectives by names that torch 2.13 renames, once a step
    warnings.filterwarnings("ignore", message=".*torch.distributed.*is deprecated", category=FutureWarning)
    cuda = torch.cuda.is_available() and os.environ.get("ACCELERATE_USE_CPU", "false").lower() != "true"
    deepspeed = os.environ.get("ACCELERATE_USE_DEEPSPEED", "false").lower() == "true"
    launched = int(os.environ.get("WORLD_SIZE", "1"))
    waiting = InitProcessGroupKwargs(timeout=timedelta(seconds=timeout))
    if deepspeed and not cuda:
        _deepspeed_on_cpu()
        # without the name DeepSpeed looks for Intel's library and each process ends up alone
        waiting = InitProcessGroupKwargs(backend="gloo", timeout=timedelta(seconds=timeout))
    # the statistics of GlobalBatchNorm are the same on all ranks already: broadcasting them would only cost
    ddp = DistributedDataParallelKwargs(broadcast_buffers=False, gradient_as_bucket_view=True)
    accelerator = Accelerator(
        cpu=not cuda and not deepspeed,  # without it two launched CPU processes are two independent copies
        kwargs_handlers=[waiting, ddp],
    )
    if accelerator.gradient_accumulation_steps != 1:
        raise UsageError(
            "gradient_accumulation_steps must be 1: the loss is over the global batch and not a sum over parts; to "
            "save memory use train.encode_chunk"
        )
    if accelerator.num_processes != launched or (launched > 1) != is_distributed():
        raise UsageError(
            f"{launched} processes were launched but this one is in a group of {accelerator.num_processes}; {ADVICE}"
        )
    if not cuda and (launched > 1 or "OMP_NUM_THREADS" not in os.environ):
        # (launchers set that variable to 1 whatever the machine has)
        local = int(os.environ.get("LOCAL_WORLD_SIZE", launched))
        torch.set_num_threads(max(1, (os.cpu_count() or 1) // max(1, local)))
    return accelerator


def _deepspeed_on_cpu() -> None:
    os.environ.setdefault("DS_ACCELERATOR", "cpu")
    try:
        import deepspeed.ops
    except ImportError as error:
        raise UsageError("launched with DeepSpeed, which is not installed: pip install .[deepspeed]") from error
    # its shared-memory extension is compiled at start-up (a minute, and a compiler); gloo does the same work
    deepspeed.ops.__compatible_ops__["deepspeed_shm_comm"] = False


@contextmanager
def stop_signals() -> Iterator[list[int]]:
    """Collects SIGTERM and SIGUSR1 in a list that the training loop looks at after each step."""
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)

    previous = {number: signal.signal(number, note) for number in (signal.SIGTERM, signal.SIGUSR1)}
    try:
        yield received
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextmanager
def launched(timeout: float) -> Iterator[Any]:
    """`start` around a job's body, and the end of the process group after it, however the body ends.

    A `UserError`, which all ranks raise alike, is raised on rank 0 alone: the others leave with its exit code.
    """
    accelerator = start(timeout)
    try:
        yield accelerator
    except UserError as error:
        if accelerator.is_main_process:
            raise
        sys.exit(error.exit_code)
    finally:
        accelerator.free_memory()  # the caller still holds it, and it holds what it wrapped
        finish()


def finish() -> None:
    """Ends the process group. Models and optimisers must be out of scope: gloo's threads can abort the process at exit
    while something still holds their tensors."""
    gc.collect()
    if dist.is_available() and dist.is_initialized():
        dist.destroy_process_group()
