"""Which images a bank holds, and encoding them: drawn from the training shards, from a map, or from a folder.

Invariant: the draw is a function of (how many there are, how many are wanted, seed) and in order, so a smaller bank is
the beginning of a larger one; images are as the model sees them without augmentation; every rank holds rank 0's bank.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from pipeline.common.errors import UsageError
from pipeline.config import DataConfig, EvaluationConfig, RunConfig
from pipeline.config.image_size import input_size
from pipeline.data.images import load_image, to_input
from pipeline.data.places import VIEWS, Places, members
from pipeline.data.shard_sets import cache_of
from pipeline.distributed import agreed, broadcast_tensors, on_rank_0
from pipeline.evaluation.describe.encode import by_shape, encode_parts, evaluating
from pipeline.evaluation.sets.evaluation_set import list_images
from pipeline.model.bank import Bank, make_bank
from pipeline.model.cross_image import check_crossing
from pipeline.model.vpr import PlaceModel

if TYPE_CHECKING:
    from shards.index import ShardIndex

TOGETHER = 16  # images of a bank in a forward pass
STREAM = 2  # of the draw; shuffled groups use 0 and 1


def drawn(there: int, wanted: int, seed: int) -> np.ndarray:
    """Positions of at most `wanted` of `there` images, int64, in the order of the draw."""
    bits = np.random.Philox(key=[seed, STREAM]).random_raw(there)
    return np.argsort(bits, kind="stable")[:wanted].astype(np.int64)


def chosen_bank(
    model: Any, config: EvaluationConfig, database: Sequence[Path], device: torch.device | str
) -> Bank | None:
    """The bank that an evaluation asks for; None where `groups` has no `bank`. Collective, for a model in `evaluating`.

    Raises:
        UsageError: the model's images do not attend to each other, it has no bank of training images, or no such
            folder; DataError: a photo of the bank cannot be read. The same on all ranks.
    """
    if "bank" not in config.groups:
        return None
    check_crossing(model.config.cross_image, "groups bank")
    if config.bank_from == "train":
        if model.bank is None:
            raise UsageError(
                "bank_from train: no bank of training images lies beside these weights (a training writes it at each "
                "epoch's end; released weights have none); take --bank_from map, or a folder of photos"
            )
        return model.bank.first(config.bank)
    paths: Sequence[Path] = database
    if config.bank_from != "map":
        paths = agreed(partial(_photos_of_bank, Path(config.bank_from)))
    chosen = [paths[p] for p in drawn(len(paths), config.bank, 0)]
    source = config.bank_from if config.bank_from == "map" else Path(config.bank_from).resolve().name

    def read() -> list[Tensor]:
        return [to_input(load_image(path), input_size(model), config.resize) for path in chosen]

    return encode_bank(model, agreed(read, what="reading the bank"), source, config, device)


def _photos_of_bank(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise UsageError(f"bank_from {folder}: give train, map, or an existing folder of photos")
    if paths := list_images(folder):
        return paths
    raise UsageError(f"bank_from {folder}: no photos in this folder")


def encode_bank(
    model: PlaceModel,
    images: Sequence[Tensor] | Tensor,
    source: str,
    config: EvaluationConfig,
    device: torch.device | str,
) -> Bank:
    """The bank of M images [3, H, W], as `to_input` gives them or uint8, for a model in `evaluating`. Collective.

    Every rank encodes all of them, which costs less than dealing them out, and takes what rank 0 found.
    """
    dtype = next(model.parameters()).dtype
    parts = [
        encode_parts(model, by_shape(images[at : at + TOGETHER]), config, torch.device(device), dtype=dtype)
        for at in range(0, len(images), TOGETHER)
    ]
    return make_bank(broadcast_tensors({"regions": torch.cat(parts)})["regions"], source)


class TrainingBank:
    """The bank of a run: the same images of its shards all along, encoded anew whenever asked."""

    def __init__(self, config: RunConfig, index: ShardIndex, device: torch.device) -> None:
        self.config, self.index, self.device = config, index, device
        self._images: Tensor | None = None

    def encode(self, model: PlaceModel) -> Bank | None:
        """The bank of the model as it is; None where its images do not attend to each other. Collective."""
        encoder = self.config.model.cross_image
        if not encoder.layers or encoder.alone:
            return None
        if self._images is None:
            wanted = partial(shard_images, self.index, self.config.data, self.config.validate.bank, self.config.seed)
            self._images = torch.from_numpy(on_rank_0(wanted, what="reading the bank from the shards"))
        with evaluating(model):
            return encode_bank(model, self._images, "train", EvaluationConfig(), self.device)


def shard_images(index: ShardIndex, data: DataConfig, wanted: int, seed: int) -> np.ndarray:
    """View 0 of at most `wanted` places, drawn by `seed`, without augmentation: uint8 [M, 3, H, W].

    Raises:
        DataError: a shard cannot be read.
    """
    place = index.table.column("place").to_numpy()
    first = np.unique(place, return_index=True)[1]  # a row of each place, whatever its round
    rows = first[drawn(len(first), wanted, seed)]
    cache = cache_of(index, Path(data.cache), int(data.cache_gb * 1e9))
    plain = dataclasses.replace(data, augment="off")
    places = Places(members(index, rows), cache, plain, seed, 0)
    try:
        return np.concatenate([places.batch([p]).images[::VIEWS].numpy() for p in range(len(rows))])
    finally:
        places.close()
