"""Fill a table of the paper: train and evaluate what is missing, and show the paper's figures beside ours.

    python -m jobs.experiment --table ablation_crica --config jobs/configs/paper.yaml --root data --seeds 0,1,2
    python -m jobs.experiment --table kernels --config jobs/configs/paper.yaml --dry_run
    python -m jobs.experiment --table spm --launch "accelerate launch --config_file jobs/accelerate/ddp.yaml"
    python -m jobs.experiment --table sota --released weights/released --root data

The configuration gives sizes and data; each row changes the settings that the paper's table varies. The same command
continues a killed run.
The comparisons `sota` and `challenging` train nothing: they evaluate the released files in a folder, as far as they
are there. Writes `<output>/tables/<table>/table.{md,csv,png}`; a comparison has no picture.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jobs.cli import parse, run_job
from pipeline.common.errors import DataError, UsageError
from pipeline.config import EvaluationConfig, RunConfig


@dataclass(frozen=True)
class ExperimentJob(RunConfig):
    """Fill a table. Every setting of a training is an option too; `name` and `seed` are given by the table."""

    table: str = ""
    """ablation_crica, ablation_adaptation, dimensions, epochs, encoder_layers, train_batch, inference_batch, kernels,
    spm, same_data, sota, challenging, or parts, mined, one_photo (ours; the last two with intervals between rows)."""
    rows: tuple[str, ...] = ()
    """Rows to fill, for example '[group, joint]'; none: all of the table."""
    seeds: tuple[int, ...] = (0,)
    """Train every row with each seed, as `0,1,2`; the table shows mean and standard deviation."""
    sets: tuple[str, ...] = ()
    """Evaluation sets, names or paths; none: those of the paper's table. Missing ones are named and left out."""
    root: str = "data"
    """Folder under which set names are looked up."""
    evaluate: EvaluationConfig = field(default_factory=lambda: EvaluationConfig(recalls=(1, 5, 10), resize="published"))
    """Evaluation settings that a row does not set itself; `sets` and `root` are the options above."""
    launch: str = ""
    """Launcher of trainings and evaluations, such as 'accelerate launch --config_file jobs/accelerate/ddp.yaml'; empty:
    one plain process."""
    pitts30k_shards: str = ""
    """same_data: shards of Pitts30k's training images, for the row that is trained on them."""
    resnet_weights: str | None = None
    """same_data: ImageNet weights of ResNet-50 for NetVLAD, CosPlace, GeM and MixVPR; none: random weights."""
    images_per_second: float | None = None
    """Training speed, for the time estimate of --dry_run; none: the speed of recorded runs of the same rows. sota,
    challenging: images described in a second."""
    released: str = ""
    """sota, challenging: folder of released files. What a file is, its tensors say; its name, whether it is CosPlace
    or EigenPlaces, and whether it was trained on MSLS (msls, mapillary) or Pitts30k (pitts)."""
    dry_run: bool = False
    """Only print rows, trainings, sets, their cost and what is missing."""
    measure: str = ""
    """Internal: a file with the evaluations of one run, which this process carries out."""


def main() -> None:
    """Parses, fills, prints and writes the table."""
    job = parse(ExperimentJob, __doc__ or "")
    if job.measure:
        measure(Path(job.measure), job.train.timeout)
        return
    if not job.table:
        raise UsageError("--table is missing, for example --table ablation_crica")
    if job.table in ("sota", "challenging"):
        compare(job)
        return
    from pipeline.paper.rows import table, with_rows

    wanted_table = with_rows(table(job.table), job.rows) if job.rows else table(job.table)
    from pipeline.paper import paired, study, table_report
    from pipeline.paper.runner import Runner

    base = RunConfig(**{f.name: getattr(job, f.name) for f in dataclasses.fields(RunConfig)})
    wanted = dataclasses.replace(job.evaluate, sets=job.sets, root=job.root)
    runner = Runner(Path(job.output), job.launch)
    shards = {"pitts30k_shards": job.pitts30k_shards}
    filled = study.build(job.table, wanted_table, base, wanted, job.seeds, runner, shards, job.resnet_weights)
    nothing = "" if filled.sets else "no evaluation set of the table is there: give --root or --sets ({})"
    folder = fill(job, filled, table_report.costs, nothing)
    if folder is None:
        return
    compared = list(paired.paired(filled))
    table_report.write(filled, compared, folder)
    table_report.show(filled, compared)
    print(f"\nwritten to {folder}/: table.md, table.csv, table.png")


def compare(job: ExperimentJob) -> None:
    """A comparison over released files: evaluates, prints and writes it."""
    if not job.released:
        raise UsageError(f"--table {job.table} needs --released, the folder of the released files")
    if not Path(job.released).is_dir():
        raise UsageError(f"--released {job.released}: there is no such folder")
    from pipeline.paper import released_table
    from pipeline.paper.runner import Runner

    wanted = dataclasses.replace(job.evaluate, sets=job.sets, root=job.root)
    filled = released_table.build(job.table, Path(job.released), wanted, Runner(Path(job.output), job.launch), job.rows)
    folder = fill(
        job, filled, released_table.costs, "" if filled.cells else "nothing of the table can be evaluated: {}"
    )
    if folder is None:
        return
    released_table.write(filled, folder)
    released_table.show(filled)
    print(f"\nwritten to {folder}/: table.md, table.csv, results/")


def fill(job: ExperimentJob, table: Any, costs: Callable[[Any, float | None], str], nothing: str) -> Path | None:
    """Fills a table of either kind; the folder to write it to, None where only its costs were asked for.

    Args:
        table: has `missing` and `fill()`.
        costs: tells the costs of such a table.
        nothing: the error where nothing of it can be filled, with {} for what is missing; else empty.
    """
    if job.dry_run:
        print(costs(table, job.images_per_second))
        return None
    for line in table.missing:
        print(f"missing: {line}", file=sys.stderr)
    if nothing:
        raise DataError(nothing.format("; ".join(table.missing)))
    table.fill()
    return Path(job.output) / "tables" / job.table


def measure(order: Path, timeout: float) -> None:
    """The evaluations of one trained run, on every process that was launched."""
    from pipeline.paper.measure import measure as carry_out
    from pipeline.training.launch import launched

    with launched(timeout) as accelerator:
        carry_out(order, accelerator)


if __name__ == "__main__":
    run_job(main)
