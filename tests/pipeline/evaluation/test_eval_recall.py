"""Recall@N against a loop anybody can read, and against what other people's evaluators printed."""

from __future__ import annotations

import gzip
import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.common.errors import DataError, UsageError
from pipeline.evaluation.recall import first_hits, recall_at
from pipeline.evaluation.sets.ground_truth import within_radius
from pipeline.evaluation.sets.utm import file_positions


def read_predictions(path: Path) -> tuple[list[dict], str]:
    with gzip.open(path, "rt") as file:
        content = json.load(file)
    return content["queries"], content["results_txt"]


@pytest.mark.parametrize("method", ["cosplace", "megaloc", "mixvpr", "netvlad"])
@pytest.mark.parametrize("name", ["svox_night", "tokyo"])
def test_every_figure_printed_for_published_predictions_comes_out(shared_dir: Path, name: str, method: str) -> None:
    queries, printed = read_predictions(shared_dir / "data" / "predictions" / f"{name}__{method}.json.gz")
    photos = sorted({photo for q in queries for photo in (*q["preds"], *q["positives"])})
    row = {photo: at for at, photo in enumerate(photos)}
    predictions = np.array([[row[photo] for photo in q["preds"]] for q in queries])
    positives = [np.array([row[photo] for photo in q["positives"]], np.int64) for q in queries]
    wanted = {int(k): float(percent) for k, percent in re.findall(r"^R@(\d+): ([\d.]+)%$", printed, re.M)}
    assert set(wanted) == {1, 5, 10, 20}
    got = recall_at(predictions, positives, wanted)
    assert {k: f"{got[k]:.2f}" for k in wanted} == {k: f"{wanted[k]:.2f}" for k in wanted}
    # and from the @UTM names alone: their positives are those within 25 m
    of_database, of_queries = file_positions(map(Path, photos)), file_positions(Path(q["q"]) for q in queries)
    assert of_database is not None and of_queries is not None
    near = within_radius(of_database, of_queries, 25.0)
    assert recall_at(predictions, near, wanted) == got
    assert all(np.array_equal(np.sort(a), b) for a, b in zip(positives, near, strict=True))


def slow_recall(predictions: list[list[int]], positives: list[list[int]], k: int, drop: bool) -> float:
    asked = [(found, right) for found, right in zip(predictions, positives, strict=True) if right or not drop]
    hits = 0
    for found, right in asked:
        if any(row in right for row in found[:k]):
            hits += 1
    return 100.0 * hits / len(asked)


@settings(max_examples=150, deadline=None)
@given(
    st.integers(1, 12).flatmap(
        lambda width: st.lists(
            st.tuples(
                st.lists(st.integers(-1, 30), min_size=width, max_size=width),
                st.lists(st.integers(0, 40), max_size=6),
            ),
            min_size=1,
            max_size=20,
        )
    )
)
def test_recall_is_what_a_loop_counts(queries: list[tuple[list[int], list[int]]]) -> None:
    predictions, positives = [p for p, _ in queries], [sorted(set(g)) for _, g in queries]
    width = len(predictions[0])
    got = recall_at(np.array(predictions), [np.array(p, np.int64) for p in positives], range(1, width + 1))
    assert got == {k: pytest.approx(slow_recall(predictions, positives, k, False)) for k in range(1, width + 1)}
    if any(positives):
        dropped = recall_at(np.array(predictions), positives, [width], without_positives="drop")
        assert dropped[width] == pytest.approx(slow_recall(predictions, positives, width, True))


def test_first_hits_gives_ranks_from_zero_and_minus_one_for_a_miss() -> None:
    predictions = [[5, 3, 1], [0, 2, 4], [7, 7, 7], [-1, -1, -1]]
    assert first_hits(predictions, [[1, 5], [4], [], [0]]).tolist() == [0, 2, -1, -1]


def test_a_query_without_positives_is_a_miss_or_dropped() -> None:
    predictions, positives = np.array([[0], [1]]), [np.array([0]), np.array([], np.int64)]
    assert recall_at(predictions, positives, [1]) == {1: 50.0}
    assert recall_at(predictions, positives, [1], without_positives="drop") == {1: 100.0}
    with pytest.raises(DataError, match="no query has a positive"):
        recall_at(predictions[1:], positives[1:], [1], without_positives="drop")


def test_recall_never_falls_with_n_and_does_not_depend_on_the_order_of_positives() -> None:
    random = np.random.default_rng(3)
    predictions = random.permuted(np.tile(np.arange(60), (40, 1)), axis=1)[:, :20]
    positives = [random.choice(60, size=random.integers(0, 5), replace=False) for _ in range(40)]
    values = list(recall_at(predictions, positives, range(1, 21)).values())
    assert values == sorted(values) and values[0] < values[-1]
    assert recall_at(predictions, [p[::-1] for p in positives], range(1, 21)) == dict(enumerate(values, start=1))


@pytest.mark.parametrize(
    ("predictions", "positives", "ks", "words"),
    [
        ([[1, 2]], [[1]], [5], "recall@5 needs that many"),
        ([[1, 2]], [[1], [2]], [1], "1 queries but positives of 2"),
        ([[1, 2]], [[1]], [0], "starts at 1"),
        ([[0.5, 2.0]], [[1]], [1], "whole database rows"),
        ([1, 2], [[1], [1]], [1], "whole database rows"),
    ],
)
def test_what_cannot_be_counted_is_refused(predictions: list, positives: list, ks: list[int], words: str) -> None:
    with pytest.raises(UsageError, match=re.escape(words)):
        recall_at(predictions, positives, ks)


def test_full_size_sets_are_counted_in_a_moment() -> None:
    random = np.random.default_rng(0)
    predictions = random.integers(0, 27_592, (27_592, 100))
    positives = [np.arange(max(0, i - 10), min(27_592, i + 11)) for i in range(27_592)]
    ranks = first_hits(predictions, positives)
    near = np.abs(predictions - np.arange(27_592)[:, None]) <= 10
    assert np.array_equal(ranks, np.where(near.any(axis=1), near.argmax(axis=1), -1))
