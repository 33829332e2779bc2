"""A table from its name to its numbers: what it needs, what is missing, what it costs, and filling it.

Invariant: every number of a filled table comes from an evaluation on disk or in MLflow that belongs to exactly the
settings shown beside it; a row that could not be filled says why.
"""

from __future__ import annotations

import dataclasses
import statistics
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.common.errors import DataError, Diverged
from pipeline.config import EvaluationConfig, RunConfig
from pipeline.evaluation.protocol import Protocol
from pipeline.evaluation.sets.evaluation_set import EvaluationSet
from pipeline.evaluation.sets.load import sets_there
from pipeline.evaluation.sets.registry import published_name
from pipeline.model.weights.where import HUB
from pipeline.paper.plan import Cell, Training, distinct, evaluation, own_settings, training
from pipeline.paper.recorded import recorded, recorded_speed
from pipeline.paper.rows import Row, Table
from pipeline.paper.runner import Recalls, Runner


@dataclass
class Study:
    """A table over a base configuration.

    Attributes:
        name, table: which.
        cells: row x seed x set, in the table's order.
        sets: those that are there, `Cell.set_name` -> set.
        missing: what is not there, one line each: sets, shards, weights.
        settings: row -> what it varied here where its name does not say it.
        notes: row -> why it has no numbers, or not all.
        uses: (row, name of a training it needs).
        values: filled in by `fill`: (row, short name of the set, protocol name) -> N -> Recall@N for each seed.
        protocols: filled in by `fill`: (row, `Cell.set_name`) -> grouping -> the protocol its values were measured
            under, without the digest of a bank, of which each training has its own.
    """

    name: str
    table: Table
    seeds: tuple[int, ...]
    runner: Runner
    cells: list[Cell] = field(default_factory=list)
    trainings: list[Training] = field(default_factory=list)
    sets: dict[str, EvaluationSet] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)
    settings: dict[str, str] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)
    uses: list[tuple[str, str]] = field(default_factory=list)
    values: dict[tuple[str, str, str], dict[int, list[float]]] = field(default_factory=dict)
    protocols: dict[tuple[str, str], dict[str, Protocol]] = field(default_factory=dict)

    def fill(self, run: bool = True) -> None:
        """Trains and evaluates what is missing (`run`), then collects the values.

        Raises:
            Preempted, StepFailed: a child was stopped or failed; what is done is kept.
        """
        for each in self.trainings:
            cells = [cell for cell in self.cells if cell.training.name == each.name and not cell.impossible]
            cells = list({cell.key: cell for cell in cells}.values())
            known = {cell.key: found for cell in cells if (found := self.runner.results(cell)) is not None}
            lacking = [cell for cell in cells if cell.key not in known]
            if lacking:
                known |= recorded(each, lacking, self.sets)
                lacking = [cell for cell in lacking if cell.key not in known]
            if lacking and run:
                try:
                    self.runner.train(each)
                    self.runner.measure(each, lacking)
                    known |= {c.key: found for c in lacking if (found := self.runner.results(c)) is not None}
                except Diverged as error:  # the other rows are worth having all the same
                    print(f"{each.name}: {error}", file=sys.stderr, flush=True)
                    for cell in cells:
                        self.notes[cell.row] = f"seed {each.config.seed} diverged"
            for cell in self.cells:
                if cell.training.name == each.name and cell.key in known:
                    self._take(cell, known[cell.key])

    def _take(self, cell: Cell, recalls: Recalls) -> None:
        for (name, protocol), values in recalls.items():
            for k, value in values.items():
                self.values.setdefault((cell.row, name, protocol.name), {}).setdefault(k, []).append(value)
            known = self.protocols.setdefault((cell.row, cell.set_name), {})
            known[protocol.groups] = dataclasses.replace(protocol, bank_digest="")

    def images_to_train(self) -> int | None:
        """Of the trainings not finished, at most; None while shards are missing."""
        todo = [each.images for each in self.trainings if self.runner.status(each) != "finished"]
        return None if any(images is None for images in todo) else sum(images for images in todo if images)

    def measured_speed(self) -> float | None:
        """Images a second: the median over this table's trainings in MLflow, None where none is recorded."""
        found = [speed for each in self.trainings if (speed := recorded_speed(each)) is not None]
        return statistics.median(found) if found else None

    def images_to_describe(self) -> int:
        """Of the evaluations not on disk: each training describes each set once."""
        todo = {(c.training.name, c.set_name) for c in self.cells if not c.impossible and not self.runner.results(c)}
        return sum(len(self.sets[name].database) + len(self.sets[name].queries) for _, name in todo)


