"""A table's rows over a base configuration -> the trainings they need and what is evaluated on them.

Invariant: a training's name is a function of its settings (and its seed) alone, so rows of any table that need the
same training share it, and trainings with other settings never meet in one run folder.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.common.errors import UsageError
from pipeline.config import EvaluationConfig, ModelConfig, RunConfig, flatten
from pipeline.config.setting import changing
from pipeline.evaluation.report import paper_numbers
from pipeline.model.variants import VARIANTS, variant
from pipeline.paper.rows import DEPTH, DIMENSIONS, EPOCHS, PLACES, Row


@dataclass(frozen=True)
class Training:
    """One training: several rows may need it."""

    name: str
    """Of its run folder and its MLflow run."""
    config: RunConfig
    """Complete, with its seed."""
    steps: int | None
    """Optimiser steps at most; None while the shards are missing."""

    @property
    def images(self) -> int | None:
        """Images trained on at most."""
        return None if self.steps is None else 4 * self.config.data.places_per_batch * self.steps


@dataclass(frozen=True)
class Cell:
    """What a row asks of one training on one set."""

    row: str
    training: Training
    set_name: str
    """As `load_set` takes it."""
    config: EvaluationConfig
    impossible: str = ""
    """Why it cannot be evaluated, where it cannot."""

    @property
    def key(self) -> str:
        """Ten hex digits of the set and everything its recalls depend on: the name of its results."""
        told = {k: v for k, v in flatten(self.config).items() if k in changing(EvaluationConfig, "numbers")}
        return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:10]


def training(
    base: RunConfig,
    row: Row,
    seed: int,
    steps_per_epoch: Callable[[RunConfig], int | None],
    shards: str = "",
    resnet_weights: str | None = None,
) -> Training:
    """The training of a row, with one seed.

    Args:
        base: sizes, data and everything that the row does not say.
        steps_per_epoch: of a configuration; None while it cannot be known.
        shards: the row's own training data.
        resnet_weights: for rows on a residual network, which the base's weights do not fit.
    """
    config = dataclasses.replace(base, seed=seed, model=_model(row, base.model, resnet_weights))
    for key, value in row.changes.items():
        config = changed(config, key, value)
    if shards:
        config = changed(config, "data.shards", shards)
    if row.places is not None:
        config = changed(config, "data.places_per_batch", places(base.data.places_per_batch, row.places))
    each = steps_per_epoch(config)
    if row.epochs is not None:
        config = _lasting(config, base.train.epochs * row.epochs / EPOCHS, each)
    steps = None if each is None else each * config.train.epochs
    if steps is not None and config.train.steps is not None:
        steps = min(steps, config.train.steps)
    # only what is not the default: a field that joins the configuration later changes no name
    default = flatten(RunConfig())
    computed = changing(RunConfig, "numbers") - {"seed"}  # the seed stands in the name
    settings = {k: v for k, v in flatten(config).items() if k in computed and v != default.get(k)}
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:6]
    name = f"{_label(config, base)}-{digest}-seed{seed}"
    return Training(name, dataclasses.replace(config, name=name), steps)


def places(of_base: int, row: int) -> int:
    """The paper's `row` of 72 places in proportion to the base's batch: even, so that two processes can share it."""
    if of_base == PLACES:
        return row
    return of_base if row == PLACES else max(2, 2 * round(of_base * row / PLACES / 2))


def dimensions(of_model: int, row: int) -> int:
    """The paper's `row` of 10752 dimensions in proportion to the model's descriptor."""
    return max(1, round(of_model * row / DIMENSIONS))


def last_blocks(depth: int, row: int) -> int:
    """The variant's `row` trained blocks of the paper's 12, in proportion to a transformer of `depth` blocks."""
    return max(1, round(depth * row / DEPTH))


def evaluation(
    row: Row, base: EvaluationConfig, set_name: str, published: str, descriptor_dim: int
) -> EvaluationConfig:
    """How a row is evaluated on a set.

    Args:
        base: everything the row does not say.
        set_name: as `load_set` takes it.
        published: the set's short name, which tells the paper's inference batch on it.
        descriptor_dim: of the row's model, for PCA in proportion.
    """
    size = row.group if row.group is not None else paper_numbers.group_size(published)
    groups = row.groups or base.groups
    if row.group == 1:
        groups = ("single",)  # a group of one is an image alone, in any order
    elif row.group is not None:
        groups = tuple(group for group in base.groups if group != "single")
    pca = base.pca if row.pca is None else dimensions(descriptor_dim, row.pca)
    return dataclasses.replace(base, sets=(set_name,), group_size=size, groups=groups, pca=pca)


def changed(config: Any, key: str, value: Any) -> Any:
    """A frozen dataclass tree with one dotted setting replaced. Raises `UsageError` for an unknown one."""
    first, _, rest = key.partition(".")
    if not hasattr(config, first):
        raise UsageError(f"unknown setting '{key}' in a row of a table")
    inner = changed(getattr(config, first), rest, value) if rest else value
    return dataclasses.replace(config, **{first: inner})


def own_settings(row: Row, found: Training, base: RunConfig, config: EvaluationConfig | None) -> str:
    """What the row really varied here, where that is not what its name says: "12 places", "PCA 128"."""
    told = []
    if row.places is not None and found.config.data.places_per_batch != row.places:
        told.append(f"{found.config.data.places_per_batch} places")
    model = found.config.model
    if model.last_blocks != variant(row.variant, base.model).last_blocks:
        told.append(f"last {model.last_blocks} of {model.backbone.depth} blocks trained")
    if row.epochs is not None and base.train.epochs != EPOCHS and found.steps is not None:
        told.append(f"{found.steps:,} steps")
    if row.pca is not None and config is not None and config.pca != row.pca:
        told.append(f"PCA {config.pca}")
    return ", ".join(told)


def _lasting(config: RunConfig, epochs: float, steps_per_epoch: int | None) -> RunConfig:
    """The run shortened to `epochs`, which may be a fraction: then counted in steps."""
    whole = max(1, math.ceil(round(epochs, 6)))
    train = dataclasses.replace(config.train, epochs=whole)
    if abs(epochs - whole) > 1e-6 and steps_per_epoch is not None:
        train = dataclasses.replace(train, steps=max(1, round(epochs * steps_per_epoch)))
    return dataclasses.replace(config, train=train)


def _model(row: Row, base: ModelConfig, resnet_weights: str | None) -> ModelConfig:
    """The row's variant; on a residual network of the base's own sizes where the base's backbone has its own."""
    model = variant(row.variant, base)
    if model.backbone.name.startswith("resnet") and model.backbone.name != base.backbone.name:
        name = "resnet_custom" if base.backbone.name == "custom" else model.backbone.name
        model = dataclasses.replace(
            model, backbone=dataclasses.replace(model.backbone, name=name, weights=resnet_weights)
        )
    elif model.backbone.name == "custom" and model.trainable == "last" and base.trainable != "last":
        model = dataclasses.replace(model, last_blocks=last_blocks(model.backbone.depth, model.last_blocks))
    return model


