"""Everything that a table asks of one model, in one go: the model is loaded once, images are described once.

Invariant: collective, with the same results on any number of processes; an evaluation that is on disk already is not
repeated, one that was cut short leaves nothing half-written.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from pipeline.common.files import write_atomically
from pipeline.config import EvaluationConfig, from_dict, recorded, to_dict
from pipeline.distributed import agreed, on_rank_0
from pipeline.evaluation.evaluate import Result, evaluate, projections_from
from pipeline.evaluation.identity import model_digest
from pipeline.evaluation.predictions import save_predictions
from pipeline.evaluation.report import tables
from pipeline.evaluation.sets.evaluation_set import EvaluationSet
from pipeline.evaluation.sets.load import load_set
from pipeline.model.weights.files import checkpoint_file, read_metadata
from pipeline.model.weights.load import load_any
from pipeline.paper.plan import Cell


def folder(run: Path) -> Path:
    """Where a run's results for tables lie, one JSON an evaluation."""
    return run / "tables"


def results_file(run: Path, cell: Cell) -> Path:
    """The results of one evaluation."""
    return folder(run) / f"{cell.key}.json"


def predictions_folder(run: Path, cell: Cell) -> Path:
    """What was answered to each query, for paired intervals between rows."""
    return folder(run) / cell.key


def write_order(
    output: Path, checkpoint: Path, evaluations: Mapping[str, EvaluationConfig], run: Path | None = None
) -> Path:
    """The evaluations to do, as a file for `measure`.

    Args:
        output: folder of the results, `<name>.json` for each.
        checkpoint: the model, as `load_any` takes it.
        evaluations: name of the result -> its settings.
        run: whose MLflow run gets the recalls; none: no run does.
    """
    path = output / "order.json"
    told = {
        "output": str(output),
        "checkpoint": str(checkpoint),
        "run": None if run is None else str(run),
        "evaluations": {name: to_dict(config) for name, config in evaluations.items()},
    }
    write_atomically(path, json.dumps(told, indent=1) + "\n")
    return path


def measure(order: Path, accelerator: Any) -> None:
    """Evaluates what `order` lists and writes each result; rank 0 also records the recalls in the run's MLflow run.

    Raises:
        DataError, UsageError: a set or the model cannot be read; the same on all ranks.
    """
    told = agreed(lambda: json.loads(order.read_text()))
    run = None if told["run"] is None else Path(told["run"])
    file, output = agreed(lambda: checkpoint_file(told["checkpoint"])), Path(told["output"])
    beside = output if run is None else file.parent  # a folder of others' files is left as it is
    model = agreed(lambda: load_any(file, accelerator.device), what=f"loading {file}")
    fingerprint = model_digest(model)
    configs = {key: from_dict(EvaluationConfig, values) for key, values in told["evaluations"].items()}
    for key, config in configs.items():
        projections = projections_from(model, config, accelerator.device, beside=beside, fingerprint=fingerprint)
        sets = agreed(partial(_sets, config))
        results = evaluate(model, sets, config, accelerator.device, output, True, projections, fingerprint)
        on_rank_0(
            partial(_keep, run, output / f"{key}.json", file, config, sets, results), what=f"writing into {output}"
        )
    if accelerator.is_main_process:
        # descriptors were kept only so that several PCAs need not describe the images again
        shutil.rmtree(output / "descriptors", ignore_errors=True)


def _sets(config: EvaluationConfig) -> list[EvaluationSet]:
    return [load_set(name, config) for name in config.sets]


def _keep(
    run: Path | None,
    path: Path,
    file: Path,
    config: EvaluationConfig,
    sets: Sequence[EvaluationSet],
    results: Sequence[Result],
) -> None:
    from pipeline.training.records.tracking import record_evaluation

    for result in results:
        save_predictions(result, next(s for s in sets if s.name == result.set_name), path.with_suffix(""))
    temporary = path.with_suffix(".part")
    tables.write_json(results, temporary, {"checkpoint": str(file), "evaluation": recorded(config)})
    values = {name: value for entry in tables.as_dicts(results) for name, value in entry["metrics"].items()}
    if run is not None:
        record_evaluation(run, read_metadata(file)["extra"], values, path.parent)
    temporary.replace(path)
