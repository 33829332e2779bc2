"""What validation refuses before a run has cost anything."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest

from pipeline.common.errors import UsageError
from pipeline.config import EvaluationConfig, RunConfig
from pipeline.evaluation.sets.evaluation_set import EvaluationSet
from pipeline.training.validation import Validation, first


def test_a_set_that_cannot_be_scored_is_refused_at_the_start(tmp_path: Path) -> None:
    """MSLS-challenge without its ground truth: predictions could be exported, no recall could choose a checkpoint."""
    for side in ("database", "query"):
        base = tmp_path / "msls" / "test" / "athens" / side
        (base / "images").mkdir(parents=True)
        (base / "images" / f"{side}1.jpg").touch()
        with (base / "subtask_index.csv").open("w", newline="") as file:
            csv.writer(file).writerows([["key", "all"], [f"{side}1", True]])
    validate = EvaluationConfig(sets=("msls_challenge",), root=str(tmp_path))
    with pytest.raises(UsageError, match=r"validate\.sets: msls_challenge has no ground truth"):
        Validation(dataclasses.replace(RunConfig(), validate=validate), "cpu")


def test_the_first_queries_keep_their_positives() -> None:
    """Query q has the positives q + 10 and q + 11 of 24 database images, and the last of the first four has none."""
    whole = EvaluationSet(
        "town",
        [Path(f"d{row}.jpg") for row in range(24)],
        [Path(f"q{row}.jpg") for row in range(8)],
        [np.array([row + 10, row + 11]) if row != 3 else np.zeros(0, np.int64) for row in range(8)],
        "25 m",
        database_positions=np.arange(48.0).reshape(24, 2),
    )
    part = first(whole, 4)
    assert part.name == "town_first4" and part.queries == whole.queries[:4]
    assert part.database == [Path(f"d{row}.jpg") for row in (0, 10, 11, 12)]
    assert [[part.database[row].stem for row in rows] for rows in part.positives] == [
        ["d10", "d11"], ["d11", "d12"], ["d12"], [],
    ]  # fmt: skip
    assert part.database_positions is not None and part.database_positions[1].tolist() == [20.0, 21.0]
    assert first(whole, 99).queries == whole.queries
