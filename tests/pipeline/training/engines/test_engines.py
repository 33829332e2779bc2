"""Engines give one process's numbers, hand runs to each other, and say at the start what they cannot do."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from launched import ENGINES, Launched
from safetensors.torch import load_file
from tiny import prepare, run_settings

from pipeline.benchmark.engines import compare
from pipeline.common.errors import UsageError
from pipeline.config import TrainConfig
from pipeline.model.weights.files import load_model
from pipeline.training.engines.base import Engine
from pipeline.training.engines.build import choose
from pipeline.training.engines.zero import zero_settings


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepare(tmp_path_factory.mktemp("engines"))


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> dict[str, torch.Tensor]:
    """Gradients and weights of one process in float64."""
    return measured("ddp", 1, "float64", tmp_path_factory.mktemp("truth"))


@pytest.fixture(scope="module")
def joint_truth(tmp_path_factory: pytest.TempPathFactory) -> dict[str, torch.Tensor]:
    """The same for joint training."""
    return measured("ddp", 1, "float64", tmp_path_factory.mktemp("joint"), "--passes", "joint")


def measured(engine: str, world: int, dtype: str, folder: Path, *options: str) -> dict[str, torch.Tensor]:
    file = folder / f"{engine}.safetensors"
    Launched(
        engine, world, "pipeline.benchmark.engines", ["--write", str(file), "--dtype", dtype, *options], file
    ).done()
    return load_file(file)


@pytest.mark.parametrize("engine", ["ddp", "fsdp2"])
def test_gradients_are_those_of_one_process(engine: str, truth: dict[str, torch.Tensor], tmp_path: Path) -> None:
    difference = compare(truth, measured(engine, 2, "float64", tmp_path))
    assert difference.tensors > 100
    assert difference.gradient < 1e-9, difference.tensor
    assert difference.weight < 1e-9


def test_joint_training_shards_as_any_other(joint_truth: dict[str, torch.Tensor], tmp_path: Path) -> None:
    """FSDP2, whose hooks gather each layer's parameters around its call; DDP is in test_training_global_batch.py."""
    difference = compare(joint_truth, measured("fsdp2", 2, "float64", tmp_path, "--passes", "joint"))
    assert max(difference.gradient, difference.weight) < 1e-9, difference.tensor


def test_the_comparison_sees_a_wrong_scale_and_a_stale_weight(truth: dict[str, torch.Tensor]) -> None:
    name = "gradient/cross_image.layers.0.norm1.bias"
    assert compare(truth, {**truth, name: truth[name] * 1.001}).gradient > 5e-4
    weight = "weight/cross_image.layers.0.norm1.bias"
    assert compare(truth, {**truth, weight: truth[weight.replace("weight/", "start/")]}).weight > 1e-3


def settings(root: Path, name: str, **train: Any) -> Path:
    """The tiny run without dropout, whose masks depend on the number of ranks."""
    plain = run_settings(root)
    plain["name"] = name
    plain["model"]["cross_image"]["dropout"] = 0.0
    plain["train"] |= {"validate_first": False, **train}
    path = root / f"{name}.yaml"
    path.write_text(yaml.safe_dump(plain))
    return path


def run(engine: str, world: int, path: Path, *overrides: str) -> Launched:
    return Launched(engine, world, "jobs.train", ["--config", str(path), *overrides], path.with_suffix(".log"))


@pytest.fixture(scope="module")
def reference(root: Path) -> Path:
    """An uninterrupted run of two epochs, six steps each, on one process."""
    run("ddp", 1, settings(root, "reference")).done()
    return root / "outputs" / "reference"


def logged(folder: Path, step: int) -> bool:
    log = folder / "samples.rank0.jsonl"
    return log.exists() and f'"step": {step},' in log.read_text()


def seen(folder: Path) -> dict[int, list[str]]:
    """Step -> the sample keys of the global batch, in order, from all ranks' logs."""
    steps: dict[int, list[str]] = {}
    for path in sorted(folder.glob("samples.rank*.jsonl")):
        for line in path.read_text().splitlines():
            entry = json.loads(line)
            steps.setdefault(entry["step"], []).extend(entry["samples"])
    return steps


