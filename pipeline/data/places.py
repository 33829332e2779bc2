"""Places of a shard set as training batches: an ordinary map-style Dataset and DataLoader over the plan.

Invariant: what a batch holds, pixel for pixel, is a function of (index, settings, seed, epoch, step, rank, world size);
and the batches of all ranks joined do not depend on the world size. The number of workers and where a run was resumed
never matter. Nothing is skipped or replaced: a member that cannot be read or decoded ends the run, naming it.
"""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from pipeline.common.errors import DataError, UsageError, told
from pipeline.config import DataConfig
from pipeline.config.image_size import ImageSize
from pipeline.data import workers
from pipeline.data.augment import Draws, check, training_view
from pipeline.data.cache import ShardCache
from pipeline.data.cliques import Mined
from pipeline.data.images import decode
from pipeline.data.plan import EpochPlan, Rows, plan
from pipeline.data.prefetch import FetchAhead
from pipeline.data.shard_sets import ShardSetsCache, cache_of

if TYPE_CHECKING:
    from shards.index import ShardIndex

VIEWS = 4  # K, images of a place
OPEN_SHARDS = 128  # descriptors a process keeps open


class Batch(NamedTuple):
    """This rank's part of a global batch; b = 4 places_per_batch / W images."""

    images: Tensor
    """uint8 [b, 3, H, W], place-major: four consecutive images are one place."""
    labels: Tensor
    """int64 [b], the number of each image's place."""
    keys: list[str]
    """Sample keys in the shards, one a place."""


class Failure(NamedTuple):
    """An error of a worker on its way to the trainer, which raises it as it was."""

    kind: str
    message: str


@dataclass(frozen=True)
class Members:
    """Where the samples of some index rows lie; n rows."""

    samples: list[str]
    """Keys, n."""
    labels: NDArray[np.int64]
    """Place numbers [n]."""
    shards: list[str]
    """Shard names, n."""
    offsets: NDArray[np.int64]
    """First byte of each image [n, 4]."""
    sizes: NDArray[np.int64]
    """Bytes of each image [n, 4]."""


def members(index: ShardIndex, rows: Rows) -> Members:
    """Takes rows [n] of the index out of its table."""
    table = index.table.take(rows)
    offsets, sizes = (
        np.asarray(table.column(name).combine_chunks().flatten().to_numpy(), np.int64).reshape(len(rows), VIEWS)
        for name in ("offsets", "sizes")
    )
    labels = np.asarray(table.column("place").to_numpy(), np.int64)
    return Members(table.column("sample").to_pylist(), labels, table.column("shard").to_pylist(), offsets, sizes)


class Places(Dataset[Batch | Failure]):
    """Samples of a shard set, read by byte offset; a list of positions gives a `Batch`.

    Args:
        found: the samples, in the order of positions.
        cache: their shards.
        data: size and augmentation.
        seed, turns: with sample and view, the key of all randomness; a turn for each sample, or one for all (the
            epoch, where no place comes twice in it).
    """

    def __init__(
        self, found: Members, cache: ShardCache | ShardSetsCache, data: DataConfig, seed: int, turns: Rows | int
    ) -> None:
        self.found, self.cache, self.data, self.seed = found, cache, data, seed
        self.turns = np.broadcast_to(turns, len(found.samples))
        self._open: OrderedDict[str, int] = OrderedDict()

    def __len__(self) -> int:
        return len(self.found.samples)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": OrderedDict()}  # descriptors belong to one process

    def __getitem__(self, position: int) -> Batch | Failure:
        return self.__getitems__([position])

    def __getitems__(self, positions: list[int]) -> Batch | Failure:
        try:
            batch = self.batch(positions)
            workers.hand_over(batch.images, batch.labels)
            return batch
        except Exception as error:  # across processes torch would wrap it in a traceback
            if (mended := told(error, f"reading {self.cache.root}")) is None:
                raise
            return Failure(type(mended).__name__, str(mended))

    def batch(self, positions: list[int]) -> Batch:
        """Reads, decodes and augments places. Raises `DataError` naming shard, sample and member."""
        shape = ImageSize.of(self.data.image_size).largest
        images = torch.empty((len(positions) * VIEWS, 3, *shape), dtype=torch.uint8)
        for place, position in enumerate(positions):
            sample = self.found.samples[position]
            for view, encoded in enumerate(self.encoded(position)):
                try:
                    pixels = decode(encoded)
                except DataError as error:
                    shard, name = self.found.shards[position], sample.rpartition("/")[2]
                    raise DataError(
                        f"{self.cache.path(shard)}: member {name}.{view}.jpg of sample {name} {error}; "
                        f"run jobs.prepare --verify on the shards"
                    ) from None
                draws = Draws("view", self.seed, int(self.turns[position]), sample, view)
                augmented = training_view(
                    pixels, shape, self.data.augment, self.data.rand_ops, self.data.rand_magnitude, draws
                )
                images[place * VIEWS + view] = torch.from_numpy(np.require(augmented, requirements="W")).permute(
                    2, 0, 1
                )
        labels = torch.from_numpy(np.repeat(self.found.labels[positions], VIEWS))
        return Batch(images, labels, [self.found.samples[position] for position in positions])

    def encoded(self, position: int) -> list[bytes]:
        """The four encoded images of a sample, in one read: they lie together."""
        starts, sizes = self.found.offsets[position], self.found.sizes[position]
        first, end = int(starts.min()), int((starts + sizes).max())
        shard = self.found.shards[position]
        try:
            block = os.pread(self._descriptor(shard), end - first, first)
        except OSError as error:
            raise DataError(f"{self.cache.path(shard)}: cannot be read at byte {first} ({error.strerror})") from None
        if len(block) != end - first:
            raise DataError(
                f"{self.cache.path(shard)}: ends before sample {self.found.samples[position]}; "
                f"run jobs.prepare --verify on the shards"
            )
        return [block[start - first : start - first + n] for start, n in zip(starts, sizes, strict=True)]

    def _descriptor(self, shard: str) -> int:
        if shard not in self._open:
            self._open[shard] = self.cache.open(shard)
            if len(self._open) > OPEN_SHARDS:
                os.close(self._open.popitem(last=False)[1])
        self._open.move_to_end(shard)
        return self._open[shard]

    def close(self) -> None:
        """Closes the shards that this process holds open."""
        while self._open:
            os.close(self._open.popitem()[1])


