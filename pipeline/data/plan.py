"""(index, seed, epoch) -> the ordered global batches of one epoch.

Invariant: a pure function. Neither rank, world size nor workers enter, so the cursor of a run is one integer, the
number of batches consumed; within an epoch every place comes at most once, and the places left out of one epoch are
used in the next.

Stability: random keys are the raw 64-bit outputs of Philox (a stream that numpy guarantees), keyed by SHA-256 of what
they are for, and only sorted, stably; so the plan is the same on every platform and numpy version.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from pipeline.common.errors import DataError, UsageError

if TYPE_CHECKING:
    from shards.index import ShardIndex

Order = Literal["city", "mixed", "blocked"]
Rows = NDArray[np.int64]


@dataclass(frozen=True)
class EpochPlan:
    """One epoch."""

    batches: Rows
    """[steps, places_per_batch] row numbers of the index table, in the order they are trained on."""
    left_over: int
    """Places that fill no batch in this epoch, always fewer than places_per_batch."""
    round: int
    """The round of the shard set that the epoch reads."""

    def slice(self, step: int, rank: int, world_size: int) -> Rows:
        """The rows of rank `rank` in global batch `step`: its contiguous part, [places_per_batch / world_size]."""
        places = self.batches.shape[1] // world_size
        rows: Rows = self.batches[step, rank * places : (rank + 1) * places]
        return rows


def plan(
    index: ShardIndex,
    seed: int,
    epoch: int,
    places_per_batch: int,
    order: Order,
    window_shards: int = 8,
) -> EpochPlan:
    """Orders one epoch.

    Epoch e reads round e mod R. `places mod places_per_batch` places are left out, in rotation, so that all are left
    out equally often. Then, by `order`:

    - `city`: batches within one city; what is left of each city is pooled, city after city, into mixed batches; all
      batches are shuffled. The published training is in-city in effect: the other images of a batch are hard negatives.
    - `mixed`: places shuffled over all cities.
    - `blocked`: shards in random order, shuffled within windows of `window_shards`; what is left of a window opens the
      first batch of the next. A reader needs two windows at a time.

    Raises:
        UsageError: a batch that cannot be filled, or an unknown order.
        DataError: an index that holds a place twice in a round.
    """
    if order not in get_args(Order):
        raise UsageError(f"data.order is '{order}'; choose one of {', '.join(get_args(Order))}")
    if places_per_batch < 1 or window_shards < 1 or epoch < 0:
        raise UsageError(
            f"data.places_per_batch ({places_per_batch}) and data.window_shards ({window_shards}) must be at least 1, "
            f"and the epoch ({epoch}) at least 0"
        )
    which = epoch % max(index.rounds, 1)
    rows = np.flatnonzero(_column(index, "round") == which).astype(np.int64)
    if len(rows) < places_per_batch:
        raise UsageError(
            f"data.places_per_batch is {places_per_batch}, but round {which} of {index.root} has only "
            f"{len(rows)} places: lower it, or prepare more places"
        )
    places = _column(index, "place")[rows]
    rows = rows[np.argsort(places, kind="stable")]  # by place: whatever order the shards were written in
    if len(np.unique(places)) != len(places):
        raise DataError(f"{index.root}: round {which} of the index holds a place twice; prepare the shards again")

    left = len(rows) % places_per_batch
    rows = rows[_kept(len(rows), left, seed, epoch)]
    keys = _random(len(rows), "places", seed, epoch)
    if order == "city":
        batches = _shuffled(_in_cities(index, rows, keys, places_per_batch, seed, epoch), seed, epoch)
    elif order == "mixed":
        batches = rows[np.argsort(keys, kind="stable")].reshape(-1, places_per_batch)
    else:
        window = _shuffled_groups(_column(index, "shard")[rows], "shards", seed, epoch) // window_shards
        batches = rows[np.lexsort((keys, window))].reshape(-1, places_per_batch)
    return EpochPlan(batches, left, which)


def _in_cities(index: ShardIndex, rows: Rows, keys: NDArray[np.uint64], size: int, seed: int, epoch: int) -> Rows:
    """Batches within cities, then batches from the pool of what is left of each city; `len(rows)` fills all."""
    city = _shuffled_groups(_column(index, "city")[rows], "cities", seed, epoch)
    order = np.lexsort((keys, city))
    rows, city = rows[order], city[order]
    counts = np.bincount(city)
    position = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)  # of a place in its city
    full = position < np.repeat(counts // size * size, counts)
    # each city's full part is a multiple of the batch, so cutting the concatenation never crosses two cities
    return np.concatenate([rows[full], rows[~full]]).reshape(-1, size)


def _kept(total: int, left: int, seed: int, epoch: int) -> NDArray[np.bool_]:
    """Which places are kept: `left` are skipped, the next ones in a fixed random order each epoch.

    `left` < a batch <= total - left, so two epochs in a row never skip the same place.
    """
    keep = np.ones(total, dtype=np.bool_)
    skipped = (np.arange(left) + epoch * left) % total
    keep[np.argsort(_random(total, "left", seed), kind="stable")[skipped]] = False
    return keep


def _shuffled(batches: Rows, seed: int, epoch: int) -> Rows:
    return batches[np.argsort(_random(len(batches), "batches", seed, epoch), kind="stable")]


def _shuffled_groups(codes: Rows, *purpose: object) -> Rows:
    """Each row's group as a number 0..groups-1, the groups numbered in random order."""
    unique, codes = np.unique(codes, return_inverse=True)
    number = np.empty(len(unique), dtype=np.int64)
    number[np.argsort(_random(len(unique), *purpose), kind="stable")] = np.arange(len(unique))
    return number[codes]


def _random(n: int, *purpose: object) -> NDArray[np.uint64]:
    """n random 64-bit keys that depend on `purpose` alone."""
    digest = hashlib.sha256("|".join(map(str, purpose)).encode()).digest()
    return np.random.Philox(key=int.from_bytes(digest[:16], "little")).random_raw(n)


def _column(index: ShardIndex, name: str) -> Rows:
    """A column of numbers; strings become their ranks among the column's sorted values, so that they sort fast."""
    import pyarrow as pa
    import pyarrow.compute as pc

    column = index.table.column(name).combine_chunks()
    if not pa.types.is_string(column.type):
        return np.asarray(column.to_numpy(), np.int64)
    encoded = column.dictionary_encode()
    ranks = pc.rank(encoded.dictionary, sort_keys="ascending", tiebreaker="first").to_numpy()
    return np.asarray(ranks[encoded.indices.to_numpy()], np.int64)
