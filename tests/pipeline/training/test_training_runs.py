"""Whole runs through the real command: resume after a kill to the bit, signals, exit codes, MLflow, dry run."""

from __future__ import annotations

import json
import os
import re
import signal
import time
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from job_process import JobProcess
from launched import Launched
from safetensors.torch import load_file
from tiny import prepare, run_settings, samples

from pipeline.training.validation import Validation


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepare(tmp_path_factory.mktemp("training"))


def config(root: Path, name: str, **changes: Any) -> Path:
    """Writes the tiny config under a run name, with `section__key=value` changes."""
    settings = {**run_settings(root), "name": name}
    for key, value in changes.items():
        section, _, inner = key.partition("__")
        if inner:
            settings[section] = {**settings[section], inner: value}
        else:
            settings[section] = value
    path = root / f"{name}.yaml"
    path.write_text(yaml.safe_dump(settings))
    return path


def start(path: Path, *overrides: str) -> JobProcess:
    return JobProcess("jobs.train", ["--config", str(path), *overrides], path.with_suffix(".log"))


def start_to_validate_slowly(path: Path) -> JobProcess:
    """A run that a signal certainly finds in a validation, if it is sent at its beginning."""
    run = Validation.run

    def slowly(self: Validation, *given: Any) -> Any:
        time.sleep(0.5)
        return run(self, *given)

    with pytest.MonkeyPatch.context() as patch:  # the forked job inherits it
        patch.setattr(Validation, "run", slowly)
        return start(path)


def train(path: Path, *overrides: str, code: int = 0) -> str:
    """One process; its output."""
    job = start(path, *overrides)
    assert job.wait() == code, job.text()[-3000:]
    return job.text()


def weights(root: Path, name: str, which: str = "last") -> dict[str, torch.Tensor]:
    return load_file(root / "outputs" / name / "checkpoints" / which / "model.safetensors")


def same_bits(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


@pytest.fixture(scope="module")
def whole(root: Path) -> str:
    """An uninterrupted run of two epochs, six steps each, on one process."""
    train(config(root, "whole"))
    return "whole"


def kill_at(root: Path, path: Path, step: int, number: int = signal.SIGKILL) -> JobProcess:
    """Starts a run and signals it once its sample log shows the step."""
    log = root / "outputs" / path.stem / "samples.rank0.jsonl"
    job = start(path)
    job.kill_when(lambda: log.exists() and f'"step": {step},' in log.read_text(), number)
    code = job.wait()
    assert code == (-number if number == signal.SIGKILL else 75), job.text()[-3000:]
    return job


@pytest.mark.parametrize("step", [1, 5])
def test_killed_and_resumed_gives_the_same_bits(root: Path, whole: str, step: int) -> None:
    """Before the first checkpoint, and between two."""
    name = f"killed{step}"
    path = config(root, name)
    kill_at(root, path, step)
    train(path)
    assert same_bits(weights(root, name), weights(root, whole))
    assert samples(root, name) == samples(root, whole)
    states = [json.loads((root / "outputs" / n / "checkpoints/last/state.json").read_text())["state"]
              for n in (name, whole)]  # fmt: skip
    assert states[0]["validated"] == states[1]["validated"]


def test_elastic_two_processes_after_one(root: Path, whole: str) -> None:
    """Started on one process, killed, continued on two: the same places in the same steps, the same weights nearly."""
    path = config(root, "elastic", model={**run_settings(root)["model"], "cross_image": {"dropout": 0.0, "layers": 1,
                  "heads": 2, "feedforward": 16}})  # fmt: skip
    reference = config(root, "elastic-reference", model=yaml.safe_load(path.read_text())["model"])
    train(reference)
    kill_at(root, path, 5)
    Launched("ddp", 2, "jobs.train", ["--config", str(path)], path.with_suffix(".log")).done()
    assert samples(root, "elastic") == samples(root, "elastic-reference") == samples(root, whole)
    one, two = weights(root, "elastic-reference"), weights(root, "elastic")
    # float32 and Adam, which divides rounding by its own size: near, and far from the distance that training moved
    difference = max((one[n] - two[n]).abs().max().item() for n in one if one[n].is_floating_point())
    assert difference < 2e-3


def test_each_epoch_shows_each_place_at_most_once(root: Path, whole: str) -> None:
    steps = samples(root, whole)
    assert sorted(steps) == list(range(1, 13))
    for epoch in (range(1, 7), range(7, 13)):
        keys = [key for step in epoch for key in steps[step]]
        assert len(keys) == len(set(keys)) == 24


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGUSR1])
def test_a_signal_saves_and_leaves_with_75(root: Path, whole: str, number: signal.Signals) -> None:
    name = f"stopped-{number.name}"
    path = config(root, name, train__save_every=1000)
    kill_at(root, path, 2, number)
    seen = max(samples(root, name))
    saved = json.loads((root / "outputs" / name / "checkpoints/last/state.json").read_text())["state"]["step"]
    assert 2 <= saved == seen <= 5, "saved at the end of the step after the one that the signal came in"
    assert json.loads((root / "outputs" / name / "status.json").read_text())["exit_code"] == 75
    train(path)
    assert same_bits(weights(root, name), weights(root, whole))


