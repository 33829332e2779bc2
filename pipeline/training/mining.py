"""Which descriptors an epoch of `data.order: mined` is planned from, and when they are made.

Invariant: an epoch is planned from one file, whose sha256 is in the run's state: given that file, a resumed run takes
the same batches at any number of processes. The first epoch needs none (its order is `city`); then the model of the
epoch's start makes one every `mine_every` epochs. A run that is killed before its next checkpoint mines again from the
last one. From scratch, 1 and 4 processes train to weights that differ by rounding, so a choice can differ too.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pipeline.common.errors import DataError, UsageError
from pipeline.config import DataConfig, RunConfig
from pipeline.data.cliques import CliqueRule, Mined, mine
from pipeline.data.place_descriptors import read_descriptors
from pipeline.data.positions import place_points
from pipeline.data.shard_sets import cities_of
from pipeline.distributed import broadcast_tensors, on_rank_0, rank
from pipeline.model.cross_image import check_crossing
from pipeline.model.vpr import PlaceModel
from pipeline.training.checkpoint import RunState
from shards.index import ShardIndex

MODEL = ("single", "bank", "permuted")  # what the model being trained can mine from


class Mining:
    """The mined files of a run.

    Args:
        config: of the run.
        index: its shards.
        run: its folder; files are in `mined/`.
        origin: the folder of the run that it was branched off, whose files it may need; None: its own.

    Raises:
        UsageError: settings that make no clique.
        DataError: `mine_radius` on shards without positions.
    """

    def __init__(self, config: RunConfig, index: ShardIndex, run: Path, origin: Path | None = None) -> None:
        self.data, self.index = config.data, index
        self.folder, self.origin = run / "mined", (origin or run) / "mined"
        check_rule(self.data)
        if self.data.mine_from == "bank":
            check_crossing(config.model.cross_image, "data.mine_from bank")
        self.points, self.unknown = place_points(
            index, f"data.mine_radius={self.data.mine_radius:g}", self.data.mine_radius > 0
        )
        self._read: tuple[str, Mined] | None = None

    def due(self, state: RunState) -> bool:
        """Whether the model must mine before the epoch of `state` can be planned."""
        if self.data.mine_from not in MODEL or state.epoch == 0:
            return False
        return state.mined.get("epoch") != _made_at(state.epoch, self.data.mine_every)

    def make(self, state: RunState, model: PlaceModel, accelerator: Any, stopped: Callable[[], None]) -> None:
        """Makes the file of this epoch and notes it in `state`; removes those that no checkpoint names. Collective.

        Args:
            model: whole, as it is at the epoch's start, with its bank.
            accelerator: its device and precision.
            stopped: raises where the run was asked to stop; called all along.
        """
        from pipeline.evaluation.describe.places import describe_places

        on_rank_0(lambda: self.folder.mkdir(parents=True, exist_ok=True), what=f"making {self.folder}")
        found = describe_places(
            model, self.index, self.data, self.data.mine_from, state.epoch, accelerator.device, accelerator.autocast,
            stopped, self.folder,
        )  # fmt: skip

        def keep() -> dict[str, str | int]:
            assert found is not None  # on rank 0
            name = f"epoch-{state.epoch:04d}-{found.sha256[:12]}.safetensors"
            found.save(self.folder / name)
            named = {_named(path) for path in self.folder.parent.glob("checkpoints/*/state.json")}
            for path in self.folder.iterdir():
                if path.name not in named | {name}:
                    path.unlink()
            return {"file": name, "sha256": found.sha256, "epoch": state.epoch}

        state.mined = on_rank_0(keep, what=f"writing descriptors under {self.folder}")

    def mined(self, state: RunState) -> Mined | None:
        """What the epoch of `state` is planned from; None: nothing yet. Collective; rank 0 reads the file, once.

        Raises:
            DataError: the file is missing or not the one that the state names; the same on all ranks.
        """
        given = self.data.mine_from not in MODEL
        if not given and not state.mined:
            return None
        path = Path(self.data.mine_from) if given else self._path(state.mined["file"])
        noted = str(state.mined.get("sha256", ""))

        if self._read is None or self._read[0] != noted:
            tensors: dict[str, Tensor] = {}

            def load() -> str:
                found = read_descriptors(path, self.index.digest, self.index.places, noted)
                tensors["descriptors"] = torch.from_numpy(found.values)
                return found.sha256

            sha256 = on_rank_0(load, what=f"reading {path}")  # the others need not see the file
            values = broadcast_tensors(tensors)["descriptors"].numpy()
            self._read = sha256, mine(values, cities_of(self.index), self.points, rule(self.data))
        if given:
            state.mined = {"file": str(path), "sha256": self._read[0], "epoch": 0}
        return self._read[1]

    def adopt(self, state: RunState) -> None:
        """Copies the file that a branched run needs into its own folder. Collective."""
        if self.origin.resolve() == self.folder.resolve() or not state.mined or self.data.mine_from not in MODEL:
            return

        def copy() -> None:
            source = self._path(state.mined["file"])
            found = read_descriptors(source, self.index.digest, self.index.places, str(state.mined["sha256"]))
            found.save(self.folder / source.name)

        on_rank_0(copy, what=f"copying mined descriptors to {self.folder}")

    def told(self) -> str:
        """What will be mined, in one line."""
        data = self.data
        drawn = f"groups of {data.clique} places, drawn from {data.mine_neighbours} neighbours"
        if data.mine_from not in MODEL:
            return f"{drawn} by {data.mine_from}"
        every = "each epoch" if data.mine_every == 1 else f"every {data.mine_every} epochs"
        return f"{drawn}; from the second epoch, {every}: {4 * self.index.places:,} images are described"

    def tell(self) -> None:
        """Says once, on rank 0, how many places have no position."""
        if self.unknown and self.data.mine_radius and rank() == 0:
            print(
                f"data.mine_radius: {self.unknown:,} of {len(self.points):,} places have no position; they are near to "
                "no other", file=sys.stderr, flush=True,
            )  # fmt: skip

    def _path(self, name: object) -> Path:
        plain = Path(str(name)).name  # a state.json can come from elsewhere
        own = self.folder / plain
        return own if own.exists() else self.origin / plain


def rule(data: DataConfig) -> CliqueRule:
    """How places are grouped."""
    return CliqueRule(data.clique, data.mine_neighbours, data.mine_radius, data.mine_temperature)


def check_rule(data: DataConfig) -> None:
    """Refuses settings that make no clique.

    Raises:
        UsageError: with the values.
        DataError: on rank 0, a file that is not there.
    """
    if data.clique > data.places_per_batch:
        raise UsageError(
            f"data.clique is {data.clique}: a group of places cannot be larger than a batch (data.places_per_batch is "
            f"{data.places_per_batch})"
        )
    if data.mine_neighbours < data.clique - 1:
        raise UsageError(f"data.mine_neighbours ({data.mine_neighbours}) is fewer than a group needs (data.clique - 1)")
    if data.mine_from not in MODEL and rank() == 0 and not Path(data.mine_from).is_file():
        raise DataError(f"data.mine_from: {data.mine_from} is none of {', '.join(MODEL)}, and no file of jobs.mine")


def _made_at(epoch: int, every: int) -> int:
    """The epoch at whose start the file of this epoch is made: 1, 1 + every, ..."""
    return 1 + (epoch - 1) // every * every


def _named(state: Path) -> str:
    """The mined file that a checkpoint names, or ""."""
    return str(json.loads(state.read_text())["state"].get("mined", {}).get("file", ""))
