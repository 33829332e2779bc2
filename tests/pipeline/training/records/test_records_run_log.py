"""`train.log` and its curves, and what is told of where a run is recorded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from pipeline.common.errors import UsageError
from pipeline.config import BackboneConfig, RunConfig, changed
from pipeline.training.records.comparison import load_runs
from pipeline.training.records.run_log import FEWEST, PICTURE, RunLog, draw, read
from pipeline.training.records.tracking import code_commit, how_to_open


def test_a_continued_run_has_every_step_once(tmp_path: Path) -> None:
    log = RunLog(tmp_path, 0)
    for step in (10, 20, 30):
        log.write({"train/loss": 1 / step, "train/lr": 1e-4}, step)
    with (tmp_path / "train.log").open("a") as cut:
        cut.write("step 40  train/lo")  # a kill
    log = RunLog(tmp_path, 20)  # the last checkpoint
    log.write({"train/loss": 0.5}, 30)
    assert read(tmp_path) == {
        "train/loss": [(10, 0.1), (20, 0.05), (30, 0.5)],
        "train/lr": [(10, 1e-4), (20, 1e-4)],
    }


def test_curves_are_drawn_of_enough_records(tmp_path: Path) -> None:
    log = RunLog(tmp_path, 0)
    for step in range(1, FEWEST):
        log.write({"train/loss": 2.0 / step}, step)
    assert draw(tmp_path) is None and not (tmp_path / PICTURE).exists()
    log.write({"train/loss": 0.1}, FEWEST)
    for step in (1, FEWEST):
        log.write(
            {"validation/town.single.recall_at_5": 50.0 + step, "validation/town.single.recall_at_10": 99.0}, step
        )
    assert draw(tmp_path) == tmp_path / PICTURE
    with Image.open(tmp_path / PICTURE) as picture:
        assert picture.width > picture.height > 300


def test_the_way_to_the_records_has_no_password_and_starts_no_helpers() -> None:
    local = how_to_open("sqlite:///outputs/mlflow.db", "3", "abc")
    assert local.startswith("MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false mlflow ui --workers 1 ")
    assert local.endswith("http://localhost:5000/#/experiments/3/runs/abc")
    beside = how_to_open("http://here:5000", "3", "abc", "def")
    assert beside == "http://here:5000/#/compare-runs?runs=%5B%22abc%22%2C%20%22def%22%5D&experiments=%5B%223%22%5D"
    link = how_to_open("https://me:secret@records.example:8080/ml/", "3", "abc")
    assert link == "https://records.example:8080/ml/#/experiments/3/runs/abc"
    assert len(code_commit().removesuffix("-dirty")) in (0, 40)


def test_comparing_in_a_wrong_folder_makes_nothing(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="there is no record of runs"):
        load_runs(f"sqlite:///{tmp_path / 'wrong' / 'mlflow.db'}", "place-recognition")
    assert not list(tmp_path.iterdir())


def test_settings_that_differ_are_told_by_their_names() -> None:
    config = RunConfig()
    assert changed(config, RunConfig()) == {}
    model = replace(config.model, backbone=BackboneConfig(weights="w.pth"))
    assert changed(replace(config, model=model, seed=3), config) == {"seed": 3, "model.backbone.weights": "w.pth"}
