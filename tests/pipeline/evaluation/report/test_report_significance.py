"""The interval against resampling query by query, against coverage, and McNemar's test against plain binomials."""

from __future__ import annotations

import csv
import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from job_process import JobProcess

from pipeline.config import EvaluationConfig
from pipeline.evaluation.difference import interval_of, mcnemar, paired_interval
from pipeline.evaluation.evaluate import Answers, score
from pipeline.evaluation.predictions import Predictions, load_predictions, save_predictions
from pipeline.evaluation.protocol import protocols
from pipeline.evaluation.report.significance import as_text, compare_folders, differences, write_csv
from pipeline.evaluation.sets.evaluation_set import EvaluationSet

CONFIG = EvaluationConfig(recalls=(1, 5), groups=("single",))


def measured(folder: Path, ranks: np.ndarray, without: int = 0, policy: str = "miss") -> Predictions:
    """Predictions on disk and back, whose first hits are at `ranks` (-1: none in five)."""
    queries = len(ranks)
    positives = [np.array([q], np.int64) if q >= without else np.zeros(0, np.int64) for q in range(queries)]
    photos = [Path(f"/data/{q:05d}.jpg") for q in range(queries)]
    evaluated = EvaluationSet("city", photos, photos, positives, "pairs")
    rows = np.full((queries, 5), queries - 1) - np.arange(queries)[:, None] % 2  # a wrong row, but for the last two
    rows[np.arange(queries) >= queries - 2] = 0
    rows[ranks >= 0, ranks[ranks >= 0]] = np.flatnonzero(ranks >= 0)
    config = dataclasses.replace(CONFIG, without_positives=policy)  # type: ignore[arg-type]
    result = score(
        evaluated, protocols(config, 224, "pairs")[0], config, Answers(rows, np.ones((queries, 5), np.float32))
    )
    return load_predictions(save_predictions(result, evaluated, folder))


def test_equal_to_resampling_the_queries_themselves() -> None:
    rng = np.random.Generator(np.random.PCG64(1))
    gained, lost, queries = 70, 40, 600
    change = np.zeros(queries)
    change[:gained], change[gained : gained + lost] = 1, -1
    plain = [100 * change[rng.integers(0, queries, queries)].mean() for _ in range(10_000)]
    low, high = paired_interval(gained, lost, queries)
    assert (low, high) == pytest.approx(np.quantile(plain, [0.025, 0.975]), abs=0.2)
    shares = np.array([gained, lost]) / queries
    error = 100 * math.sqrt((shares.sum() - (shares[0] - shares[1]) ** 2) / queries)  # of a mean of paired differences
    assert (high - low) / 2 == pytest.approx(1.96 * error, rel=0.05)
    assert paired_interval(gained, lost, queries) == (low, high) != paired_interval(gained, lost, queries, seed=1)
    # a difference a query, as of one training; and the mean over three trainings
    assert interval_of(change) == pytest.approx((low, high), abs=0.2)
    thirds = rng.integers(-3, 4, queries) / 3
    plain = [100 * thirds[rng.integers(0, queries, queries)].mean() for _ in range(10_000)]
    assert interval_of(thirds) == pytest.approx(np.quantile(plain, [0.025, 0.975]), abs=0.3)


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    """400 experiments with a known difference of 4 points: 95 % of the intervals hold it."""
    rng = np.random.Generator(np.random.PCG64(2))
    held = 0
    for experiment in range(400):
        gained, lost, _ = rng.multinomial(500, [0.12, 0.08, 0.80])
        low, high = paired_interval(int(gained), int(lost), 500, seed=experiment, samples=1_000)
        held += low <= 4.0 <= high
    assert 0.925 < held / 400 < 0.98


@pytest.mark.parametrize(("gained", "lost"), [(5, 0), (3, 9), (9, 3), (7, 7), (0, 0), (30, 12)])
def test_mcnemar_is_the_sign_test(gained: int, lost: int) -> None:
    n = gained + lost
    as_extreme = [math.comb(n, i) for i in range(n + 1) if abs(i - n / 2) >= abs(gained - n / 2)]
    assert mcnemar(gained, lost) == pytest.approx(sum(as_extreme) / 2**n)
    assert mcnemar(3000, 2900) == pytest.approx(0.197, abs=0.003) and mcnemar(9000, 7000) < 1e-50


