"""What stands in MLflow: all that a run leaves, no password; records that another tool has deleted; a working directory
in which nothing may appear."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path

import pytest

from pipeline.common.errors import UsageError
from pipeline.config import DataConfig, EvaluationConfig, RunConfig, TrackingConfig, changed, recorded, to_dict
from pipeline.training.records.tracking import (
    Tracker,
    how_to_open,
    open_client,
    record_curves,
    record_evaluation,
    store_uri,
)


@pytest.fixture(scope="module")
def new_store(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A store without records; MLflow takes seconds to make one."""
    file = tmp_path_factory.mktemp("store") / "mlflow.db"
    open_client(f"sqlite:///{file}")
    return file.read_bytes()


def test_deleted_records_and_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], new_store: bytes
) -> None:
    (tmp_path / "outputs").mkdir()
    (tmp_path / "outputs" / "mlflow.db").write_bytes(new_store)
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


def test_what_a_finished_run_leaves_in_mlflow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], new_store: bytes
) -> None:
    """Description with the best recall, log, logged model with its recall, a registered version, an evaluation at
    step 0 with its curves, the training's curves."""
    import mlflow

    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    (tmp_path / "mlflow.db").write_bytes(new_store)
    config = RunConfig(name="whole", output=str(tmp_path), tracking=TrackingConfig(register="city"))
    folder = tmp_path / "whole"
    (folder / "evaluation/figures").mkdir(parents=True)
    tracker = Tracker(config)
    for name, text in (
        ("config.json", json.dumps(recorded(config))), ("mlflow_run_id", tracker.run_id), ("train.log", "step 1"),
        ("curves.png", "x"), ("evaluation/report.html", "r"), ("evaluation/figures/city.curves.png", "c"),
    ):  # fmt: skip
        (folder / name).write_text(text)
    recalls = {"validation/town.single.recall_at_1": 41.25, "validation/town.single.recall_at_5": 62.5}
    tracker.checkpoint(folder / "checkpoints/step-3", 3, recalls)
    written: list[Path] = []

    def write(target: Path) -> None:
        (target / "model.safetensors").write_bytes(b"weights")
        written.append(target)

    tracker.finished(write)
    tracker.finished(write)  # a second version
    tracker.close("FINISHED")
    record_curves(folder, folder / "curves.png")
    asked = {"town.single.recall_at_1": 44.0}
    assert record_evaluation(folder, {"mlflow_run_id": tracker.run_id, "step": 3}, asked, folder / "evaluation")

    client, uri = tracker._client, tracker.uri
    run = client.get_run(tracker.run_id)
    about = run.data.tags["mlflow.note.content"]
    assert "| best recall | R@1 41.2, R@5 62.5 on town (single), step 3 |" in about
    assert f"`python -m jobs.train --config {folder / 'config.json'} --name NEW_NAME`" in about
    (point,) = client.get_metric_history(tracker.run_id, "evaluation/town.single.recall_at_1")
    assert (point.step, point.value, run.data.tags["evaluated_step"]) == (0, 44.0, "3")
    kept = {a.path for name in ("training", "evaluation") for a in client.list_artifacts(tracker.run_id, name)}
    assert kept == {"training/train.log", "training/curves.png", "evaluation/report.html", "evaluation/city.curves.png"}
    (model,) = client.search_logged_models([run.info.experiment_id])
    assert {m.key: m.value for m in model.metrics} == recalls

    assert [v.version for v in client.search_model_versions("name = 'city'")] == [2, 1]
    version = client.get_model_version("city", "2")
    assert (version.run_id, version.description, version.tags) == (tracker.run_id, about, {"step": "3"})
    assert "registered in MLflow: city, version 2" in capsys.readouterr().err
    assert not written[0].exists(), "the temporary copy is gone"
    mlflow.set_tracking_uri(uri)
    try:
        found = mlflow.artifacts.download_artifacts("models:/city/2", dst_path=str(tmp_path / "fetched"))
    finally:
        mlflow.set_tracking_uri(None)
    assert (Path(found) / "model.safetensors").read_bytes() == b"weights"


def test_passwords_in_urls_go_into_no_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, new_store: bytes) -> None:
    """Not into parameters, tags and artifacts, errors, and the settings that are printed; the user's own stay whole."""
    for name in ("MLFLOW_TRACKING_URI", "MLFLOW_TRACKING_USERNAME", "MLFLOW_TRACKING_PASSWORD"):
        monkeypatch.setenv(name, "")
    (tmp_path / "mlflow.db").write_bytes(new_store)
    data = DataConfig(shards=("ftp://me:s3cret@far.example/a", "b"))
    config = RunConfig(name="quiet", output=str(tmp_path), data=data)
    config = dataclasses.replace(config, validate=EvaluationConfig(root="sftp://me:s3cret@far.example/data"))
    tracker = Tracker(config)
    tracker.checkpoint(tmp_path / "x", 1, {"validation/a.single.recall_at_1": 1.0})
    tracker.close("FINISHED")
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert any(path.name == "config.yaml" for path in files) and any(path.name == "mlflow.db" for path in files)
    assert not [path for path in files if b"s3cret" in path.read_bytes()]
    assert "ftp://far.example/a" in tracker._client.get_run(tracker.run_id).data.params["data.shards"]
    assert to_dict(config)["data"]["shards"][0] == "ftp://me:s3cret@far.example/a"
    assert changed(config, RunConfig())["data.shards"] == ["ftp://far.example/a", "b"]

    assert store_uri("https://me:s3%20cret@far.example/ml", "outputs") == "https://far.example/ml"
    assert (os.environ["MLFLOW_TRACKING_USERNAME"], os.environ["MLFLOW_TRACKING_PASSWORD"]) == ("me", "s3 cret")
    monkeypatch.setenv("MLFLOW_TRACKING_PASSWORD", "")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "https://me:again@far.example/ml")
    assert store_uri("https://far.example/ml", "outputs") == "https://far.example/ml", "as a record has it"
    assert os.environ["MLFLOW_TRACKING_PASSWORD"] == "again"
    assert "s3cret" not in str(UsageError("postgresql://me:s3cret@far/ml cannot be used"))
    assert "s3cret" not in how_to_open("postgresql://me:s3cret@far/ml")