def same_run(folder: Path, reference: Path) -> None:
    """The same samples, whole weights near, and the Adam moments too (a lost moment is far away)."""
    assert seen(folder) == seen(reference)
    one, two = (load_file(f / "checkpoints/last/model.safetensors") for f in (reference, folder))
    assert {n: t.shape for n, t in one.items()} == {n: t.shape for n, t in two.items()}
    assert max((one[n] - two[n]).abs().max().item() for n in one if one[n].is_floating_point()) < 2e-3
    one, two = (load_file(f / "checkpoints/last/optimizer.safetensors") for f in (reference, folder))
    assert {n: t.shape for n, t in one.items()} == {n: t.shape for n, t in two.items()}
    assert all(two[n].item() == 12.0 for n in two if n.endswith("/step"))
    for moment in ("exp_avg", "exp_avg_sq"):  # had the first steps been forgotten, squares would be a fifth smaller
        a, b = (torch.cat([m[n].flatten() for n in sorted(m) if n.endswith(f"/{moment}")]) for m in (one, two))
        assert (a - b).norm() < 0.02 * a.norm(), moment
    state = json.loads((folder / "checkpoints/last/state.json").read_text())["state"]
    assert (state["step"], state["epoch"]) == (12, 2)
    model = load_model(folder)  # the same single file as from every engine
    assert torch.isfinite(model(torch.zeros(2, 3, 28, 28))).all()


def test_a_run_goes_from_engine_to_engine(root: Path, reference: Path) -> None:
    """ZeRO-2 on two ranks, killed; FSDP2 on two, killed; finished by one process: the same run."""
    path = settings(root, "relay")
    folder = root / "outputs" / "relay"
    run("zero2", 2, path).kill_when(lambda: logged(folder, 3))
    assert json.loads((folder / "checkpoints/last/state.json").read_text())["state"]["step"] == 2
    run("fsdp2", 2, path).kill_when(lambda: logged(folder, 7))
    run("ddp", 1, path).done()
    same_run(folder, reference)


class Unwrapped:
    """What `Engine` asks of an Accelerator on one process."""

    scaler = None

    def prepare(self, *given: Any) -> Any:
        return given


@pytest.mark.parametrize("shape", [(), (1,), (3, 2)])
@pytest.mark.parametrize("fused", [False, True])
def test_moments_come_back_beside_their_parameter(shape: tuple[int, ...], fused: bool) -> None:
    """The meta device stands for a GPU. What is a step counter follows from its name, not from its shape: the moments
    of a parameter of one number were taken for counters and stayed on the CPU. A vector of one is also read from a
    checkpoint in which it was a number."""
    model: Any = torch.nn.ParameterDict({"weight": torch.nn.Parameter(torch.zeros(shape, device="meta"))})

    def build(parameters: Any) -> torch.optim.Optimizer:
        optimizer = torch.optim.Adam(parameters)
        optimizer.param_groups[0]["fused"] = fused
        return optimizer

    engine = Engine(Unwrapped(), model, build, None)
    stored = torch.zeros(() if shape == (1,) else shape)
    engine.load({"weight/step": torch.tensor(7.0), "weight/exp_avg": stored, "weight/exp_avg_sq": stored}, {})
    state = engine.optimizer.state[model["weight"]]
    assert state["step"].device.type == ("meta" if fused else "cpu") and state["step"].ndim == 0
    for name in ("exp_avg", "exp_avg_sq"):
        assert (state[name].device.type, state[name].shape) == ("meta", model["weight"].shape)


REFUSED = [
    ({"zero_optimization": {"stage": 0}}, "no", "zero_stage 0"),
    ({"zero_optimization": {"stage": 2}}, "fp16", "fp16 makes DeepSpeed cast"),
    ({"zero_optimization": {"stage": 2}, "bf16": {"enabled": True}}, "no", "casts the weights"),
    ({"zero_optimization": {"stage": 2}, "gradient_accumulation_steps": 4}, "no", "gradient_accumulation_steps"),
    ({"zero_optimization": {"stage": 3, "offload_param": {"device": "cpu"}}}, "no", "offload_param_device cpu"),
]


@pytest.mark.parametrize(("given", "precision", "reason"), REFUSED)
def test_zero_refuses_with_the_reason(given: dict[str, Any], precision: str, reason: str) -> None:
    with pytest.raises(UsageError, match=reason):
        zero_settings(given, precision, None, 8)


def test_zero_computes_bf16_over_float32_weights() -> None:
    built = zero_settings({"zero_optimization": {"stage": 2}, "bf16": {"enabled": True}}, "bf16", 1.0, 8)
    assert "bf16" not in built
    assert built["torch_autocast"]["dtype"] == "bfloat16"
    assert built["torch_autocast"]["lower_precision_safe_modules"] == []
    assert (built["gradient_clipping"], built["train_micro_batch_size_per_gpu"]) == (1.0, 8)


