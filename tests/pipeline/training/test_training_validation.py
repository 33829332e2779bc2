"""What validation refuses before a run has cost anything."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path

import pytest

from pipeline.common.errors import UsageError
from pipeline.config import EvaluationConfig, RunConfig
from pipeline.training.validation import Validation


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