def test_workers_do_not_change_a_bit(root: Path, whole: str) -> None:
    train(config(root, "workers", data__workers=2))
    assert same_bits(weights(root, "workers"), weights(root, whole))


def test_a_finished_run_has_nothing_to_do_and_more_epochs_continue_it(root: Path, whole: str) -> None:
    path = config(root, "longer", train__epochs=1)
    train(path)
    assert "already finished" in train(path)
    train(path, "--train.epochs", "2")
    assert same_bits(weights(root, "longer"), weights(root, whole))


def test_changed_settings_are_refused_by_name(root: Path, whole: str) -> None:
    out = train(config(root, whole), "--train.lr", "0.5", code=2)
    assert "train.lr was 0.001 and is now 0.5" in out
    assert "Traceback" not in out
    assert "choose another --name" in train(config(root, whole), "--train.resume", "never", code=2)


def test_divergence_ends_with_4_and_keeps_the_last_good_checkpoint(root: Path) -> None:
    path = config(root, "diverged", train__lr=1e9, train__optimizer="sgd", validate__sets=[], train__save_every=1)
    out = train(path, code=4)
    assert re.search(r"jobs.train: .*not finite|jobs.train: the loss is nan", out)
    assert "Traceback" not in out
    saved = root / "outputs/diverged/checkpoints/last/model.safetensors"
    if saved.exists():
        assert all(torch.isfinite(t).all() for t in load_file(saved).values() if t.is_floating_point())


def test_user_mistakes_are_one_line(root: Path) -> None:
    path = config(root, "mistakes")
    cases = [
        (["--data.places_per_bach", "4"], 2, "did you mean 'data.places_per_batch'"),
        (["--data.shards", str(root / "nowhere")], 3, "nowhere"),
        (["--data.places_per_batch", "400"], 2, "400"),
        (["--validate.sets", f"[{root / 'missing'}]"], 3, "missing"),
        (["--output", str(path / "x")], 2, f"{path}/x/mistakes: the run's folder cannot be written (Not a directory)"),
    ]
    for overrides, code, wanted in cases:
        out = train(path, *overrides, code=code)
        lines = [line for line in out.splitlines() if line.startswith("jobs.train:")]
        assert len(lines) == 1
        assert wanted in lines[0]
        assert "Traceback" not in out


def test_a_broken_image_in_the_shards_stops_the_run_naming_it(root: Path, tmp_path: Path) -> None:
    import shutil

    from shards.index import read_index

    shutil.copytree(root / "shards", tmp_path / "shards")
    row = read_index(str(root / "shards")).table.slice(5, 1).to_pylist()[0]
    with (tmp_path / "shards" / row["shard"]).open("r+b") as file:
        file.seek(row["offsets"][2])
        file.write(b"\x00" * 64)
    out = train(config(root, "broken", data__shards=str(tmp_path / "shards")), code=3)
    assert f"{row['sample']}.2.jpg" in out
    assert row["shard"] in out


def test_dry_run_tells_the_plan_and_writes_nothing(root: Path) -> None:
    out = train(config(root, "dry"), "--dry-run")
    short = train(config(root, "dry"), "--dry-run", "--loss.prefixes", "8,9999", code=2)
    assert "loss.prefixes 9999: the descriptors have" in short
    assert re.search(r"epoch\s+6 steps; 0 places wait", out)
    assert re.search(r"time a step\s+about [0-9.e-]+ s of computation .*measured.* s to read its images by", out)
    assert re.search(r"time an epoch\s+about \d.* s, bound by (computation|reading)", out)
    assert re.search(r"global batch\s+4 places x 4 = 16 images", out)
    assert not (root / "outputs/dry").exists()


