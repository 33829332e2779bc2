"""Train one run, or continue it.

    python -m jobs.train --config FILE --processes 4
    python -m jobs.train --config FILE --data.places_per_batch 16

The same command continues a run that was killed. `--dry_run` prints the plan and exits; `--fast_dev_run` tries
everything in two small steps. Exit codes: 0 done, 2 usage or configuration, 3 data, 4 diverged, 75 preempted and saved,
130 interrupted. torchrun, slurm and `accelerate launch` start it as well; `accelerate launch` and torchrun turn every
code but 0 into 1, and `<run>/status.json` has the true one.
"""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path

from jobs.cli import parse, run_job
from jobs.processes import Processes, check_processes, spread
from jobs.there import need_sets, need_shards, need_weights
from pipeline.config import RunConfig, changed


@dataclass(frozen=True)
class TrainJob(RunConfig, Processes):
    """Train place recognition on the global batch. Every setting is a YAML key and an option."""

    dry_run: bool = False
    """Print the plan (batches, steps, parameters, memory, disk) and exit."""
    fast_dev_run: bool = False
    """Try the run: two small steps, a small validation, and all files, in `<output>/<name>-fast-dev-run`."""


def main() -> None:
    """Parses, trains, says how it ended."""
    job = parse(TrainJob, __doc__ or "")
    check_processes(job)
    config = RunConfig(**{f.name: getattr(job, f.name) for f in dataclasses.fields(RunConfig)})
    need_shards(config.data.shards)
    need_sets(config.validate)
    if not job.dry_run:  # which needs no weights
        need_weights(config.model)
    spread(job, "jobs.train", lambda: recorded_code(job))
    from pipeline.training.launch import launched

    with launched(config.train.timeout) as accelerator:
        first = accelerator.is_main_process
        if first:
            told = [f"  {name}: {value}" for name, value in changed(config, RunConfig()).items()]
            print("\n".join(["settings that differ from the defaults:", *told]), flush=True)
        if job.dry_run:
            from pipeline.training.dry_run import preview, show
            from pipeline.training.initialise import random_and_frozen

            if first and (remark := random_and_frozen(config.model)):
                print(f"warning: {remark}", file=sys.stderr)
            rows = preview(config, accelerator)  # on all ranks: the model's forward pass has collectives
            if first:
                print(show(rows))
            return
        from pipeline.training.trainer import train
        from pipeline.training.trial import STEPS, try_out

        outcome = try_out(config, accelerator) if job.fast_dev_run else train(config, accelerator)
        if first:
            from pipeline.training.records.run_log import FEWEST, draw
            from pipeline.training.records.tracking import record_curves

            picture = draw(outcome.run, STEPS if job.fast_dev_run else FEWEST)
            if picture is not None:
                record_curves(outcome.run, picture)
            print(f"{outcome.run}: {outcome}", flush=True)
            print(where_to_look(outcome.run, picture, outcome.page), flush=True)


def where_to_look(run: Path, picture: Path | None, page: str) -> str:
    """What a run has left, and the command that comes next."""
    rows = {
        "log": run / "train.log",
        "curves": picture,
        "model": run / "checkpoints" / "best",
        "MLflow": page,
        "next": f"python -m jobs.evaluate --checkpoint {run} --sets SETS",
    }
    return "\n".join(f"  {name:<7} {what}" for name, what in rows.items() if what)


def recorded_code(job: TrainJob) -> int | None:
    """The exit code in the run's `status.json`."""
    from pipeline.training.records.run_folder import read_status
    from pipeline.training.trial import SUFFIX

    code = read_status(Path(job.output) / (job.name + SUFFIX * job.fast_dev_run)).get("exit_code")
    return code if isinstance(code, int) else None


if __name__ == "__main__":
    run_job(main)
