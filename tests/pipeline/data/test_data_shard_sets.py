"""Several shard sets in one plan: places never confused, weights exact, real photos of the right set on every rank."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.common.errors import DataError, UsageError
from pipeline.config import DataConfig
from pipeline.data import shard_sets
from pipeline.data.places import Batch, build_loader
from pipeline.data.plan import Order, plan
from pipeline.data.shard_sets import join, open_shards
from shards.index import ShardIndex

Make = Callable[..., ShardIndex]
one_set = st.tuples(
    st.lists(st.integers(1, 12), min_size=1, max_size=3), st.integers(1, 3), st.sampled_from(["0.3", "0.5", "1", "2.5"])
)


@settings(max_examples=40, deadline=None)
@given(st.lists(one_set, min_size=1, max_size=3), st.integers(1, 9), st.integers(0, 3), st.data())
def test_weights_show_every_place_equally_often_and_never_twice_in_a_pass(
    make_table: Make, given_sets: list[tuple[list[int], int, str]], batch: int, seed: int, data: st.DataObject
) -> None:
    sets = tuple(make_table(cities, rounds, 4) for cities, rounds, _ in given_sets)
    index = join(sets, tuple(Fraction(weight) for *_, weight in given_sets))
    order: Order = data.draw(st.sampled_from(["city", "mixed", "blocked"]))
    batch = min(batch, sum(index.shares))
    # places are left out only where the batch does not divide a pass: with batch 1 all of the plan is seen
    for size in {1, batch}:
        uses: Counter[int] = Counter(dict.fromkeys(range(index.places), 0))
        rounds: dict[int, list[int]] = {}
        for epoch in range(4):
            planned = plan(index, seed, epoch, size, order)
            steps = sum(index.shares) // size
            assert planned.batches.shape == (steps * index.passes, size)
            for number in range(index.passes):
                part = planned.batches[number * steps : (number + 1) * steps].reshape(-1)
                assert set(planned.turns[number * steps : (number + 1) * steps]) == {epoch * index.passes + number}
                rows = index.table.take(part).to_pydict()
                assert len(set(rows["place"])) == len(rows["place"])
                for place, round_ in zip(rows["place"], rows["round"], strict=True):
                    uses[place] += 1
                    rounds.setdefault(place, []).append(round_)
                if size == 1:
                    assert Counter(name.split("/")[0] for name in rows["sample"]) == Counter(
                        {str(i): share for i, share in enumerate(index.shares)}
                    )
        if size == 1:
            for part, first in zip(index.sets, index.offsets, strict=True):
                own = [uses[place] for place in range(first, first + part.places)]
                assert max(own) - min(own) <= 1
                for place in range(first, first + part.places):  # round after round, cyclically
                    assert all((b - a) % part.rounds == 1 % part.rounds for a, b in pairwise(rounds.get(place, [])))


def test_one_set_in_a_list_is_that_set(tmp_path: Path, make_set: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    sets = {str(tmp_path / name): make_set(tmp_path / name, [3, 4]) for name in ("a", "b")}
    monkeypatch.setattr(shard_sets, "read_index", sets.__getitem__)
    a, b = sets
    assert open_shards(DataConfig(shards=(a,))) is open_shards(DataConfig(shards=a)) is sets[a]
    assert open_shards(DataConfig(shards=(a, b))).digest == f"{sets[a].digest}+{sets[b].digest}"
    for shards, weights, message in (
        ((a, a), (), r"a and .*a are the same shard set .* weight of 2"),
        ((a, b), (1.0,), "1 numbers for 2 sets"),
        ((a, b), (1.0, 0.0), "shard_weights must be"),
        ((a, b), (1.0, float("nan")), "shard_weights must be"),
        ((), (), "shards must be"),
    ):
        with pytest.raises(UsageError, match=message):
            open_shards(DataConfig(shards=shards, shard_weights=weights))


def test_photos_and_labels_come_from_the_right_set(tmp_path: Path, make_set: Make) -> None:
    """Two sets spell cities, places and samples alike; batches of 2 ranks joined are those of one process."""
    sets = (make_set(tmp_path / "a", [5, 3]), make_set(tmp_path / "b", [4], 3))
    index = join(sets, (Fraction(1), Fraction(2)))
    data = DataConfig(places_per_batch=4, image_size=28, augment="light", workers=0)

    def batches(world: int) -> list[list[Batch]]:
        return [list(build_loader(index, data, 1, 0, 0, rank, world)) for rank in range(world)]

    (whole,), ranks = batches(1), batches(2)
    assert len(whole) == 4  # two passes of half of a's 8 places and all 4 of b's
    for step, batch in enumerate(whole):
        parts = [rank[step] for rank in ranks]
        assert torch.equal(batch.images, torch.cat([part.images for part in parts]))
        assert torch.equal(batch.labels, torch.cat([part.labels for part in parts]))
    plain = dataclasses.replace(data, augment="off", places_per_batch=1)
    truth = {  # photos by set and place, from each set alone
        (number, int(batch.labels[0])): batch.images
        for number, part in enumerate(sets)
        for batch in build_loader(part, plain, 0, 0, 0, 0, 1)
    }
    seen: Counter[int] = Counter()
    for batch in build_loader(index, plain, 0, 0, 0, 0, 1):
        label, number = int(batch.labels[0]), int(batch.keys[0].split("/")[0])
        assert (label >= 8) == (number == 1)
        assert torch.equal(batch.images, truth[number, label - 8 * number])
        seen[label] += 1
    assert seen == Counter({**dict.fromkeys(range(8), 1), **dict.fromkeys(range(8, 12), 2)})
    # a place that comes twice in an epoch is augmented in two ways, also where it has one round
    twice = [
        b for b in build_loader(index, dataclasses.replace(plain, augment="light"), 0, 0, 0, 0, 1) if b.labels[0] == 9
    ]
    assert len(twice) == 2 and not torch.equal(twice[0].images, twice[1].images)


def test_an_error_names_the_shard_of_its_set(tmp_path: Path, make_set: Make) -> None:
    index = join((make_set(tmp_path / "a", [4]), make_set(tmp_path / "b", [4], 4, "000002.1.jpg")), (Fraction(1),) * 2)
    data = DataConfig(places_per_batch=2, image_size=28, workers=0)
    with pytest.raises(DataError, match=r"/b/round0-0000.tar: member 000002\.1\.jpg of sample 000002"):
        list(build_loader(index, data, 0, 0, 0, 0, 1))


def test_sets_in_the_cache_and_on_this_machine(tmp_path: Path, make_set: Make) -> None:
    """One set is fetched, the other read in place; a cache that holds the fetched one is enough."""
    here, there = make_set(tmp_path / "a", [6]), make_set(tmp_path / "b", [6])
    away = dataclasses.replace(there, root=f"file-away://{tmp_path / 'b'}")
    data = DataConfig(places_per_batch=3, image_size=28, workers=0, cache=str(tmp_path / "cache"), cache_gb=1.0)
    expected = [b.images for b in build_loader(join((here, there), (Fraction(1),) * 2), data, 0, 0, 0, 0, 1)]
    import fsspec
    from fsspec.implementations.local import LocalFileSystem

    class Away(LocalFileSystem):
        protocol = "file-away"

        @classmethod
        def _strip_protocol(cls, path: Any) -> Any:
            return LocalFileSystem._strip_protocol(str(path).removeprefix("file-away://"))

    fsspec.register_implementation("file-away", Away, clobber=True)
    found = [b.images for b in build_loader(join((here, away), (Fraction(1),) * 2), data, 0, 0, 0, 0, 1)]
    assert all(torch.equal(x, y) for x, y in zip(expected, found, strict=True))
    fetched = [path.name for path in (tmp_path / "cache").glob("*/*.tar")]
    assert sorted(fetched) == sorted(shard["name"] for shard in there.manifest["shards"])
