"""One training over several shard sets: their places in one index, one plan and one loss.

Invariant: a set's number is part of every name (sample, city, shard) and of every place's number, so places, labels and
random keys of two sets never meet, also where both spell them alike. With one set of weight 1 nothing changes.

Weights: a pass holds every place at most once; an epoch has `passes` = the largest weight, rounded up. In each pass a
set gives weight / passes of its places, the next ones of its order, cyclically; so a weight of 0.5 shows half of the
places in an epoch and 2 shows each twice, never twice in a batch. A place that comes again shows its next round.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.common.errors import UsageError
from pipeline.config import DataConfig
from pipeline.data.cache import ShardCache
from pipeline.data.keyed import Rows
from shards.index import ShardIndex, read_index
from shards.schema import SCHEMA

PREFIXED = ("sample", "city", "shard")


@dataclass(frozen=True)
class ShardSets(ShardIndex):
    """Several shard sets as one index. Set s has the names `<s>/<name>` and the places after those of set s - 1.

    `digest` joins the digests of all sets with "+".
    """

    sets: tuple[ShardIndex, ...]
    weights: tuple[Fraction, ...]

    @cached_property
    def passes(self) -> int:
        """Passes of an epoch."""
        return max(1, math.ceil(max(self.weights)))

    @cached_property
    def offsets(self) -> tuple[int, ...]:
        """Number of the first place of each set."""
        return tuple(int(n) for n in np.cumsum([0, *(part.places for part in self.sets[:-1])]))

    @cached_property
    def shares(self) -> tuple[int, ...]:
        """Places that each set gives to a pass: the same number in all, so that all epochs have as many steps."""
        return tuple(
            max(1, round(part.places * weight / self.passes))
            for part, weight in zip(self.sets, self.weights, strict=True)
        )

    def positions(self) -> np.ndarray:
        """Latitude and longitude of each place in degrees, float64 [P, 2]; NaN where unknown.

        Raises:
            DataError: a set was made before the index had positions.
        """
        return np.concatenate([part.positions() for part in self.sets])


def rows_of_round(index: ShardIndex, turn: int) -> Rows:
    """The rows of every place [P] in round `turn` mod its set's rounds, by place number."""
    sets = index.sets if isinstance(index, ShardSets) else (index,)
    rounds = np.repeat([part.rounds for part in sets], [part.table.num_rows for part in sets])
    rows = np.flatnonzero(index.table["round"].to_numpy() == turn % np.maximum(rounds, 1))
    return np.asarray(rows[np.argsort(index.table["place"].to_numpy()[rows], kind="stable")], np.int64)


def cities_of(index: ShardIndex) -> Rows:
    """A number for the city of each place [P], by place number."""
    column = index.table["city"].take(rows_of_round(index, 0)).combine_chunks().dictionary_encode()
    return np.asarray(column.indices.to_numpy(), np.int64)


def open_shards(data: DataConfig) -> ShardIndex:
    """The shard set, or the sets, of a run.

    Raises:
        UsageError: a set twice, or weights that do not fit the sets.
        DataError: as `read_index`, for the first set that cannot be opened.
    """
    roots = (data.shards,) if isinstance(data.shards, str) else data.shards
    if data.shard_weights and len(data.shard_weights) != len(roots):
        raise UsageError(
            f"data.shard_weights has {len(data.shard_weights)} numbers for {len(roots)} sets in data.shards"
        )
    weights = tuple(Fraction(str(weight)) for weight in data.shard_weights or (1,) * len(roots))
    sets = tuple(read_index(root) for root in roots)
    if len(sets) == 1 and weights == (1,):
        return sets[0]
    for i, part in enumerate(sets):
        twin = next((other for other in sets[:i] if other.digest == part.digest), None)
        if twin is not None:
            raise UsageError(
                f"data.shards: {twin.root} and {part.root} are the same shard set (index {part.digest[:12]}); name it "
                f"once, and give it a weight of 2 in data.shard_weights to show its places twice"
            )
    return join(sets, weights)


def join(sets: tuple[ShardIndex, ...], weights: tuple[Fraction, ...]) -> ShardSets:
    """Several opened sets as one index."""
    tables, shards, places = [], [], 0
    for number, part in enumerate(sets):
        table = part.table
        for name in PREFIXED:
            column = pc.binary_join_element_wise(str(number), table[name], "/")
            table = table.set_column(table.schema.get_field_index(name), name, column)
        moved = pc.add(table["place"], pa.scalar(places, pa.int32()))
        tables.append(table.set_column(table.schema.get_field_index("place"), "place", moved).cast(SCHEMA))
        shards += [{**shard, "name": f"{number}/{shard['name']}"} for shard in part.manifest["shards"]]
        places += part.places
    counts = {
        "places": places, "rounds": max(part.rounds for part in sets), "samples": sum(len(table) for table in tables)
    }  # fmt: skip
    return ShardSets(
        " + ".join(part.root for part in sets),
        pa.concat_tables(tables).combine_chunks(),
        {"shards": shards, "counts": counts},
        "+".join(part.digest for part in sets),
        sets,
        weights,
    )


class ShardSetsCache:
    """The caches of several sets, behind one set's interface; shards are named `<set>/<name>`."""

    def __init__(self, index: ShardSets, folder: Path, limit: int) -> None:
        self.root, self.limit = index.root, limit
        self.caches = [ShardCache(part, folder, limit) for part in index.sets]

    @property
    def remote(self) -> bool:
        """Whether shards of any set must be fetched."""
        return any(cache.remote for cache in self.caches)

    @property
    def wanted(self) -> frozenset[str]:
        """Shards that are evicted only when nothing else is left."""
        return frozenset(f"{i}/{name}" for i, cache in enumerate(self.caches) for name in cache.wanted)

    @wanted.setter
    def wanted(self, names: frozenset[str]) -> None:
        for i, cache in enumerate(self.caches):
            cache.wanted = frozenset(name.partition("/")[2] for name in names if name.partition("/")[0] == str(i))

    def size(self, name: str) -> int:
        """Bytes that a shard takes in the cache; 0 where its set is on this machine."""
        cache, shard = self._of(name)
        return cache.size(shard) if cache.remote else 0

    def path(self, name: str) -> str:
        """Where a shard lies, for a person."""
        cache, shard = self._of(name)
        return cache.path(shard)

    def open(self, name: str) -> int:
        """A file descriptor of a complete shard, fetched first where needed. Raises `DataError` naming the shard."""
        cache, shard = self._of(name)
        return cache.open(shard)

    def fetch(self, name: str) -> None:
        """Puts a shard of a remote set into the cache."""
        cache, shard = self._of(name)
        if cache.remote:
            cache.fetch(shard)

    def _of(self, name: str) -> tuple[ShardCache, str]:
        number, _, shard = name.partition("/")
        return self.caches[int(number)], shard


def cache_of(index: ShardIndex, folder: Path, limit: int) -> ShardCache | ShardSetsCache:
    """The shards of one set or several as local files; `limit` bytes are for all of them together."""
    kind = ShardSetsCache if isinstance(index, ShardSets) else ShardCache
    return kind(index, folder, limit)  # type: ignore[arg-type]
