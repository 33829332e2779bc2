"""The start of a distributed job: checks that what was launched is what runs, and ends it cleanly.

Invariant: a process never trains alone while believing it is one of several. Every silent wrong way to launch (two
independent copies, one process instead of two) ends here with exit code 2 and the right command.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from types import FrameType
from typing import Any

import torch
import torch.distributed as dist

from pipeline.common.errors import Interrupted, Preempted, UsageError, UserError, tell_launcher
from pipeline.distributed import is_distributed, lost, open_statistics_group

ADVICE = "start it with --processes N, or: accelerate launch --config_file jobs/accelerate/<engine>.yaml -m jobs.train"


ENDING = 15  # seconds that the end of a failed job may take
ORPHANED = 30.0  # seconds that a rank whose launcher is gone may take to save


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
    _watch_launcher()
    torch.backends.cudnn.allow_tf32 = False  # as torch's matrix products; a training may ask for it (`numerics`)
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
    _check_launcher(accelerator.num_processes)
    open_statistics_group()
    if accelerator.is_main_process:
        on = accelerator.device.type + (f", {dist.get_backend()}" if is_distributed() else "")
        plural = "process" if launched == 1 else "processes"
        print(f"{launched} {plural} ({on}), precision {accelerator.mixed_precision}", file=sys.stderr, flush=True)
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
    """Collects SIGTERM, SIGUSR1 and Ctrl-C in a list that the training loop looks at in each step.

    A second Ctrl-C, a second or more after the first (a launcher may hand on the terminal's), ends at once.
    """
    received: list[int] = []
    pressed: list[float] = []

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if number == signal.SIGINT:
            pressed.append(time.monotonic())
            if pressed[-1] - pressed[0] >= 1.0:
                raise KeyboardInterrupt
            print("interrupted: saving first; Ctrl-C again ends at once", file=sys.stderr, flush=True)

    previous = {number: signal.signal(number, note) for number in (signal.SIGTERM, signal.SIGUSR1, signal.SIGINT)}
    try:
        yield received
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def stop_at(notice: int, saved: str) -> UserError:
    """The end that a signal asks for; `notice` is the largest of all ranks' `notice_of`."""
    if notice == signal.SIGINT:
        return Interrupted(f"interrupted: saved {saved}; the same command continues")
    return Preempted(f"signal {notice}: saved {saved}; start again to continue")


def notice_of(received: list[int]) -> int:
    """The signal a rank received first, 0 for none."""
    return received[0] if received else 0


@contextmanager
def launched(timeout: float) -> Iterator[Any]:
    """`start` around a job's body, and the end of the process group after it, however the body ends.

    A `UserError`, which all ranks raise alike, is raised on rank 0 alone: the others leave with its exit code. Where
    another rank vanished, this one says so in one line and leaves, too.
    """
    accelerator = start(timeout)
    try:
        yield accelerator
    except BaseException as error:
        if is_distributed():  # whatever the end waits for (NCCL, threads, a peer), the process does not outlive it
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(ENDING)
        if (gone := lost(error)) is not None:
            print(gone, file=sys.stderr, flush=True)
            tell_launcher(str(gone))
            sys.exit(gone.exit_code)
        if isinstance(error, UserError) and not accelerator.is_main_process:
            tell_launcher(str(error))
            sys.exit(error.exit_code)
        raise
    finally:
        accelerator.free_memory()  # the caller still holds it, and it holds what it wrapped
        finish()


def finish() -> None:
    """Ends the process group. Models and optimisers must be out of scope: gloo's threads can abort the process at exit
    while something still holds their tensors."""
    gc.collect()
    if dist.is_available() and dist.is_initialized():
        dist.destroy_process_group()


def asked_processes(command: Sequence[str]) -> int | None:
    """The `--num_processes` of a launcher's command line; None where it says none, or is none."""
    if "launch" not in command:
        return None
    words = list(command[command.index("launch") + 1 :])
    for word, following in zip(words, [*words[1:], ""], strict=True):
        if word == "-m" or word.endswith(".py"):
            return None  # what follows belongs to the job
        name, equals, value = word.partition("=")
        if name.replace("_", "-") == "--num-processes":
            number = value if equals else following
            return int(number) if number.isdigit() else None
    return None


def _check_launcher(running: int) -> None:
    """Refuses one process where `accelerate launch` was asked for more: a `distributed_type: NO` in the launcher's
    config file, or in its default at home, starts one without a word. Only Linux tells the launcher's command line."""
    try:
        asked = asked_processes(Path(f"/proc/{os.getppid()}/cmdline").read_text().split("\0"))
    except (OSError, UnicodeDecodeError):
        return
    if asked is not None and asked != running:
        raise UsageError(
            f"accelerate launch was asked for {asked} processes and started {running}: its config file, or the default "
            f"one in the home folder, sets another number (distributed_type: NO?); {ADVICE}"
        )


def _watch_launcher() -> None:
    """Ends this rank when its launcher is gone: first as SIGTERM does (saved), and in any case soon after.

    A launcher killed by SIGKILL tells nobody; its ranks would train on, beside the run that is started again.
    """
    if "TORCHELASTIC_RUN_ID" not in os.environ and "ACCELERATE_DYNAMO_BACKEND" not in os.environ:
        return  # started by a shell or by slurm: its end is not ours
    launcher = os.getppid()

    def watch() -> None:
        while os.getppid() == launcher:
            time.sleep(1.0)
        print("the launcher is gone: saving and leaving", file=sys.stderr, flush=True)
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(ORPHANED)
        os._exit(Preempted.exit_code)

    threading.Thread(target=watch, name="launcher", daemon=True).start()
