"""A trial of a run (`jobs.train --fast_dev_run`): two small steps and one small validation, and all that a run writes.

Invariant: a trial has a folder, and so an MLflow run, of its own name, which the next trial of that name replaces; the
run that it tries is never touched.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

from pipeline.common.errors import UsageError
from pipeline.config import RunConfig
from pipeline.distributed import on_rank_0, world_size
from pipeline.training.records.run_folder import state_of
from pipeline.training.trainer import Outcome, check_batch, train

SUFFIX = "-fast-dev-run"
STEPS = 2
PLACES = 2  # of each process; fewer hold no negatives
QUERIES = 8  # of each validation set, and as many database images


def small(config: RunConfig, processes: int) -> RunConfig:
    """The run made small, in all that costs time and changes no code path."""
    places = min(config.data.places_per_batch, PLACES * processes)
    return replace(
        config,
        name=config.name + SUFFIX,
        data=replace(config.data, places_per_batch=places),
        train=replace(
            config.train, epochs=1, steps=STEPS, log_every=1, save_every=1, validate_first=False, resume="never"
        ),
        tracking=replace(config.tracking, register=None),
        validate=replace(config.validate, bank=min(config.validate.bank, QUERIES)),
    )


def try_out(config: RunConfig, accelerator: Any) -> Outcome:
    """Trains a trial of `config`. Collective.

    Raises:
        UsageError, DataError: what would stop the run itself.
    """
    check_batch(config, 1)  # the batch that the run itself would have
    tried = small(config, world_size())
    run = Path(tried.output) / tried.name

    def clear() -> None:
        if state_of(run) == "running":
            raise UsageError(f"{run}: another trial runs in this folder; wait for it, or choose another --name")
        if run.exists():
            shutil.rmtree(run)

    on_rank_0(clear, what=f"removing the former trial {run}")
    return train(tried, accelerator, queries=QUERIES)
