"""Records that another tool has deleted, and a working directory in which nothing may appear."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from pipeline.common.errors import UsageError
from pipeline.config import RunConfig
from pipeline.training.records.tracking import Tracker


def test_deleted_records_and_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    config = dataclasses.replace(RunConfig(), name="recorded", output=str(tmp_path / "outputs"))
    first = Tracker(config)
    first.metrics({"train/loss": 0.5}, 1)
    first.close("FINISHED")
    client = first._client
    assert client.get_run(first.run_id).info.status == "FINISHED"
    assert client.get_metric_history(first.run_id, "train/loss")[0].value == 0.5

    assert Tracker(config, first.run_id).run_id == first.run_id, "it goes on in its own"
    client.delete_run(first.run_id)
    for gone in (first.run_id, "0" * 32):
        second = Tracker(config, gone)
        assert second.run_id not in (first.run_id, gone)
        assert f"warning: the MLflow run {gone}" in capsys.readouterr().err
        second.close("FINISHED")

    experiment = client.get_run(second.run_id).info.experiment_id
    client.delete_experiment(experiment)
    with pytest.raises(UsageError, match=f"was deleted: bring it back .mlflow experiments restore -x {experiment}"):
        Tracker(config, second.run_id)
    assert not list(elsewhere.iterdir())
