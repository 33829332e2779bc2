"""The plan: properties over any set, batch, order, world size and cursor, and its bytes on every platform."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import time
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.common.errors import DataError, UsageError
from pipeline.config import DataConfig
from pipeline.data.places import build_loader
from pipeline.data.plan import Order, plan
from shards.index import ShardIndex

Make = Callable[..., ShardIndex]
ORDERS = ("city", "mixed", "blocked")
any_order = st.sampled_from(ORDERS)
any_cities = st.lists(st.integers(1, 40), min_size=1, max_size=7)


@settings(max_examples=150, deadline=None)
@given(any_cities, st.integers(1, 3), st.integers(1, 24), any_order, st.integers(0, 9), st.integers(0, 5), st.data())
def test_each_place_at_most_once_and_only_the_tail_is_left(
    make_table: Make,
    cities: list[int],
    rounds: int,
    batch: int,
    order: Order,
    epoch: int,
    seed: int,
    data: st.DataObject,
) -> None:
    index = make_table(cities, rounds)
    total = sum(cities)
    batch = min(batch, total)
    planned = plan(index, seed, epoch, batch, order, window_shards=2)
    assert planned.batches.shape == (total // batch, batch) and planned.batches.dtype == np.int64
    assert planned.left_over == total % batch
    rows = index.table.take(planned.batches.reshape(-1)).to_pydict()
    assert set(rows["round"]) == {epoch % rounds}
    assert len(set(rows["place"])) == len(rows["place"]) == total - total % batch

    # what one epoch leaves out, the next one uses
    other = plan(index, seed, epoch + 1, batch, order, window_shards=2).batches.reshape(-1)
    assert set(rows["place"]) | set(index.table.take(other).to_pydict()["place"]) == set(range(total))

    # joined slices of the ranks are the plan, for each world size that divides the batch
    world = data.draw(st.sampled_from([w for w in range(1, batch + 1) if batch % w == 0]))
    for step in range(len(planned.batches)):
        joined = np.concatenate([planned.slice(step, rank, world) for rank in range(world)])
        assert (joined == planned.batches[step]).all()


@pytest.mark.filterwarnings("ignore:This DataLoader will create")
@settings(max_examples=60, deadline=None)
@given(any_cities, st.integers(1, 12), any_order, st.integers(0, 4), st.integers(0, 3), st.data())
def test_a_cursor_resumes_with_exactly_the_rest(
    make_table: Make, cities: list[int], batch: int, order: Order, epoch: int, workers: int, data: st.DataObject
) -> None:
    """Any world size and number of workers before the kill, any other after it: each planned place once, in order."""
    index = make_table(cities)
    batch = min(batch, sum(cities))
    worlds = st.sampled_from([w for w in range(1, batch + 1) if batch % w == 0])
    config = DataConfig(places_per_batch=batch, order=order, workers=workers)
    steps = len(plan(index, 3, epoch, batch, order).batches)
    cursor = data.draw(st.integers(0, steps))

    def visited(start: int, world: int) -> list[list[str]]:
        """Keys of each global batch from `start` on, joined over the ranks."""
        ranks = []
        for rank in range(world):
            loader = build_loader(index, config, 3, epoch, start, rank, world)
            sampled = list(loader._loader.batch_sampler)  # type: ignore[arg-type]
            assert len(loader) == len(sampled) == steps - start
            ranks.append([[loader.dataset.found.samples[i] for i in positions] for positions in sampled])
        return [list(itertools.chain(*parts)) for parts in zip(*ranks, strict=True)]

    before, after = data.draw(worlds), data.draw(worlds)
    expected = [index.table.take(rows).to_pydict()["sample"] for rows in plan(index, 3, epoch, batch, order).batches]
    assert visited(0, before)[:cursor] + visited(cursor, after) == expected


@settings(max_examples=60, deadline=None)
@given(any_cities, st.integers(1, 16), st.integers(0, 5))
def test_city_batches_stay_in_one_city_where_they_can(
    make_table: Make, cities: list[int], batch: int, epoch: int
) -> None:
    index = make_table(cities)
    batch = min(batch, sum(cities))
    names = np.array(index.table.column("city").to_pylist())
    batches = names[plan(index, 0, epoch, batch, "city").batches]
    used = Counter(batches.reshape(-1).tolist())
    one_city = sum(len(set(b.tolist())) == 1 for b in batches)
    assert one_city == sum(count // batch for count in used.values())


@settings(max_examples=60, deadline=None)
@given(any_cities, st.integers(1, 16), st.integers(1, 4), st.integers(0, 5))
def test_blocked_needs_no_more_than_a_window_of_shards_at_once(
    make_table: Make, cities: list[int], batch: int, window: int, epoch: int
) -> None:
    index = make_table(cities, samples_a_shard=8)
    rows = plan(index, 0, epoch, min(batch, sum(cities)), "blocked", window).batches.reshape(-1)
    shards = np.array(index.table.column("shard").to_pylist())[rows]
    uses = [np.flatnonzero(shards == name) for name in set(shards.tolist())]
    for position in range(len(shards)):  # a shard is needed from its first to its last use
        assert sum(use[0] <= position <= use[-1] for use in uses) <= window


@pytest.mark.parametrize("order", ORDERS)
def test_seed_and_epoch_change_the_order_and_nothing_else_does(make_table: Make, order: Order) -> None:
    index = make_table([50, 31, 20])
    first = plan(index, 0, 0, 8, order).batches
    assert (first == plan(index, 0, 0, 8, order).batches).all()
    assert (first != plan(index, 0, 1, 8, order).batches).any()
    assert (first != plan(index, 1, 0, 8, order).batches).any()
    # the rows' order in the table: the same places come
    turned = dataclasses.replace(index, table=index.table.take(np.arange(101)[::-1]))
    again = plan(turned, 0, 0, 8, order).batches
    assert turned.table.take(again.reshape(-1))["place"].equals(index.table.take(first.reshape(-1))["place"])


def test_places_are_left_out_equally_often(make_table: Make) -> None:
    index = make_table([37, 20])
    left = Counter(dict.fromkeys(range(57), 0))
    for epoch in range(57):
        left.update(set(range(57)) - set(plan(index, 0, epoch, 10, "mixed").batches.reshape(-1).tolist()))
    assert set(left.values()) == {7}


def test_the_plan_is_the_same_on_every_platform(make_table: Make) -> None:
    """A change of these digests breaks the resuming of running trainings."""
    index = make_table([40, 25, 10, 3], rounds=2)
    found = {
        o: hashlib.sha256(plan(index, 7, 5, 8, o, 2).batches.astype("<i8").tobytes()).hexdigest()[:16] for o in ORDERS
    }
    assert found == {"city": "0aba6d990d686f2d", "mixed": "53cc7a709e4107da", "blocked": "00c8d0d73bd3c8b9"}


def test_a_full_size_epoch_is_planned_at_once(make_table: Make) -> None:
    index = make_table([2498] * 23, rounds=2, samples_a_shard=500)  # 57,454 places, as many as GSV-Cities
    for order in ORDERS:
        start = time.perf_counter()
        assert plan(index, 0, 1, 72, order).batches.shape == (797, 72)
        assert time.perf_counter() - start < 1.0


def test_impossible_plans_are_refused_in_one_line(make_table: Make) -> None:
    index = make_table([5, 4])
    with pytest.raises(UsageError, match=r"places_per_batch is 10.*only 9 places"):
        plan(index, 0, 0, 10, "city")
    with pytest.raises(UsageError, match=r"data.order is 'random'; choose one of city, mixed, blocked"):
        plan(index, 0, 0, 4, "random")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="not a multiple of the 3 processes"):
        build_loader(index, DataConfig(places_per_batch=4), 0, 0, 0, 0, 3)
    with pytest.raises(UsageError, match="2 steps; it cannot start at step 3"):
        build_loader(index, DataConfig(places_per_batch=4), 0, 0, 3, 0, 1)
    twice = dataclasses.replace(index, table=index.table.take([0, 1, 1, 2]))
    with pytest.raises(DataError, match="holds a place twice"):
        plan(twice, 0, 0, 2, "city")
