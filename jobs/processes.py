"""`--processes N`: the job starts its own processes, through accelerate's launcher, and ends as they end.

As `accelerate launch --config_file FILE --num_processes N -m JOB`, with two differences: mistakes are told before N
processes start, and the job ends with its ranks' exit code and their one error line, without a launcher's traceback.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pipeline.common.errors import Interrupted, Unexpected, UsageError

FILES = Path(__file__).parent / "accelerate"


@dataclass(frozen=True)
class Processes:
    """Processes of the job."""

    processes: int = 1
    """Processes that this command starts on this machine, one a GPU where there are GPUs. 1 starts none, as under
    torchrun, slurm or `accelerate launch`."""
    launcher: str | None = None
    """processes: ddp, fsdp2, zero1, zero2, zero3, cpu, or an accelerate config file; none: ddp (bf16) or, without a
    GPU, cpu."""


def check_processes(job: Processes) -> None:
    """Refuses what cannot be started, or is not what was. Raises `UsageError`."""
    if job.processes < 1:
        raise UsageError(f"processes must be a whole number, at least 1; it is {job.processes}")
    if "WORLD_SIZE" in os.environ:
        if job.processes not in (1, int(os.environ["WORLD_SIZE"])):
            raise UsageError(
                f"--processes {job.processes}, but a launcher started {os.environ['WORLD_SIZE']}; leave --processes out"
            )
    elif job.launcher is not None:
        if job.processes == 1:
            raise UsageError("--launcher goes with --processes, of which at least 2 are needed")
        _file(job.launcher)


def spread(job: Processes, module: str, known: Callable[[], int | None] = lambda: None) -> None:
    """Starts the processes that were asked for and ends with their exit code; returns in a process that is to work.

    Args:
        job: what was asked for, checked.
        module: of the job, such as `jobs.train`; started with the words of this command line.
        known: the exit code that the ranks left on record, asked for where a signal ended the launcher.

    Raises:
        Unexpected: a process was killed.
        SystemExit: the job is over.
    """
    if job.processes == 1 or "WORLD_SIZE" in os.environ:
        return
    from accelerate.commands.launch import launch_command, launch_command_parser
    from torch.distributed.elastic.multiprocessing import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError

    logging.getLogger("torch.distributed").setLevel(logging.CRITICAL)  # it tells again that, and which, rank ended
    words = [
        "--config_file",
        str(_file(job.launcher)),
        "--num_processes",
        str(job.processes),
        "-m",
        module,
        *sys.argv[1:],
    ]
    import torch

    if not torch.cuda.is_available():
        os.environ.setdefault("DS_ACCELERATOR", "cpu")  # DeepSpeed, where it is launched, need not look and warn
    arguments = launch_command_parser().parse_args(words)
    arguments.signals_to_handle = "SIGTERM,SIGINT,SIGHUP,SIGQUIT,SIGUSR1"  # handed on to the ranks, which save
    try:
        launch_command(arguments)
    except ChildFailedError as error:
        number, failure = error.get_first_failure()
        if failure.exitcode < 0:
            raise Unexpected(
                f"rank {number} was ended by {signal.Signals(-failure.exitcode).name} (out of memory?)"
            ) from None
        sys.exit(failure.exitcode)
    except SignalException as stopped:
        code = known()
        sys.exit(code if code is not None else 128 + int(stopped.sigval))
    except KeyboardInterrupt:  # a second Ctrl-C
        sys.exit(Interrupted.exit_code)
    sys.exit(0)


def _file(launcher: str | None) -> Path:
    """The accelerate config file of that name, or at that path."""
    if launcher is None:
        import torch

        launcher = "ddp" if torch.cuda.is_available() else "cpu"
    names = {path.stem: path for path in FILES.glob("*.yaml") if path.stem != "single"}
    if launcher in names:
        return names[launcher]
    if not Path(launcher).is_file():
        raise UsageError(f"--launcher {launcher}: neither a file nor one of {', '.join(sorted(names))}")
    return Path(launcher)
