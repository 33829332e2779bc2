"""Train one run, or continue it: accelerate launch --config_file jobs/accelerate/ddp.yaml -m jobs.train --config FILE

Also runs without the launcher, in one process: `python -m jobs.train --config FILE --data.places_per_batch 16`.
The same command continues a run that was killed. `--dry-run` prints the plan and exits. Exit codes: `common.errors`;
note that `accelerate launch` itself turns any of them but 0 into 1, so `<run>/status.json` tells them too.
"""

from __future__ import annotations

import dataclasses
import json
import os
from dataclasses import dataclass
from pathlib import Path

from jobs.cli import parse, run_job
from pipeline.common.errors import UserError
from pipeline.config import RunConfig, to_dict


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
            import yaml

            print(yaml.safe_dump(to_dict(config), sort_keys=False), flush=True)
        if job.dry_run:
            from pipeline.training.dry_run import preview, show

            if first:
                print(show(preview(config)))
            return
        train(config, accelerator, first)


def train(config: RunConfig, accelerator: object, first: bool) -> None:
    """Runs the trainer; writes `status.json` beside the checkpoints, whatever happens."""
    from pipeline.training.trainer import Trainer

    status = {"exit_code": 1, "message": "ended by an unexpected error"}
    try:
        outcome = Trainer(config, accelerator).fit()
        state = outcome.state
        message = f"{outcome.reason}: step {state.step}, epoch {state.epoch}"
        if state.best is not None:
            message += f", best R@5 {state.best:.2f} at step {state.best_step}"
        status = {"exit_code": 0, "message": message}
        if first:
            print(f"{outcome.run}: {message}", flush=True)
    except UserError as error:
        status = {"exit_code": error.exit_code, "message": str(error)}
        raise
    finally:
        run = Path(config.output) / config.name
        if first and run.is_dir():
            temporary = run / f".status-{os.getpid()}"
            temporary.write_text(json.dumps(status, indent=1) + "\n")
            temporary.replace(run / "status.json")


if __name__ == "__main__":
    run_job(main)
