"""(index, seed, epoch, mined descriptors) -> the ordered global batches of one epoch.

Invariant: a pure function. Neither rank, world size nor workers enter, so the cursor of a run is one integer, the
number of batches consumed; within an epoch every place comes at most once (of several shard sets: once a pass), and
the places left out of one epoch are used in the next.

Stability: random keys (pipeline.data.keyed) are only sorted, stably; so the plan is the same on every platform and
numpy version.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from pipeline.common.errors import DataError, UsageError
from pipeline.data.cliques import Mined, cliques
from pipeline.data.keyed import Rows, random
from pipeline.data.shard_sets import ShardSets, rows_of_round

if TYPE_CHECKING:
    from shards.index import ShardIndex

Order = Literal["city", "mixed", "blocked", "mined"]


@dataclass(frozen=True)
class EpochPlan:
    """One epoch."""

    batches: Rows
    """[steps, places_per_batch] row numbers of the index table, in the order they are trained on."""
    left_over: int
    """Places that fill no batch in a pass of this epoch, always fewer than places_per_batch."""
    in_cliques: int
    """Places of the epoch that are in a clique; 0 where nothing is mined."""
    turns: Rows
    """[steps] the turn of each batch, epoch x passes + pass: with the sample, the key of its images' randomness."""

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
    mined: Mined | None = None,
) -> EpochPlan:
    """Orders one epoch.

    Epoch e reads round e mod R. `places mod places_per_batch` places are left out, in rotation, so that all are left
    out equally often. Then, by `order`:

    - `city`: batches within one city; what is left of each city is pooled, city after city, into mixed batches; all
      batches are shuffled. The published training is in-city in effect: the other images of a batch are hard negatives.
    - `mixed`: places shuffled over all cities.
    - `blocked`: shards in random order, shuffled within windows of `window_shards`; what is left of a window opens the
      first batch of the next. A reader needs two windows at a time.
    - `mined`: as `city`, but each city begins with its cliques of places that look alike (pipeline.data.cliques), so
      that its batches are made of them and only its last one is filled with other places. Without `mined` (before
      the first mining) it is `city`.

    Several shard sets (pipeline.data.shard_sets): an epoch is `passes` such orders one after the other.

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
    passes = index.passes if isinstance(index, ShardSets) else 1
    parts, left, members = [], 0, 0
    for turn in range(epoch * passes, (epoch + 1) * passes):
        rows = _rows(index, turn, seed)
        if len(rows) < places_per_batch:
            raise UsageError(
                f"data.places_per_batch is {places_per_batch}, but a pass over {index.root} has only {len(rows)} "
                f"places: lower it, or prepare more places"
            )
        left = len(rows) % places_per_batch
        rows = rows[_kept(len(rows), left, seed, turn)]
        keys = random(len(rows), "places", seed, turn)
        if order == "mined" and mined is not None:
            keys, found = _cliques_first(index, rows, keys, seed, turn, mined)
            members += found
        parts.append(_ordered(index, rows, keys, seed, turn, places_per_batch, order, window_shards))
    turns = np.repeat(np.arange(epoch * passes, (epoch + 1) * passes), len(parts[0]))
    return EpochPlan(np.concatenate(parts), left, members, turns)


def _rows(index: ShardIndex, turn: int, seed: int) -> Rows:
    """The rows of a pass, by place, whatever order the shards were written in."""
    places = _column(index, "place")
    if not isinstance(index, ShardSets):
        rows = rows_of_round(index, turn)
        if len(np.unique(places[rows])) != len(rows):
            raise DataError(f"{index.root}: a round of the index holds a place twice; prepare the shards again")
        return rows
    chosen = []
    every = np.lexsort((places, _column(index, "round")))
    ends = np.cumsum([part.table.num_rows for part in index.sets])
    for number, (part, first, share) in enumerate(zip(index.sets, index.offsets, index.shares, strict=True)):
        own = every[(every >= ends[number] - part.table.num_rows) & (every < ends[number])]
        shape = (part.rounds, part.places)
        expected = np.tile(first + np.arange(part.places), part.rounds)
        if not np.array_equal(places[own], expected):
            raise DataError(
                f"{part.root}: a round of the index does not hold each place once; prepare the shards again"
            )
        at = np.arange(turn * share, (turn + 1) * share)  # the set's places, endlessly one round after the other
        order = np.argsort(random(part.places, "turns", seed, number), kind="stable")
        chosen.append(own.reshape(shape)[at // part.places % part.rounds, order[at % part.places]])
    rows = np.concatenate(chosen).astype(np.int64)
    return rows[np.argsort(places[rows], kind="stable")]


def _ordered(
    index: ShardIndex, rows: Rows, keys: NDArray[np.uint64], seed: int, turn: int, size: int, order: Order, window: int
) -> Rows:
    """Batches [steps, size] of the rows of a pass; `keys` shuffle them."""
    if order == "mixed":
        return rows[np.argsort(keys, kind="stable")].reshape(-1, size)
    if order == "blocked":
        windows = _shuffled_groups(_column(index, "shard")[rows], "shards", seed, turn) // window
        return rows[np.lexsort((keys, windows))].reshape(-1, size)
    return _shuffled(_in_cities(index, rows, keys, size, seed, turn), seed, turn)


def _cliques_first(
    index: ShardIndex, rows: Rows, keys: NDArray[np.uint64], seed: int, turn: int, mined: Mined
) -> tuple[NDArray[np.uint64], int]:
    """Keys that put the rows clique after clique, then the others by their own keys; and the number of members."""
    places = _column(index, "place")[rows]
    made = cliques(mined, places, keys, seed, turn).reshape(-1)
    first = np.full(index.places, len(made))
    first[made] = np.arange(len(made))
    ranked = np.empty(len(rows), np.uint64)
    ranked[np.lexsort((keys, first[places]))] = np.arange(len(rows), dtype=np.uint64)
    return ranked, len(made)


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


def _kept(total: int, left: int, seed: int, turn: int) -> NDArray[np.bool_]:
    """Which places are kept: `left` are skipped, the next ones in a fixed random order each turn.

    `left` < a batch <= total - left, so two turns in a row never skip the same place.
    """
    keep = np.ones(total, dtype=np.bool_)
    skipped = (np.arange(left) + turn * left) % total
    keep[np.argsort(random(total, "left", seed), kind="stable")[skipped]] = False
    return keep


def _shuffled(batches: Rows, seed: int, epoch: int) -> Rows:
    return batches[np.argsort(random(len(batches), "batches", seed, epoch), kind="stable")]


def _shuffled_groups(codes: Rows, *purpose: object) -> Rows:
    """Each row's group as a number 0..groups-1, the groups numbered in random order."""
    unique, codes = np.unique(codes, return_inverse=True)
    number = np.empty(len(unique), dtype=np.int64)
    number[np.argsort(random(len(unique), *purpose), kind="stable")] = np.arange(len(unique))
    return number[codes]


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
