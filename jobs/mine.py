"""Describe the places of shards with a trained model, for training in mined order (`data.order: mined`).

    python -m jobs.mine --checkpoint outputs/RUN --shards data/shards --out data/mined.safetensors
    python -m jobs.mine --checkpoint outputs/RUN --out FILE --processes 4
    python -m jobs.train --config FILE --data.order mined --data.mine_from data/mined.safetensors

A training that mines by itself (`data.mine_from: single`) needs no such file. The number of processes changes nothing
but the time.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from jobs.cli import parse, run_job
from jobs.processes import Processes, check_processes, spread
from jobs.there import need_model, need_shards
from pipeline.common.errors import UsageError
from pipeline.config import DataConfig


@dataclass(frozen=True)
class MineJob(Processes):
    """Write one short descriptor a place, which mined batches are planned from."""

    checkpoint: str = ""
    """A run folder (its best checkpoint), a checkpoint folder, a .safetensors file, or a released .pth."""
    out: str = ""
    """File to write, about 0.5 kB per place; an older one is replaced when the new one is complete."""
    shards: tuple[str, ...] | str = "data/shards"
    """The shard set, or the list of sets, that will be trained on: the same ones in the same order."""
    kind: Literal["single", "bank", "permuted"] = "single"
    """single: each image alone; bank: beside the bank that was saved with the weights; permuted: single, shuffled among
    the places of each city, a control."""
    round: int = 0
    """The round of four images that is described."""
    workers: int = 4
    """Decoding processes per rank."""
    cache: str = "data/cache"
    """Local folder for shards fetched from a URL."""
    timeout: float = 1800.0
    """Seconds that a process waits for the others."""


def main() -> None:
    """Parses, describes, writes."""
    job = parse(MineJob, __doc__ or "")
    check_processes(job)
    for name in ("checkpoint", "out"):
        if not getattr(job, name):
            raise UsageError(f"--{name} is missing")
    if job.round < 0:
        raise UsageError(f"--round is {job.round}; rounds are counted from 0")
    data = DataConfig(shards=job.shards, workers=job.workers, cache=job.cache)
    need_model(job.checkpoint)
    need_shards(job.shards)
    spread(job, "jobs.mine")
    from pipeline.training.launch import launched

    with launched(job.timeout) as accelerator:
        run(job, data, accelerator)


def run(job: MineJob, data: DataConfig, accelerator: object) -> None:
    """The work of this process; rank 0 writes."""
    import dataclasses

    from pipeline.data.shard_sets import open_shards
    from pipeline.distributed import agreed, on_rank_0
    from pipeline.evaluation.describe.places import describe_places
    from pipeline.model.weights.load import load_any

    out = Path(job.out)
    device, autocast = accelerator.device, accelerator.autocast  # type: ignore[attr-defined]
    on_rank_0(lambda: out.parent.mkdir(parents=True, exist_ok=True), what=f"making {out.parent}")
    index = agreed(lambda: open_shards(data), what="opening the shards")
    model = agreed(lambda: load_any(job.checkpoint, device), what=f"loading {job.checkpoint}")
    if model.input_size.native:
        raise UsageError(
            f"{job.checkpoint}: takes photos in their own shape (image_size {model.image_size}), but places are "
            "described at one size: write it at one with jobs.weights --image_size"
        )
    data = dataclasses.replace(data, image_size=model.image_size)
    found = describe_places(model, index, data, job.kind, job.round, device, autocast, temporary=out.parent)

    def write() -> None:
        assert found is not None  # on rank 0
        found.save(out)
        print(f"{out}: {len(found.values):,} places x {found.values.shape[1]} numbers, sha256 {found.sha256}")

    on_rank_0(write, what=f"writing {out}")


if __name__ == "__main__":
    run_job(main)