def test_launches_that_contradict_the_settings_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert choose(TrainConfig().engine) == "ddp"
    with pytest.raises(UsageError, match="at least two"):
        choose("fsdp2")
    monkeypatch.setenv("ACCELERATE_USE_DEEPSPEED", "true")
    with pytest.raises(UsageError, match="launched with DeepSpeed"):
        choose("ddp")
    monkeypatch.delenv("ACCELERATE_USE_DEEPSPEED")
    monkeypatch.setattr("pipeline.training.engines.build.is_distributed", lambda: True)
    monkeypatch.setenv("ACCELERATE_USE_FSDP", "true")
    monkeypatch.setenv("FSDP_VERSION", "1")
    with pytest.raises(UsageError, match="fsdp_version: 2"):
        choose("auto")


def accelerate(engine: str, path: Path, *overrides: str, code: int = 0) -> str:
    """The launch that the documentation tells: `accelerate launch --config_file ...`, no variables set."""
    command = [sys.executable, "-m", "accelerate.commands.accelerate_cli", "launch"]
    command += ["--config_file", f"jobs/accelerate/{engine}.yaml", "-m", "jobs.train", "--config", str(path)]
    done = subprocess.run(
        [*command, *overrides], env={**os.environ, "OMP_NUM_THREADS": "1"}, capture_output=True, text=True, timeout=900
    )
    assert (done.returncode == 0) == (code == 0), done.stdout[-1500:] + done.stderr[-3000:]
    return done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["fsdp2", "zero1", "zero2", "zero3"])
def test_killed_and_resumed_under_the_same_engine(root: Path, reference: Path, engine: str) -> None:
    path = settings(root, f"same-{engine}")
    folder = root / "outputs" / path.stem
    run(engine, 2, path).kill_when(lambda: logged(folder, 5))
    out = accelerate(engine, path)
    assert "continuing from" in out
    assert "R@5" in out
    same_run(folder, reference)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["zero1", "zero3"])
def test_one_process_is_continued_sharded(root: Path, reference: Path, engine: str) -> None:
    path = settings(root, f"from-one-{engine}")
    folder = root / "outputs" / path.stem
    run("ddp", 1, path).kill_when(lambda: logged(folder, 5))
    run(engine, 2, path).done()
    same_run(folder, reference)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["zero1", "zero2", "zero3"])
@pytest.mark.parametrize("train", ["full", "adapters"])
def test_zero_gradients_in_float32(engine: str, train: str, truth: dict[str, torch.Tensor], tmp_path: Path) -> None:
    """DeepSpeed's master weights are float32: as near as DDP in float32, not nearer."""
    own = truth if train == "full" else measured("ddp", 1, "float64", tmp_path, "--trainable", train)
    difference = compare(own, measured(engine, 2, "float32", tmp_path, "--trainable", train))
    assert difference.gradient < 1e-4, difference.tensor
    assert difference.weight < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["zero1", "zero2", "zero3"])
def test_joint_training_under_zero(engine: str, joint_truth: dict[str, torch.Tensor], tmp_path: Path) -> None:
    """Weights against one process in float32: in the third step a pair at mining's threshold falls to another side than
    in float64, on one process too (1.2e-4 of what the steps moved)."""
    found = measured(engine, 2, "float32", tmp_path, "--passes", "joint")
    difference = compare(joint_truth, found)
    assert difference.gradient < 1e-4, difference.tensor
    assert compare(measured("ddp", 1, "float32", tmp_path, "--passes", "joint"), found).weight < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("passes", ["group", "joint"])
@pytest.mark.parametrize("engine", ["fsdp2", "zero2", "zero3"])
def test_chunks_under_every_engine(
    engine: str, passes: str, truth: dict[str, torch.Tensor], joint_truth: dict[str, torch.Tensor], tmp_path: Path
) -> None:
    dtype = "float64" if engine == "fsdp2" else "float32"
    own = truth if passes == "group" else joint_truth
    difference = compare(own, measured(engine, 2, dtype, tmp_path, "--encode_chunk", "5", "--passes", passes))
    assert difference.gradient < (1e-9 if dtype == "float64" else 1e-4), difference.tensor


@pytest.mark.slow
def test_a_refusal_reaches_the_user_as_one_line(root: Path) -> None:
    out = accelerate("zero2", settings(root, "refused"), "--train.engine", "fsdp2", code=1)
    assert "jobs.train: train.engine is fsdp2, but accelerate was launched with DeepSpeed" in out
    assert sorted(ENGINES) == ["ddp", "fsdp2", "zero1", "zero2", "zero3"]