def test_no_difference_is_rarely_called_real() -> None:
    """Two equally good runs, disagreeing on few queries: at most one in twenty is called real."""
    rng = np.random.Generator(np.random.PCG64(3))
    real = 0
    for _ in range(300):
        gained, lost, _ = (int(n) for n in rng.multinomial(400, [0.015, 0.015, 0.97]))
        low, high = paired_interval(gained, lost, 400, samples=1_000)
        real += (low > 0 or high < 0) and mcnemar(gained, lost) < 0.05
    assert real / 300 <= 0.05


def test_differences_of_two_evaluations(tmp_path: Path) -> None:
    ranks = np.full(200, -1)
    ranks[:120], ranks[120:150] = 0, 2
    better = ranks.copy()
    better[110:140] = 0  # 20 more at first, none lost
    first, second = measured(tmp_path / "a", ranks), measured(tmp_path / "b", better)
    at_1, at_5 = differences(first, second, ("a", "b"), (1, 5, 10))
    assert at_1.recalls == (60.0, 70.0) and (at_1.gained, at_1.lost) == (20, 0) and at_1.value == pytest.approx(10)
    assert at_1.real and at_1.low > 0 and at_1.p_value == pytest.approx(2 * 0.5**20)
    assert not at_5.real and at_5.value == 0 and (at_5.low, at_5.high) == (0, 0)
    assert "R@1 60.0 -> 70.0: difference +10.0 [+6." in as_text([at_1]) and as_text([at_1]).count("real") == 1
    assert "not distinguishable" in as_text([at_5])
    (back, *_) = differences(second, first, ("b", "a"), (1,))
    assert back.value == -at_1.value and back.real and back.high < 0
    dropped = [measured(tmp_path / n, r, without=50, policy="drop") for n, r in (("c", ranks), ("d", better))]
    assert differences(*dropped, ("c", "d"), (1,))[0].queries == 150  # type: ignore[call-arg, misc]


def test_only_like_is_compared_with_like(tmp_path: Path) -> None:
    ranks = np.zeros(20, np.int64)
    for name, found in (("a", ranks), ("b/from_store", ranks), ("few", ranks[:19])):
        measured(tmp_path / name / "predictions", found)
    runs = [(name, tmp_path / name) for name in ("a", "b", "few", "none")]
    compared, notes = compare_folders(runs)
    assert [d.runs for d in compared] == [("a", "b")] * 2  # N = 1 and 5; there are no ten answers
    assert any("few was measured on other queries" in n for n in notes) and any(
        "none: no predictions" in n for n in notes
    )
    write_csv(compared, tmp_path / "differences.csv")
    with (tmp_path / "differences.csv").open() as file:
        assert [row["real"] for row in csv.DictReader(file)] == ["False"] * 2


def test_three_evaluations_against_the_first_or_each_with_each(tmp_path: Path) -> None:
    """By the job: c finds 40 more than a, b two more; the three pairs against sums of their hits."""
    hits = {"a": 60, "b": 62, "c": 100}
    for name, found in hits.items():
        ranks = np.full(200, -1)
        ranks[:found] = 0
        measured(tmp_path / name / "predictions", ranks)
    names = [str(tmp_path / name) for name in hits]
    for pairs, wanted in (("first", ["ab", "ac"]), ("all", ["ab", "ac", "bc"])):
        options = ["--evaluations", ",".join(names), "--pairs", pairs, "--output", str(tmp_path / "out")]
        job = JobProcess("jobs.compare", options, tmp_path / "log")
        assert job.wait() == 0, job.text()
        with (tmp_path / "out" / "comparison" / "differences.csv").open() as file:
            rows = [row for row in csv.DictReader(file) if row["n"] == "1"]
        assert [Path(r["first"]).name + Path(r["second"]).name for r in rows] == wanted
        for row, (one, two) in zip(rows, wanted, strict=True):
            assert float(row["difference"]) == pytest.approx((hits[two] - hits[one]) / 2)
            assert row["real"] == str(abs(hits[two] - hits[one]) > 2)
            assert float(row["low"]) <= float(row["difference"]) <= float(row["high"])
        assert job.text().count("same queries, 95 % intervals") == len(wanted)
    for options, code in ((names[:1], 2), ([*names[:1], str(tmp_path / "nothing")], 3)):
        job = JobProcess("jobs.compare", ["--evaluations", ",".join(options)], tmp_path / "log")
        assert job.wait() == code and "Traceback" not in job.text()