def test_recorded_in_mlflow_and_continued_there(root: Path) -> None:
    from mlflow import MlflowClient

    path = config(root, "recorded", tracking={"enabled": True}, train__epochs=1)
    kill_at(root, path, 5)
    train(path)
    client = MlflowClient(tracking_uri=f"sqlite:///{root / 'outputs/mlflow.db'}")
    experiment = client.get_experiment_by_name("place-recognition")
    runs = client.search_runs([experiment.experiment_id])
    assert [run.info.run_name for run in runs] == ["recorded"], "a resumed run continues its own"
    run = runs[0]
    assert run.info.status == "FINISHED"
    assert run.data.params["data.places_per_batch"] == "4"
    history = client.get_metric_history(run.info.run_id, "train/loss")
    assert {m.step for m in history} == set(range(1, 7))
    recalls = client.get_metric_history(run.info.run_id, "validation/evaluation.shuffled4_28px.recall_at_5")
    assert sorted({m.step for m in recalls}) == [0, 6]
    models = client.search_logged_models([experiment.experiment_id])
    assert any(Path(m.tags["checkpoint"]).joinpath("model.safetensors").exists() for m in models)
    artifacts = {a.path for a in client.list_artifacts(run.info.run_id)}
    assert {"config.yaml", "environment.yaml"} <= artifacts


def test_without_validation_only_the_end_is_registered(root: Path) -> None:
    """What stands in MLflow is there to be loaded: not checkpoints that later ones have replaced."""
    from mlflow import MlflowClient

    path = config(root, "unranked", tracking__enabled=True, train__keep=1)
    train(path, "--validate.sets", "[]", "--train.save_every", "2")
    client = MlflowClient(tracking_uri=f"sqlite:///{root / 'outputs/mlflow.db'}")
    experiment = client.get_experiment_by_name("place-recognition")
    models = client.search_logged_models([experiment.experiment_id])
    (model,) = (m for m in models if m.name.startswith("unranked"))
    assert model.tags["step"] == "12" and Path(model.tags["checkpoint"]).joinpath("model.safetensors").exists()


def test_a_signal_during_a_validation_is_answered_before_the_next_step(root: Path, whole: str) -> None:
    path = config(root, "signalled-validation")
    job = start_to_validate_slowly(path)
    state = root / "outputs" / path.stem / "checkpoints/last/state.json"
    job.kill_when(lambda: state.exists() and '"step": 6,' in state.read_text(), signal.SIGTERM, timeout=60)
    assert job.wait() == 75, job.text()
    left = json.loads(state.read_text())["state"]
    assert (left["step"], left["validated_step"], left["epoch"]) == (6, 6, 1)
    train(path)
    assert same_bits(weights(root, path.stem), weights(root, whole))


@pytest.mark.parametrize("changes", [{}, {"train__steps": 10}])
def test_a_kill_in_the_last_validation_does_not_lose_it(root: Path, whole: str, changes: dict[str, Any]) -> None:
    """The last step is saved before its validation; what a kill in between leaves must still be validated."""
    name = f"unvalidated{len(changes)}"
    path = config(root, name, **changes)
    train(path)
    finished = json.loads((root / "outputs" / name / "checkpoints/last/state.json").read_text())
    path = config(root, f"{name}-killed", **changes)
    job = start_to_validate_slowly(path)
    state = root / "outputs" / path.stem / "checkpoints/last/state.json"
    last = finished["state"]["step"]
    job.kill_when(lambda: state.exists() and f'"step": {last},' in state.read_text(), timeout=60)
    job.wait()
    left = json.loads(state.read_text())["state"]
    out = train(path)
    again = json.loads(state.read_text())["state"]
    assert left["validated_step"] != last, "killed too late: the validation was already saved"
    assert again["validated_step"] == last
    assert "validation" in out
    for key in ("step", "epoch", "cursor", "validated", "best", "best_step", "stale"):
        assert again[key] == finished["state"][key], key
    assert same_bits(weights(root, path.stem), weights(root, name))


def test_colleagues_can_read_a_checkpoint(root: Path, whole: str) -> None:
    mask = os.umask(0o022)
    os.umask(mask)
    files = list((root / "outputs" / whole / "checkpoints/last").iterdir())
    assert len(files) == 4 and {file.stat().st_mode & 0o777 for file in files} == {0o666 & ~mask}
