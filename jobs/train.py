"""Train one run, or continue it: accelerate launch --config_file jobs/accelerate/ddp.yaml -m jobs.train --config FILE

Also runs without the launcher, in one process: `python -m jobs.train --config FILE --data.places_per_batch 16`.
The same command continues a run that was killed. `--dry_run` prints the plan and exits. Exit codes: 0 done, 2 usage
or configuration, 3 data, 4 diverged, 75 preempted and saved, 130 interrupted. `accelerate launch` turns every code
but 0 into 1; `<run>/status.json` has the true one.
"""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass

from jobs.cli import parse, run_job
from pipeline.config import RunConfig, changed


@dataclass(frozen=True)
class TrainJob(RunConfig):
    """Train place recognition on the global batch. Every setting is a YAML key and an option."""

    dry_run: bool = False
    """Print the plan (batches, steps, parameters, memory, disk) and exit."""


def main() -> None:
    """Parses, trains, says how it ended."""
    job = parse(TrainJob, __doc__ or "")
    config = RunConfig(**{f.name: getattr(job, f.name) for f in dataclasses.fields(RunConfig)})
    from pipeline.training.launch import launched

    with launched(config.train.timeout) as accelerator:
        first = accelerator.is_main_process
        if first:
            told = [f"  {name}: {value}" for name, value in changed(config, RunConfig()).items()]
            print("\n".join(["settings that differ from the defaults:", *told]), flush=True)
            if config.model.trainable != "full" and config.model.backbone.weights is None:
                print(
                    "warning: model.backbone.weights is not set, so the part of the backbone that model.trainable "
                    f"'{config.model.trainable}' leaves frozen is random numbers; give it released weights",
                    file=sys.stderr,
                )
        if job.dry_run:
            from pipeline.training.dry_run import preview, show

            rows = preview(config)  # on all ranks: the model's forward pass has collectives
            if first:
                print(show(rows))
            return
        from pipeline.training.trainer import train

        outcome = train(config, accelerator)
        if first:
            from pipeline.training.run_log import draw

            picture = draw(outcome.run)
            print(f"{outcome.run}: {outcome}", flush=True)
            print(f"see {outcome.run / 'train.log'}" + (f" and {picture}" if picture else ""), flush=True)


if __name__ == "__main__":
    run_job(main)
