"""Runs in a real MLflow store, compared: numbers as recorded, only differing settings, the best marked."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path

import pytest

from pipeline.common.errors import UsageError
from pipeline.config import RunConfig, TrackingConfig
from pipeline.evaluation.protocol import read_metric_name
from pipeline.training.records import comparison
from pipeline.training.records.tracking import Tracker, store_uri


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three runs of two names; the newer `a` replaces the older."""
    output = tmp_path_factory.mktemp("mlflow")
    base = RunConfig(output=str(output), tracking=TrackingConfig(uri=None))
    recalls = {"a-old": (10.0, 20.0), "a": (50.0, 80.5), "b": (60.0, 70.25)}
    for label, (first, fifth) in recalls.items():
        config = dataclasses.replace(base, name=label.removesuffix("-old"), seed=1 if label == "b" else 0)
        tracker = Tracker(config)
        for step, share in ((0, 0.5), (10, 1.0)):
            tracker.metrics(
                {
                    "validation/city.shuffled16.recall_at_1": share * first,
                    "validation/city.shuffled16.recall_at_5": share * fifth,
                    "evaluation/city.single.recall_at_1": share * first,
                    "evaluation/city.single.recall_at_5": share * fifth,
                    "evaluation/city.single.recall_at_10": 99.0,
                    "train/loss": 1.5 - share * first / 100,
                },
                step,
            )
        tracker.close("FINISHED")
    return output


def runs_of(store: Path, *wanted: str) -> list[comparison.Run]:
    return comparison.load_runs(store_uri(None, str(store)), "place-recognition", wanted)


def test_newest_run_of_each_name(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    runs = runs_of(store)
    assert [run.name for run in runs] == ["a", "b"]
    assert runs[0].metrics["evaluation/city.single.recall_at_5"] == 80.5
    assert runs[1].history["validation/city.shuffled16.recall_at_1"] == [(0, 30.0), (10, 60.0)]
    assert runs_of(store, runs[1].run_id, "a")[0].name == "b"


def test_table_marks_the_best_and_shows_only_what_differs(store: Path) -> None:
    runs = runs_of(store, "a", "b")
    table = comparison.table(runs)
    rows = {
        row[0]: [cell + " *" * ((i, n) in table.marked) for n, cell in enumerate(row[1:], 1)]
        for i, row in enumerate(table.rows)
    }
    assert rows["evaluation/city.single.recall_at_1"] == ["50.0", "60.0 *"]
    assert rows["evaluation/city.single.recall_at_5"] == ["80.5 *", "70.2"]
    assert rows["evaluation/city.single.recall_at_10"] == ["99.0", "99.0"], "a tie has no winner"
    assert rows["train/loss"] == ["1.0000", "0.9000 *"], "the lowest loss is the best"
    assert rows["seed"] == ["0", "1"]
    assert "data.places_per_batch" not in rows
    assert "name" not in rows
    names = [row[0] for row in table.rows]
    ordered = [n for n in names if n.startswith("evaluation/")]
    assert [n.rsplit("_", 1)[1] for n in ordered] == ["1", "5", "10"], "N in numeric order"
    assert "**60.0**" in table.markdown()
    assert next(csv.reader(table.csv().splitlines())) == ["", "a", "b"]


def test_curves_are_drawn(store: Path, tmp_path: Path) -> None:
    from PIL import Image

    assert comparison.draw_curves(runs_of(store), tmp_path / "curves.png")
    with Image.open(tmp_path / "curves.png") as picture:
        assert picture.width > 500
        assert len(picture.convert("RGB").getcolors(1 << 20) or []) > 50


def test_what_is_missing_is_named(store: Path) -> None:
    with pytest.raises(UsageError, match=r"no run 'c'; it has: a, b"):
        runs_of(store, "c")
    with pytest.raises(UsageError, match=r"no experiment 'nothing'; it has: .*place-recognition"):
        comparison.load_runs(store_uri(None, str(store)), "nothing")


def test_a_store_that_cannot_be_reached_is_an_error_at_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")  # by default three, for 12 seconds
    config = RunConfig(output=str(tmp_path), tracking=TrackingConfig(uri="http://127.0.0.1:9"))
    with pytest.raises(UsageError, match=r"MLflow store http://127\.0\.0\.1:9 cannot be used"):
        Tracker(config)


def test_names_of_sets_and_protocols_may_hold_points() -> None:
    """A radius of 12.5 m and a folder called v1.2 stand in them; a metric's name is read back as it was made."""
    for set_name, protocol in (
        ("city", "single_12.5m"),
        ("v1.2", "bank64photos.v2-0a1b2c"),
        ("a.b", "ordered8_pca4096"),
    ):
        for k in (1, 10):
            name = f"validation/{set_name}.{protocol}.recall_at_{k}"
            assert read_metric_name(name) == ("validation", set_name, protocol, k)
    assert read_metric_name("train/loss") is None and read_metric_name("evaluation/city.other.recall_at_1") is None