class PlaceLoader:
    """The rest of a plan, as this rank's batches in their order. Iterate once; `len` is what is to come.

    Where `stop()` becomes true while no batch comes, the batches end early.
    """

    def __init__(
        self,
        index: ShardIndex,
        data: DataConfig,
        planned: EpochPlan,
        seed: int,
        start_step: int,
        rank: int,
        world_size: int,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        check(data.rand_ops, data.rand_magnitude)
        self.plan = planned
        steps, places = planned.batches.shape
        if places % world_size:
            raise UsageError(
                f"data.places_per_batch is {places}, not a multiple of the {world_size} processes: ranks hold equal "
                f"parts of a batch"
            )
        if not 0 <= start_step <= steps:
            raise UsageError(f"the epoch has {steps} steps; it cannot start at step {start_step}")
        self.start_step, self.workers = start_step, data.workers
        self.places = places // world_size
        mine = self.plan.batches[:, rank * self.places : (rank + 1) * self.places]
        self.cache = cache_of(index, Path(data.cache), int(data.cache_gb * 1e9))
        turns = np.repeat(self.plan.turns, self.places)
        self.dataset = Places(members(index, mine.reshape(-1)), self.cache, data, seed, turns)
        if self.cache.remote:
            self._check_room(data)
        self.stop = stop
        self._loader: DataLoader[Batch | Failure] = DataLoader(
            self.dataset,
            batch_sampler=_Steps(start_step, steps, self.places),
            collate_fn=_as_is,
            # torch draws a seed from it that nothing here uses: the trainer's own generator stays untouched
            generator=torch.Generator(),
            **workers.options(data.workers, data.prefetch),
        )

    def __len__(self) -> int:
        return len(self.plan.batches) - self.start_step

    def __iter__(self) -> Generator[Batch]:
        ahead = self._fetch_ahead() if self.cache.remote else None
        try:
            for step, batch in enumerate(workers.batches(self._loader, self.stop), self.start_step):
                if isinstance(batch, Failure):
                    raise (UsageError if batch.kind == "UsageError" else DataError)(batch.message)
                yield batch
                if ahead is not None:
                    ahead.advance(step + 1)
        finally:
            self.dataset.close()
            if ahead is not None:
                ahead.close()

    def _fetch_ahead(self) -> FetchAhead:
        names = self.dataset.found.shards
        steps = [names[i : i + self.places] for i in range(0, len(names), self.places)]
        ahead = FetchAhead(self.cache, steps, self.start_step)
        ahead.start()
        return ahead

    def _check_room(self, data: DataConfig) -> None:
        """Refuses a cache that would fetch the same shards again and again."""
        sizes = sorted((self.cache.size(name) for name in set(self.dataset.found.shards)), reverse=True)
        needed = sum(sizes[: 2 * data.window_shards + 1] if data.order == "blocked" else sizes)
        if needed > self.cache.limit:
            other = "lower data.window_shards" if data.order == "blocked" else "set data.order to blocked"
            raise UsageError(
                f"data.order={data.order} reads {needed / 1e9:.3g} GB of {self.cache.root} at a time, more than "
                f"data.cache_gb={data.cache_gb:g}: raise it, or {other}"
            )


class _Steps:
    """Batch sampler: the positions of each step's places in a dataset that is already in the order of the plan."""

    def __init__(self, start: int, steps: int, places: int) -> None:
        self.start, self.steps, self.places = start, steps, places

    def __len__(self) -> int:
        return self.steps - self.start

    def __iter__(self) -> Iterator[list[int]]:
        for step in range(self.start, self.steps):
            yield list(range(step * self.places, (step + 1) * self.places))


def _as_is(batch: Any) -> Any:  # Places gives whole batches: there is nothing to collate
    return batch


def build_loader(
    index: ShardIndex,
    data: DataConfig,
    seed: int,
    epoch: int,
    start_step: int,
    rank: int,
    world_size: int,
    mined: Mined | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> PlaceLoader:
    """This rank's batches of an epoch from `start_step` on; `mined`: as for `plan`.

    They are fewer where `stop()` becomes true while none comes.

    Raises:
        UsageError: a batch that ranks cannot share equally, or too few places or too little cache for the settings.
        DataError: while iterating, a shard or member that cannot be read or decoded.
    """
    planned = plan(index, seed, epoch, data.places_per_batch, data.order, data.window_shards, mined)
    return PlaceLoader(index, data, planned, seed, start_step, rank, world_size, stop)
