"""Rounds: which images a place shows, for any number of images and rounds."""

from __future__ import annotations

import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shards.rounds import draw, permutation, rank, shown

names = st.lists(st.text(min_size=1, max_size=12), min_size=1, max_size=37, unique=True)


@given(n=st.integers(4, 60), round_=st.integers(0, 200))
def test_a_round_shows_four_different_images(n: int, round_: int) -> None:
    chosen = draw(n, round_)
    assert len(set(chosen)) == 4
    assert set(chosen) <= set(range(n))


@given(n=st.integers(4, 60))
def test_the_first_rounds_show_every_image(n: int) -> None:
    needed = -(-n // 4)
    assert {i for r in range(needed) for i in draw(n, r)} == set(range(n))


@given(n=st.integers(0, 60), rounds=st.integers(1, 20))
def test_shown_counts_what_the_draws_show(n: int, rounds: int) -> None:
    drawn = {i for r in range(rounds) for i in draw(n, r)} if n >= 4 else set()
    assert shown(n, rounds) == len(drawn)


@given(n=st.integers(4, 60), rounds=st.integers(1, 30))
def test_images_are_shown_equally_often(n: int, rounds: int) -> None:
    times = [0] * n
    for r in range(rounds):
        for i in draw(n, r):
            times[i] += 1
    assert max(times) - min(times) <= 1


@given(images=names, seed=st.integers(0, 2**63), data=st.data())
def test_the_permutation_does_not_depend_on_the_order_given(images: list[str], seed: int, data: st.DataObject) -> None:
    order = permutation(seed, "PRS", "7", images)
    assert sorted(order) == list(range(len(images)))
    shuffled = data.draw(st.permutations(images))
    again = permutation(seed, "PRS", "7", shuffled)
    assert [images[i] for i in order] == [shuffled[i] for i in again]


@given(images=names.filter(lambda n: len(n) > 1), seed=st.integers(0, 1000))
def test_a_lost_image_moves_no_other(images: list[str], seed: int) -> None:
    whole = [images[i] for i in permutation(seed, "c", "p", images)]
    fewer = images[1:]
    assert [fewer[i] for i in permutation(seed, "c", "p", fewer)] == [name for name in whole if name != images[0]]


def test_under_four_images_are_refused() -> None:
    with pytest.raises(ValueError, match="needs 4"):
        draw(3, 0)


def test_seeds_and_places_shuffle_differently() -> None:
    images = [str(i) for i in range(20)]
    orders = {tuple(permutation(seed, "c", place, images)) for seed in range(5) for place in ("1", "2", "3")}
    assert len(orders) == 15


def test_the_hash_is_the_same_in_every_process() -> None:
    """Python's own hash() is not: it is salted."""
    code = "from shards.rounds import rank; print(rank(3, 'PRS', '7', 'ä').hex())"
    told = {subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() for _ in "ab"}
    assert told == {rank(3, "PRS", "7", "ä").hex()}