def _label(config: RunConfig, base: RunConfig) -> str:
    parts = [_model_label(config.model, base.model)]
    if config.data.shards != base.data.shards:
        parts.append("other_data")
    if config.data.places_per_batch != base.data.places_per_batch:
        parts.append(f"places{config.data.places_per_batch}")
    if config.data.order != base.data.order:
        parts.append(config.data.order)
    if config.train.passes != base.train.passes:
        parts.append(config.train.passes)
    if config.train.steps != base.train.steps:
        parts.append(f"steps{config.train.steps}")
    elif config.train.epochs != base.train.epochs:
        parts.append(f"epochs{config.train.epochs}")
    return "-".join(parts)


def _model_label(model: ModelConfig, base: ModelConfig) -> str:
    """The first variant that gives this model, else the settings in which it differs from the base."""
    for name in VARIANTS:
        if _model(Row(variant=name), base, model.backbone.weights) == model:
            return name
    before = flatten(base)
    differing = {k: v for k, v in flatten(model).items() if before[k] != v}
    return "-".join(f"{key.rsplit('.', 1)[-1]}_{value}" for key, value in differing.items())


def distinct(trainings: Sequence[Training]) -> list[Training]:
    """Each training once, in order."""
    return list({each.name: each for each in trainings}.values())
