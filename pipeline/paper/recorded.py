"""What MLflow knows of a table's trainings: their recalls and their speed.

Invariant: only finished runs of exactly a training's name count, and the name carries a digest of the settings; an
evaluation counts only when all its recalls are there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.evaluation.protocol import metric_name, protocols
from pipeline.evaluation.sets.evaluation_set import EvaluationSet
from pipeline.paper.plan import Cell, Training
from pipeline.paper.runner import Recalls
from pipeline.training.records.tracking import open_client, store_uri


def recorded(training: Training, cells: Sequence[Cell], sets: Mapping[str, EvaluationSet]) -> dict[str, Recalls]:
    """Recalls of a finished training, by `Cell.key`: a table can be printed where the run folders are not.

    Metrics have the protocols' names alone, so these are looked for under the names that the configuration gives. A
    bank that turned out smaller than asked for has another name: then nothing is found, and the cell is measured again.

    Args:
        sets: `Cell.set_name` -> the set, whose name and rule stand in metrics.
    """
    metrics = _metrics(training)
    found: dict[str, Recalls] = {}
    for cell in cells:
        recalls: Recalls = {}
        loaded = sets[cell.set_name]
        chosen = protocols(cell.config, training.config.data.image_size, loaded.rule)
        for protocol in chosen:
            names = {k: metric_name(loaded.name, protocol, k) for k in cell.config.recalls}
            values = {k: metrics.get(f"evaluation/{name}") for k, name in names.items()}
            if all(value is not None for value in values.values()):
                recalls[loaded.name, protocol] = {k: float(v) for k, v in values.items() if v is not None}
        if recalls and len(recalls) == len(chosen):
            found[cell.key] = recalls
    return found


def recorded_speed(training: Training) -> float | None:
    """Images a second of a finished training, None where there is none."""
    speed = _metrics(training).get("train/images_per_second")
    return None if speed is None else float(speed)


def _metrics(training: Training) -> dict[str, Any]:
    """The newest finished run's newest metrics, {} where there is none."""
    config = training.config
    uri = store_uri(config.tracking.uri, config.output)
    local = Path(uri.removeprefix("sqlite:///"))
    if not config.tracking.enabled or (uri.startswith("sqlite:///") and not local.is_file()):
        return {}
    client = open_client(uri)
    experiment = client.get_experiment_by_name(config.tracking.experiment)
    if experiment is None:
        return {}
    wanted = f"attributes.run_name = '{training.name}' and attributes.status = 'FINISHED'"
    runs = client.search_runs([experiment.experiment_id], wanted, order_by=["attributes.start_time DESC"])
    return dict(runs[0].data.metrics) if runs else {}
