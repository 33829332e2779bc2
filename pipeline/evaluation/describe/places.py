"""Descriptors of the places of a shard set, by all processes together, for mining (pipeline.data.cliques).

Invariant: W never changes a descriptor on like hardware: forward passes are cut by position among the places, four
un-augmented images of each, and dealt to ranks whole; a last, partial one is filled up and the filling dropped.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from contextlib import AbstractContextManager, closing
from pathlib import Path

import numpy as np
import torch

from pipeline import distributed
from pipeline.common.errors import DataError, UsageError
from pipeline.common.files import unnamed_file
from pipeline.common.progress import Progress
from pipeline.config import DataConfig
from pipeline.data.images import normalise
from pipeline.data.keyed import Rows, random
from pipeline.data.place_descriptors import PlaceDescriptors
from pipeline.data.places import VIEWS, PlaceLoader
from pipeline.data.plan import EpochPlan
from pipeline.data.shard_sets import cities_of, rows_of_round
from pipeline.evaluation.describe.encode import evaluating
from pipeline.evaluation.identity import model_digest
from pipeline.evaluation.search.exact import slices
from pipeline.evaluation.search.projection import fit_rows, sample_rows
from pipeline.model.vpr import PlaceModel
from shards.index import ShardIndex

DIMENSIONS = 256  # kept by PCA: enough to tell neighbours, 29 MB for GSV-Cities in fp16
PLACES = 8  # places in a forward pass


def describe_places(
    model: PlaceModel,
    index: ShardIndex,
    data: DataConfig,
    kind: str,
    turn: int,
    device: torch.device,
    autocast: Callable[[], AbstractContextManager[object]],
    stopped: Callable[[], None] = lambda: None,
    temporary: Path | None = None,
) -> PlaceDescriptors | None:
    """One descriptor a place: the mean of its four images', each by itself; PCA; unit length; fp16. Collective.

    Args:
        data: size of the images, workers and cache.
        kind: single; bank: each image beside the model's bank; permuted: single, shuffled among the places of each
            city (the same shapes, and nothing to learn).
        turn: the round of images, mod each set's rounds.
        autocast: precision of the backbone.
        stopped: called at each pass on all ranks; what it raises ends the work.
        temporary: existing folder for the descriptors before PCA (2 bytes x P x D).

    Returns:
        On rank 0 all of them, None elsewhere.

    Raises:
        UsageError: `bank` for a model without one.
        DataError: images that cannot be read, or descriptors that tell nothing; the same on all ranks.
    """
    if kind == "bank" and model.bank is None:
        raise UsageError("mining from bank: no bank lies beside these weights; mine from single, or train them anew")
    rows = rows_of_round(index, turn)
    w, total = distributed.world_size(), len(rows)
    steps = -(-total // (PLACES * w))
    filled = np.append(rows, np.repeat(rows[-1:], steps * PLACES * w - total))
    planned = EpochPlan(filled.reshape(steps, PLACES * w), 0, 0, np.zeros(steps, np.int64))
    unaltered = dataclasses.replace(data, augment="off", order="city")
    batches = iter(PlaceLoader(index, unaltered, planned, 0, 0, distributed.rank(), w))
    first = distributed.rank() == 0

    def room() -> np.ndarray | None:
        """A file without a name for the descriptors [P, D] before PCA, on rank 0."""
        if not first:
            return None
        size = total * model.descriptor_dim * 2
        with unnamed_file(size, temporary) as file:
            return np.memmap(file, np.float16, "r+", shape=(total, model.descriptor_dim))

    every = distributed.agreed(room, what="making room for descriptors")
    with (
        evaluating(model),
        closing(batches) as loader,
        Progress("mining: describing places", total, "places", enabled=first) as bar,
    ):
        memory = model.remember(model.bank) if kind == "bank" and model.bank is not None else None
        for step in range(steps):
            stopped()
            batch = distributed.agreed(lambda: next(loader), what="reading places to mine from")
            with autocast():
                regions = model.encode(normalise(batch.images.to(device, non_blocking=True)))
            regions = regions.float()
            images = model.correlate(regions, alone=True) if memory is None else model.correlate_beside(regions, memory)
            gathered = distributed.gather(images.unflatten(0, (-1, VIEWS)).mean(1))
            start = step * PLACES * w
            if every is not None:
                every[start : start + PLACES * w] = gathered[: total - start].half().cpu().numpy()
            bar.advance(min(PLACES * w, total - start))

        def shortened() -> PlaceDescriptors | None:
            if every is None:
                return None
            if not all(np.isfinite(block).all() for _, block in slices(every)):
                raise DataError("the model's descriptors are not all finite numbers: nothing can be mined from them")
            dims = min(DIMENSIONS, total, model.descriptor_dim)
            projection = fit_rows(lambda: slices(every), sample_rows(total), dims, device=device)
            values = np.concatenate([projection(block) for _, block in slices(every)])
            values /= np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-30)
            if kind == "permuted":
                values = values[permuted(index)]
            return PlaceDescriptors(values.astype(np.float16), index.digest, kind, model_digest(model), turn)

        return distributed.agreed(shortened, what="mining")


def permuted(index: ShardIndex) -> Rows:
    """A permutation [P] of the places within each city."""
    cities = cities_of(index)
    order = np.lexsort((random(len(cities), "permuted"), cities))
    shuffled = np.empty(len(cities), np.int64)
    shuffled[np.argsort(cities, kind="stable")] = order
    return shuffled
