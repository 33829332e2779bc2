"""Hard batches: properties of the mined plan over any places, and the file it is planned from."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from processes import run_ranks

from pipeline.common.errors import DataError
from pipeline.config import BackboneConfig, CrossImageConfig, DataConfig, ModelConfig
from pipeline.data.cliques import CliqueRule, Mined, cliques, mine
from pipeline.data.keyed import random
from pipeline.data.place_descriptors import PlaceDescriptors, read_descriptors
from pipeline.data.plan import plan
from pipeline.data.shard_sets import cities_of, join
from pipeline.evaluation.describe.places import describe_places
from pipeline.model.vpr import build_model
from shards.index import ShardIndex

Make = Callable[..., ShardIndex]


def unit(seed: int, shape: tuple[int, int], decimals: int = 9) -> np.ndarray:
    """Random fp16 descriptors; few decimals give many ties."""
    values = np.round(np.random.default_rng(seed).normal(size=shape), decimals) + 0.01
    return (values / np.linalg.norm(values, axis=1, keepdims=True)).astype(np.float16)


def mined_of(index: ShardIndex, seed: int, rule: CliqueRule, unknown: int = 0) -> Mined:
    """Made descriptors, and places scattered over a square of 300 m, `unknown` of them without a position."""
    points = np.random.default_rng(seed).uniform(0, 300, (index.places, 3)) * [1, 1, 0]
    points[:unknown] = np.nan
    return mine(unit(seed, (index.places, 6), 1), cities_of(index), points, rule)


rules = st.builds(
    CliqueRule, st.integers(2, 5), st.integers(4, 12), st.sampled_from([0.0, 30.0, 120.0]), st.sampled_from([0.0, 0.05])
)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.integers(1, 30), min_size=1, max_size=4), st.integers(1, 2), st.integers(1, 12), rules,
    st.integers(0, 4), st.integers(0, 9), st.data(),
)  # fmt: skip
def test_the_mined_plan(
    make_table: Make, cities: list[int], rounds: int, batch: int, rule: CliqueRule, epoch: int, seed: int,
    data: st.DataObject,
) -> None:  # fmt: skip
    """It ends; no place comes twice; nothing is lost but the tail; its cliques keep their distance; pure."""
    index = make_table(cities, rounds)
    if data.draw(st.booleans()):
        index = join((index, make_table(cities[:1])), (Fraction(1), Fraction("1.5")))
    mined = mined_of(index, seed, rule, data.draw(st.integers(0, 3)))
    batch = min(batch, int(np.bincount(plan(index, seed, 0, 1, "city").turns)[0]))  # at most the places of a pass
    planned = plan(index, seed, epoch, batch, "mined", mined=mined)
    plain = plan(index, seed, epoch, batch, "city")
    assert planned.batches.shape == plain.batches.shape and (planned.turns == plain.turns).all()
    assert (plan(index, seed, epoch, batch, "mined", mined=mined).batches == planned.batches).all()
    assert (plan(index, seed, epoch, batch, "mined").batches == plain.batches).all()  # before the first mining

    members = 0
    for turn in np.unique(planned.turns):  # the same places as in order city, each once a pass
        rows = planned.batches[planned.turns == turn]
        assert sorted(rows.reshape(-1)) == sorted(plain.batches[plain.turns == turn].reshape(-1))
        places = index.table["place"].to_numpy()[rows.reshape(-1)]
        assert len(set(places.tolist())) == len(places)
        names = np.array(index.table["city"].to_pylist())[rows]
        whole = sum(count // batch for count in Counter(names.reshape(-1).tolist()).values())
        assert sum(len(set(b.tolist())) == 1 for b in names) >= whole

        made = cliques(mined, np.sort(places), random(len(places), "places", seed, turn), seed, int(turn))
        assert made.shape[1] == rule.clique and len(set(made.reshape(-1).tolist())) == made.size
        members += made.size
        city = cities_of(index)
        for clique in made:
            assert len(set(city[clique].tolist())) == 1 and set(clique) <= set(places)
            assert set(clique[1:]) <= set(mined.near[clique[0]])  # all are neighbours of the first
            apart = np.linalg.norm(mined.points[clique][:, None] - mined.points[clique][None], axis=2)
            assert not (apart + np.eye(rule.clique) * 1e9 < rule.radius).any()
    assert planned.in_cliques == members and plain.in_cliques == 0


@settings(max_examples=20, deadline=None)
@given(st.integers(2, 40), st.integers(1, 50), st.integers(0, 99))
def test_neighbours_are_exact_and_ties_go_to_the_smaller_place(count: int, k: int, seed: int) -> None:
    values = unit(seed, (count, 4), 0)
    city = np.random.default_rng(seed).integers(0, 2, count)
    found = mine(values, city, np.zeros((count, 3)), CliqueRule(2, k, 0.0, 0.0))
    whole = [[Fraction(float(x)) for x in row] for row in values]
    for place in range(count):
        exact = {
            other: round(sum(a * b for a, b in zip(whole[place], whole[other], strict=True)) * 1024)
            for other in range(count)
            if other != place and city[other] == city[place]
        }
        expected = sorted(exact, key=lambda other: (-exact[other], other))[:k]
        assert found.near[place].tolist() == expected + [-1] * (k - len(expected))
        assert found.similarity[place, : len(expected)].tolist() == [exact[other] for other in expected]


def test_similarities_do_not_depend_on_the_order_of_summation() -> None:
    """Why the plan is the same whatever library multiplies: permuted dimensions give the same bits in float64."""
    values = unit(0, (300, 256)).astype(np.float64)
    straight = torch.from_numpy(values) @ torch.from_numpy(values).T
    turned = values[:, np.random.default_rng(1).permutation(256)]
    assert (straight.numpy() == np.einsum("id,jd->ij", turned, turned)).all()


def test_batches_hold_places_that_look_alike(make_table: Make) -> None:
    """Of ten kinds of places each batch has few; a batch of order city has most of them."""
    index = make_table([200, 100])
    kind = np.random.default_rng(0).integers(0, 10, 300)
    values = unit(1, (10, 32))[kind].astype(np.float64) + 0.05 * unit(2, (300, 32))
    values = (values / np.linalg.norm(values, axis=1, keepdims=True)).astype(np.float16)
    far = np.arange(300)[:, None] * [1000.0, 0.0, 0.0]
    mined = mine(values, cities_of(index), far, CliqueRule(4, 64, 25.0, 0.02))

    def kinds(batches: np.ndarray) -> float:
        return float(np.mean([len(set(kind[batch].tolist())) for batch in batches]))

    hard = plan(index, 0, 1, 8, "mined", mined=mined).batches
    assert kinds(hard) < 3.5 < 5 < kinds(plan(index, 0, 1, 8, "city").batches)
    again = plan(index, 0, 2, 8, "mined", mined=mined).batches  # another epoch draws others from the same file
    assert {frozenset(b.tolist()) for b in hard} != {frozenset(b.tolist()) for b in again}
    near = dataclasses.replace(mined, points=np.zeros((300, 3)))  # all on one spot: no clique, the order of city
    assert (plan(index, 0, 1, 8, "mined", mined=near).batches == plan(index, 0, 1, 8, "city").batches).all()


def test_the_file(tmp_path: Path) -> None:
    values = unit(0, (5, 8))
    told = PlaceDescriptors(values, "i" * 64, "single", "w", 3)
    path = tmp_path / "mined" / "a.safetensors"
    told.save(path)
    first = path.read_bytes()
    told.save(path)
    assert path.read_bytes() == first  # equal descriptors, equal bytes
    found = read_descriptors(path, "i" * 64, 5, told.sha256)
    assert (found.values == values).all() and found.sha256 == told.sha256 and found.round == 3
    for kind in ({"kind": "bank"}, {"weights": "x"}, {"round": 4}, {"values": values[::-1]}):
        assert dataclasses.replace(told, **kind).sha256 != told.sha256  # type: ignore[arg-type]
    refused = [
        (path, "j" * 64, 5, "", "was mined from other shards"),
        (path, "i" * 64, 6, "", "was mined from other shards"),
        (path, "i" * 64, 5, "0" * 64, "is not the file that this run was planned from"),
        (tmp_path / "none", "i" * 64, 5, "", "missing"),
    ]
    for at in (len(first) - 1, len(first) // 2, first.index(b"single"), 0):
        changed = tmp_path / f"changed{at}"
        changed.write_bytes(first[:at] + bytes([first[at] ^ 1]) + first[at + 1 :])
        refused.append((changed, "i" * 64, 5, "", "has changed|not a file of place descriptors|no usable descriptor"))
    for file, index, places, digest, message in refused:
        with pytest.raises(DataError, match=message):
            read_descriptors(file, index, places, digest)


@pytest.mark.parametrize("wrong", [0.0, np.nan, 2.0])
def test_a_place_without_a_descriptor_is_refused(wrong: float) -> None:
    values = unit(0, (5, 8))
    values[3] = wrong
    with pytest.raises(DataError, match=r"1 of 5 places .* place 3"):
        PlaceDescriptors(values, "", "single", "", 0)


def test_a_photo_that_breaks_on_rank_1_ends_mining_on_all_ranks(tmp_path: Path, make_set: Make) -> None:
    """Ranks describe 8 places each in turn, so place 10 is rank 1's; nobody waits for it."""
    index = make_set(tmp_path / "set", [20], damage="000010.2.jpg")
    backbone = BackboneConfig(name="custom", dim=16, depth=1, heads=2, patch=7, pretrain_grid=4)
    config = ModelConfig(backbone=backbone, cross_image=CrossImageConfig(layers=1, heads=2, feedforward=16))
    model = build_model(config, 28)

    def work() -> str:
        data = DataConfig(image_size=28, workers=0)
        with pytest.raises(DataError) as error:
            describe_places(model, index, data, "single", 0, torch.device("cpu"), nullcontext, temporary=tmp_path)
        return str(error.value)

    told = run_ranks(work, 2)
    assert told[0] == told[1] and "rank 1: " in told[0] and "member 000010.2.jpg" in told[0]