def build(
    name: str,
    table: Table,
    base: RunConfig,
    evaluate: EvaluationConfig,
    seeds: Sequence[int],
    runner: Runner,
    shards: dict[str, str] | None = None,
    resnet_weights: str | None = None,
) -> Study:
    """The study of a table: nothing is trained or written.

    Args:
        base: sizes, data, training; `jobs/configs/paper.yaml` for the paper's.
        evaluate: its `sets` (those of the table by default) and everything rows do not say.
        seeds: a training each.
        shards: option name -> training data, for rows that need their own.
        resnet_weights: for rows on a residual network; None: random weights.
    """
    study = Study(name, table, tuple(dict.fromkeys(seeds)), runner)
    study.sets, study.missing = sets_there(evaluate.sets or table.sets, evaluate)
    _weights(study, base)
    for label, row in table.rows.items():
        own = (shards or {}).get(row.needs, "")
        if row.needs and not own:
            study.notes[label] = f"left out: give its training data with --{row.needs}"
            continue
        for seed in study.seeds:
            found = training(base, row, seed, lambda config: _steps_per_epoch(study, config), own, resnet_weights)
            study.trainings.append(found)
            study.uses.append((label, found.name))
            for set_name, loaded in study.sets.items():
                cell = _cell(label, row, found, set_name, loaded, evaluate)
                study.cells.append(cell)
                if cell.impossible:
                    study.notes[label] = cell.impossible
                study.settings[label] = own_settings(row, found, base, cell.config)
            backbone = found.config.model.backbone
            if backbone.name.startswith("resnet") and backbone.weights is None:
                study.notes.setdefault(label, "a residual network from random weights; give --resnet_weights")
            study.settings.setdefault(label, own_settings(row, found, base, None))
    # several PCAs of the same images: described once, kept until all are done
    if any(row.pca for row in table.rows.values()) and evaluate.store == "none":
        study.cells = [
            dataclasses.replace(cell, config=dataclasses.replace(cell.config, store="fp32")) for cell in study.cells
        ]
    # seed after seed: all rows have one figure before any has two
    study.trainings = sorted(distinct(study.trainings), key=lambda each: study.seeds.index(each.config.seed))
    return study


def _cell(
    label: str, row: Row, found: Training, set_name: str, loaded: EvaluationSet, evaluate: EvaluationConfig
) -> Cell:
    dim = _descriptor_dim(found.config) if row.pca else 0
    config = evaluation(row, evaluate, set_name, published_name(loaded.name) or loaded.name, dim)
    impossible = ""
    if config.pca and not config.pca_from and config.pca > len(loaded.database):
        impossible = f"PCA {config.pca} needs as many images; {loaded.name} has a database of {len(loaded.database):,}"
    return Cell(label, found, set_name, config, impossible)


def _weights(study: Study, base: RunConfig) -> None:
    weights = base.model.backbone.weights
    if weights and not weights.startswith(HUB) and not Path(weights).expanduser().exists():
        study.missing.append(f"{weights}: the backbone's weights are not there")


_STEPS: dict[object, int] = {}
_DIMENSIONS: dict[tuple[object, int | str], int] = {}


def _steps_per_epoch(study: Study, config: RunConfig) -> int | None:
    from pipeline.data.plan import plan
    from pipeline.data.shard_sets import open_shards

    data = config.data
    key = (data.shards, data.shard_weights, data.places_per_batch, data.order, data.window_shards)
    if key not in _STEPS:
        try:
            index = open_shards(data)
        except DataError as error:
            if str(error) not in study.missing:
                study.missing.append(str(error))
            return None
        _STEPS[key] = len(plan(index, 0, 0, data.places_per_batch, data.order, data.window_shards).batches)
    return _STEPS[key]


def _descriptor_dim(config: RunConfig) -> int:
    """Of the model that a configuration builds; its weights do not matter and are not read."""
    from pipeline.model.vpr import build_model

    model = dataclasses.replace(config.model, backbone=dataclasses.replace(config.model.backbone, weights=None))
    key = (model, config.data.image_size)
    if key not in _DIMENSIONS:
        _DIMENSIONS[key] = build_model(model, config.data.image_size).descriptor_dim
    return _DIMENSIONS[key]
