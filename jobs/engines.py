"""How far each engine is from one process, measured: python -m jobs.engines [--engines '[ddp,zero2]'] [--processes 2]

Launches every engine for three SGD steps of a small model (`pipeline.training.engine_parity`) and prints the largest
relative difference of any tensor's averaged gradient, and of the weights after the steps, from the same steps in one
process in float64. Runs on CPU or GPUs, whichever `accelerate launch` finds; minutes on two cores.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from jobs.cli import parse, run_job
from pipeline.common.errors import UsageError

CONFIGS = Path(__file__).parent / "accelerate"
# DeepSpeed keeps its master weights in float32, whatever it is given
PRECISIONS = {"ddp": ("float64", "float32"), "fsdp2": ("float64", "float32")}


@dataclass(frozen=True)
class EnginesJob:
    """Compare engines with one process."""

    engines: tuple[str, ...] = ("ddp", "fsdp2", "zero1", "zero2", "zero3")
    """Names of files in jobs/accelerate."""
    processes: int = 2
    """Ranks of each launch."""
    train: Literal["adapters", "full", "frozen", "last"] = "full"
    """What of the backbone is trained."""
    encode_chunk: int | None = None
    """Images encoded at a time, as train.encode_chunk; none: all at once."""
    passes: Literal["group", "joint"] = "group"
    """Descriptions of each image, as train.passes."""
    write: str | None = None
    """Set by this job for its own launches: measure, and write the tensors there."""
    dtype: str = "float64"
    """Type of a single measurement."""


def main() -> None:
    """Measures in a launched process; otherwise launches and prints the table."""
    job = parse(EnginesJob, __doc__ or "", config_file=False)
    if job.write is not None:
        _measure(job, job.write)
        return
    from safetensors.torch import load_file

    from pipeline.training.engine_parity import compare

    with tempfile.TemporaryDirectory() as folder:
        truth = load_file(_launch(job, "single", 1, "float64", Path(folder)))
        print("| engine | numbers | gradients of the first step | weights after three steps | tensors |")
        print("|---|---|---|---|---|", flush=True)
        for engine in job.engines:
            for dtype in PRECISIONS.get(engine, ("float32",)):
                found = load_file(_launch(job, engine, job.processes, dtype, Path(folder)))
                told = compare(truth, found)
                print(f"| {engine} | {dtype} | {told.gradient:.1e} | {told.weight:.1e} | {told.tensors} |", flush=True)


def _launch(job: EnginesJob, engine: str, processes: int, dtype: str, folder: Path) -> Path:
    """One measurement in processes of its own; the file it wrote."""
    file = folder / f"{engine}.{dtype}.safetensors"
    config = CONFIGS / f"{engine}.yaml"
    if not config.exists():
        raise UsageError(f"no engine {engine}: {config} does not exist")
    command = [sys.executable, "-m", "accelerate.commands.accelerate_cli", "launch", "--config_file", str(config)]
    command += ["--num_processes", str(processes), "--mixed_precision", "no", "-m", "jobs.engines"]
    command += ["--write", str(file), "--dtype", dtype, "--train", job.train, "--passes", job.passes]
    command += [] if job.encode_chunk is None else ["--encode_chunk", str(job.encode_chunk)]
    done = subprocess.run(command, capture_output=True, text=True, env={"OMP_NUM_THREADS": "1", **os.environ})
    if done.returncode:
        told = [line for line in done.stderr.splitlines() if line.startswith("jobs.engines:")]
        raise UsageError(f"engine {engine} failed: {told[0] if told else done.stderr[-2000:]}")
    return file


def _measure(job: EnginesJob, file: str) -> None:
    import torch
    from safetensors.torch import save_file

    from pipeline.config import TrainConfig
    from pipeline.training.engine_parity import measure
    from pipeline.training.launch import launched

    with launched(timeout=300.0) as accelerator:
        config = TrainConfig(encode_chunk=job.encode_chunk, passes=job.passes)
        tensors = measure(accelerator, config, getattr(torch, job.dtype), job.train)
        if tensors:
            save_file({name: t.contiguous() for name, t in tensors.items()}, file)


if __name__ == "__main__":
    run_job(main)
