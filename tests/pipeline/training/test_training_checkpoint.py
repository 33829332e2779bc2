"""Checkpoint folders: complete or absent, pruned, found, branched from; the schedule as a pure function."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import pytest
import torch

from pipeline.common.errors import DataError, UsageError
from pipeline.config import DataConfig, RunConfig, TrainConfig, flatten
from pipeline.training import checkpoint
from pipeline.training.checkpoint import RunState
from pipeline.training.schedule import learning_rate


def save(run: Path, step: int, note: str = "weights") -> Path:
    moments = {"layer.weight/exp_avg": torch.full((2,), float(step)), "layer.weight/step": torch.tensor(float(step))}
    return checkpoint.write(run, RunState(step=step), RunConfig(), lambda p: p.write_text(note) and None, moments)


def test_written_and_read(tmp_path: Path) -> None:
    path = save(tmp_path, 7)
    state, config, moments = checkpoint.read(path)
    assert state == RunState(step=7)
    assert config == flatten(RunConfig())
    assert torch.equal(moments["layer.weight/exp_avg"], torch.full((2,), 7.0))
    assert (tmp_path / "checkpoints/last").resolve() == path.resolve()


def test_a_write_that_dies_leaves_the_last_good_one(tmp_path: Path) -> None:
    save(tmp_path, 1)

    def dies(path: Path) -> None:
        path.write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        checkpoint.write(tmp_path, RunState(step=2), RunConfig(), dies, {})
    assert checkpoint.read(checkpoint.find(tmp_path, "auto") or tmp_path)[0].step == 1
    checkpoint.prune(tmp_path, keep=2)
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == ["last", "step-00000001"]


def test_the_same_step_again_replaces_it(tmp_path: Path) -> None:
    save(tmp_path, 3, "first")
    assert (save(tmp_path, 3, "second") / "model.safetensors").read_text() == "second"
    assert [p.name for p in (tmp_path / "checkpoints").glob(".*")] == []


def test_a_dangling_link_falls_back_to_the_newest_complete_folder(tmp_path: Path) -> None:
    """What a kill between the two renames of a replaced step leaves."""
    save(tmp_path, 1)
    save(tmp_path, 2).rename(tmp_path / "checkpoints" / ".replaced-step-00000002-1")
    found = checkpoint.find(tmp_path, "auto")
    assert found is not None
    assert found.name == "step-00000001"


def test_pruning_keeps_the_newest_and_the_best(tmp_path: Path) -> None:
    paths = [save(tmp_path, step) for step in (1, 2, 3, 4)]
    checkpoint.point(tmp_path, "best", paths[0])
    checkpoint.prune(tmp_path, keep=2)
    names = sorted(p.name for p in (tmp_path / "checkpoints").glob("step-*"))
    assert names == ["step-00000001", "step-00000003", "step-00000004"]


def test_finding(tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert checkpoint.find(run, "auto") is None
    assert checkpoint.find(run, "never") is None
    first = save(run, 1)
    assert checkpoint.find(tmp_path / "other", str(first)) == first.resolve()
    assert checkpoint.find(tmp_path / "other", str(run)) == first.resolve()
    with pytest.raises(UsageError, match="already holds a run"):
        checkpoint.find(run, "never")
    with pytest.raises(UsageError, match="holds no checkpoint"):
        checkpoint.find(run, str(tmp_path / "nowhere"))
    save(run, 2)
    with pytest.raises(UsageError, match="has checkpoints after step-00000001"):
        checkpoint.find(run, str(first))


def test_a_broken_checkpoint_is_named(tmp_path: Path) -> None:
    path = save(tmp_path, 1)
    (path / "optimizer.safetensors").write_bytes(b"\x00" * 20)
    with pytest.raises(DataError, match="step-00000001 cannot be read"):
        checkpoint.read(path)
    (path / "state.json").unlink()
    with pytest.raises(DataError, match=r"step-00000001 has no state\.json"):
        checkpoint.find(tmp_path, "auto")  # it would otherwise start anew in silence


def test_checkpoints_of_before_are_read_under_todays_names(tmp_path: Path) -> None:
    """Format 1: no digests, and settings that have been renamed or did not exist yet."""
    path = save(tmp_path, 5)
    told = json.loads((path / "state.json").read_text())
    old = {"state": told["state"], "config": told["config"]}
    old["state"].pop("validation")
    old["config"] |= {"train.clip": 2.0, "model.train": "full"}
    for name in ("train.max_grad_norm", "model.trainable", "loss.ignore_within"):
        old["config"].pop(name)
    (path / "state.json").write_text(json.dumps(old))
    state, config, _ = checkpoint.read(path)
    assert (state.step, config["train.max_grad_norm"], config["model.trainable"]) == (5, 2.0, "full")
    assert set(config) == set(flatten(RunConfig()))


def test_only_free_settings_may_change() -> None:
    saved, state = flatten(RunConfig()), RunState(index="abc")
    free = RunConfig(train=dataclasses.replace(TrainConfig(), epochs=3, log_every=1))
    checkpoint.check_same(saved, free, state, "abc")
    cached = RunConfig(data=DataConfig(cache_gb=1.0, workers=0))
    checkpoint.check_same(saved, cached, state, "abc")
    cosine = RunConfig(train=TrainConfig(schedule="cosine"))
    longer = RunConfig(train=TrainConfig(schedule="cosine", epochs=20))
    with pytest.raises(UsageError, match=r"train\.epochs was 10 and is now 20, and the rate of train\.schedule cosine"):
        checkpoint.check_same(flatten(cosine), longer, state, "abc")
    with pytest.raises(UsageError, match=r"seed was 0 and is now 1"):
        checkpoint.check_same(saved, RunConfig(seed=1), state, "abc")
    with pytest.raises(UsageError, match="not those it started with"):
        checkpoint.check_same(saved, RunConfig(), state, "abd")


def test_published_schedule_halves_every_three_epochs() -> None:
    config = TrainConfig()
    rates = [
        learning_rate(config, step, steps_per_epoch=100, total_steps=1000) for step in (0, 299, 300, 599, 600, 999)
    ]
    assert rates == pytest.approx([1e-4, 1e-4, 5e-5, 5e-5, 2.5e-5, 1.25e-5])


def test_cosine_and_warm_up() -> None:
    config = TrainConfig(schedule="cosine", warmup_steps=10, lr=1.0)
    assert learning_rate(config, 0, 10, 100) == pytest.approx(0.1)
    assert learning_rate(config, 50, 10, 100) == pytest.approx(0.5)
    assert learning_rate(config, 25, 10, 100) == pytest.approx(0.5 * (1 + math.cos(math.pi / 4)))
    assert learning_rate(config, 100, 10, 100) == pytest.approx(0.0)
