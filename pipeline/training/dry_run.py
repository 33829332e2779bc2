"""What a run would be, before it starts: batches, steps, parameters, memory, disk (`jobs.train --dry_run`).

Invariant: nothing is written. Counts are exact; activation memory is measured on one small batch of the real model
(bytes that autograd keeps for backward) and scaled to the run's batch, so it is an estimate and is called one, as is
the time of an epoch (pipeline.training.epoch_time).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from pipeline.common.text import Table, without_passwords
from pipeline.config import RunConfig
from pipeline.data.plan import EpochPlan, plan
from pipeline.data.positions import place_points
from pipeline.data.shard_sets import ShardSets, open_shards
from pipeline.distributed import agreed, world_size
from pipeline.evaluation.search.projection import check_prefix
from pipeline.model.vpr import PlaceModel, build_model, parameter_counts
from pipeline.training.epoch_time import step_time
from pipeline.training.mining import Mining
from shards.index import ShardIndex

# whole copies of the trainable parameters that the optimiser keeps
MOMENTS = {"adam": 2, "adamw": 2, "sgd": 0}


def saved_bytes(model: PlaceModel, images: int, joint: bool = False) -> int:
    """Bytes autograd keeps for the backward of `images` images through encode and correlate, parameters left out."""
    parameters = {p.untyped_storage().data_ptr() for p in model.parameters()}
    seen: dict[int, int] = {}

    def pack(tensor: torch.Tensor) -> torch.Tensor:
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in parameters:
            seen[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        device = next(model.parameters()).device
        keep = model(torch.zeros(images, 3, *model.input_size.largest, device=device), joint=joint)
    del keep
    return sum(seen.values())


def preview(config: RunConfig, accelerator: Any) -> list[tuple[str, str]]:
    """Rows (what, value) of the plan of a run on the accelerator's device. Collective.

    Raises:
        UsageError, DataError: whatever would stop the run at its start.
    """
    index = agreed(lambda: open_shards(config.data), what=f"reading {config.data.shards}")
    data = config.data
    first = plan(index, config.seed, 0, data.places_per_batch, data.order, data.window_shards)
    rows = _plan_rows(config, index, first)
    torch.manual_seed(config.seed)
    shapes = replace(
        config.model, backbone=replace(config.model.backbone, weights=None)
    )  # no file of weights is needed
    model = agreed(lambda: build_model(shapes, config.data.image_size), what="building the model")
    check_prefix(max(config.loss.prefixes, default=None), model.descriptor_dim, "loss.prefixes")
    counts = parameter_counts(model)
    rows += [
        ("descriptor", f"{model.regions} regions x {model.pooling.dim} = {model.descriptor_dim} dimensions"),
        ("parameters", f"{counts['total']:,}: {counts['trainable']:,} trained, "
                       f"{counts['total'] - counts['trainable']:,} frozen"),
    ]  # fmt: skip
    rows += _size_rows(config, model.to(accelerator.device), counts)
    return rows + step_time(config, index, model, accelerator).rows(len(first.batches))


def _plan_rows(config: RunConfig, index: ShardIndex, first: EpochPlan) -> list[tuple[str, str]]:
    data, w = config.data, world_size()
    if config.loss.ignore_within:
        place_points(index, f"loss.ignore_within={config.loss.ignore_within:g}")
    steps = len(first.batches)
    images = 4 * data.places_per_batch
    total = steps * config.train.epochs
    limited = min(total, config.train.steps) if config.train.steps is not None else total
    sets = index.sets if isinstance(index, ShardSets) else (index,)
    given = [f", {share * index.passes:,} an epoch" for share in index.shares] if isinstance(index, ShardSets) else [""]
    return [
        *(
            ("shards", f"{part.root}: {part.places:,} places, {part.rounds} rounds of four images{each}")
            for part, each in zip(sets, given, strict=True)
        ),
        ("global batch", f"{data.places_per_batch} places x 4 = {images} images, order {data.order}"),
        ("processes", f"{w}, {images // w} images each"),
        *(
            [("mining", agreed(lambda: Mining(config, index, Path(config.output))).told())]
            if data.order == "mined"
            else []
        ),
        ("epoch", f"{steps:,} steps; {first.left_over:,} places wait for another epoch"),
        ("run", f"{limited:,} steps in {config.train.epochs} epochs, {limited * images:,} images"),
    ]


def _size_rows(config: RunConfig, model: PlaceModel, counts: dict[str, int]) -> list[tuple[str, str]]:
    trained, w = counts["trainable"], world_size()
    model.train()  # its forward holds collectives of all ranks
    joint = config.train.passes == "joint"
    one, three = saved_bytes(model, 4, joint), saved_bytes(model, 8, joint)
    each = max(0, three - one) / 4
    b = 4 * config.data.places_per_batch // w
    at_once = min(b, config.train.encode_chunk or b)
    fixed = counts["total"] * 4 + trained * 4 * (1 + MOMENTS[config.train.optimizer])
    descriptors = 4 * config.data.places_per_batch * model.descriptor_dim * 4 * 3 * (2 if joint else 1)
    stored = trained * 4 * (1 + MOMENTS[config.train.optimizer])
    if config.model.backbone.weights is None:
        stored += (counts["total"] - trained) * 4
    activations = at_once * each + descriptors
    memory = (
        f"{_gb(fixed)} weights, gradients, moments + about {_gb(activations)} activations "
        f"({at_once} images at once, float32) = {_gb(fixed + activations)}"
    )
    return [("memory a process", memory), ("checkpoint", f"{_gb(stored)} each, at most {config.train.keep + 1} kept")]


def _gb(n: float) -> str:
    return f"{n / 1e9:.2f} GB" if n >= 1e8 else f"{n / 1e6:.1f} MB"


def show(rows: list[tuple[str, str]]) -> str:
    """The rows as an aligned text table."""
    return Table((), [(f"  {name}", without_passwords(value)) for name, value in rows], (0, 1)).text()
