"""How fast are the parts and the whole here? python -m jobs.benchmark [--size vitb] [--full]

Everything is compared within this run, way against way in turn, because machines differ and are busy. `--memory` counts
and measures the memory of a step against the batch, `--precision` the errors of half precision; both instead of times.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from jobs.cli import parse, run_job
from pipeline.common.errors import UsageError

MEMORY = {"demo": (72, 288, 1152), "vitb": (8, 32, 288), "tiny": (8, 32)}


@dataclass(frozen=True)
class BenchmarkJob:
    """Times, as ratios within one run."""

    size: Literal["demo", "vitb", "tiny"] = "demo"
    """Model and images: the demo's (112 px), the paper's (ViT-B/14, 224 px), or one that proves that it runs."""
    parts: tuple[Literal["data", "step", "ranks"], ...] = ("data", "step", "ranks")
    """What is timed: reading of images, the training step and inference, the work of several ranks."""
    full: bool = False
    """More rounds and images, and torch.compile; minutes instead of one."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where steps are computed; auto takes a GPU where there is one."""
    memory: bool = False
    """Print the memory of a step against the batch instead."""
    memory_limit_gb: float = 6.0
    """memory: steps whose counted peak stays below (in 10^9 bytes) are also run, in fresh processes, on the CPU."""
    precision: bool = False
    """Print the errors of float32, bf16 and fp16 against float64 instead."""


def main() -> None:
    """Parses, measures, prints."""
    job = parse(BenchmarkJob, __doc__ or "", config_file=False)
    import torch

    from pipeline.benchmark import timing
    from pipeline.benchmark.sizes import SIZES

    if job.device == "cuda" and not torch.cuda.is_available():
        raise UsageError("device cuda: there is no GPU that torch can use here; leave device out")
    device = torch.device("cuda" if torch.cuda.is_available() and job.device != "cpu" else "cpu")
    size = SIZES[job.size]
    images = size.images_gpu if device.type == "cuda" else size.images
    print(timing.machine(device), flush=True)
    if job.memory:
        from pipeline.benchmark import memory

        print(memory.measure(job.size, MEMORY[job.size], job.memory_limit_gb * 1e9))
    elif job.precision:
        from pipeline.benchmark import precision

        print(precision.show(precision.compare(size, min(images, 32), device)))
    else:
        print(timing.show(times(job, device, images)))


def times(job: BenchmarkJob, device: Any, images: int) -> list[Any]:
    """The comparisons that were asked for; a part whose packages are not installed is left out, and said."""
    import importlib
    import sys

    from pipeline.benchmark.sizes import SIZES

    size = SIZES[job.size]
    rounds = 9 if job.full else 3
    work = {
        "data": lambda part: part.measure(rounds, 64 if job.full else 24, size.image_size),
        "step": lambda part: part.measure(size, device, rounds, images * (2 if job.full else 1), job.full),
        "ranks": lambda part: part.measure(size, rounds, 288 if job.full else 64),
    }
    found = []
    for name in job.parts:
        module = {"data": "reading"}.get(name, name)
        try:
            part = importlib.import_module(f"pipeline.benchmark.{module}")
        except ModuleNotFoundError as error:
            print(f"{name}: left out, {error.name} is not installed here", file=sys.stderr)
            continue
        found += work[name](part)
    return found


if __name__ == "__main__":
    run_job(main)
