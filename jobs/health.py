"""What this machine, or this container, gives to the jobs: one line, and exit code 2 where something is missing.

python -m jobs.health
docker run --rm IMAGE health
"""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from jobs.cli import parse, run_job
from pipeline.common.cores import available_cores
from pipeline.common.errors import UsageError
from pipeline.common.files import check_writable

SHARED = Path("/dev/shm")  # loader processes pass batches through it
ENOUGH = 1e9  # bytes there, for the loaders of one process


@dataclass(frozen=True)
class HealthJob:
    """Look at processors, GPUs, shared memory and folders."""

    output: str = "outputs"
    """Folder of all runs, which must be writable."""
    gpus: int = 0
    """GPUs that must be there."""


def main() -> None:
    """Prints the line, or raises."""
    job = parse(HealthJob, __doc__ or "")
    check_writable(Path(job.output), "--output")
    import torch

    found = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if found < job.gpus:
        raise UsageError(f"{found} GPUs are visible to torch {torch.__version__}, not {job.gpus}; docker: --gpus all")
    shared = shutil.disk_usage(SHARED).total if SHARED.is_dir() else 0
    small = "" if shared >= ENOUGH else " (loader processes may need more: docker run --shm-size 8g)"
    print(
        f"ok: torch {torch.__version__}, {found} GPUs, {available_cores()} cores, "
        f"{shared / 1e6:,.0f} MB in {SHARED}{small}, {job.output} writable by user {os.getuid()}"
    )


if __name__ == "__main__":
    run_job(main)
