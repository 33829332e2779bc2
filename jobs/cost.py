"""What a training step costs one rank as the number of ranks grows: python -m jobs.cost [--config FILE]

Prints a table for W = 1 ... 64 at a fixed number of places a rank (the global batch grows with W): bytes received in
each part of the step, gathered keys and values kept, operations of the forward pass; then what each engine adds for
parameters and gradients. A model (`pipeline.training.cost`), whose bytes a test counts on real ranks.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.cli import parse, run_job
from pipeline.common.text import Table
from pipeline.config import RunConfig


@dataclass(frozen=True)
class CostJob(RunConfig):
    """Model the cost of a step. The settings are those of jobs.train."""

    places_per_rank: int = 72
    """Places on each rank; four images each."""
    worlds: tuple[int, ...] = (1, 2, 4, 8, 16, 32, 64)
    """Numbers of ranks."""
    bf16: bool = False
    """Under bf16 autocast: keys and values travel in two bytes."""


def main() -> None:
    """Builds the model's shapes (no memory), prints both tables."""
    job = parse(CostJob, __doc__ or "")
    import torch

    from pipeline.model.vpr import build_model
    from pipeline.training.cost import engine_wire, step_sizes, table

    with torch.device("meta"):
        model = build_model(job.model, job.data.image_size)
    sizes = step_sizes(model, 4 * job.places_per_rank, 2 if job.bf16 else 4, 2 if job.train.passes == "joint" else 1)
    table(sizes, job.worlds).print()
    print("\nMB received for parameters and gradients, float32:\n")
    head = ["W", "ddp, zero1, zero2", "fsdp2, zero3"]
    engines = [
        [str(w), *(f"{engine_wire(engine, sizes, w) / 1e6:,.0f}" for engine in ("ddp", "fsdp2"))] for w in job.worlds
    ]
    Table(head, engines, left=()).print()


if __name__ == "__main__":
    run_job(main)
