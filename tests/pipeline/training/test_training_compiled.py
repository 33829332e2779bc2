"""train.compile: the same training through compiled blocks, alone and under DDP; refused where it would not be."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from precision_runs import launch, tiny_config, weights
from tiny import prepare

from pipeline.common.errors import UsageError
from pipeline.config import BackboneConfig, ModelConfig, RunConfig, TrainConfig
from pipeline.model.vpr import build_model
from pipeline.training.compiled import compile_backbone

TINY = ModelConfig(backbone=BackboneConfig(name="custom", dim=16, depth=2, heads=2, patch=7, pretrain_grid=4))
COMPILED = RunConfig(
    model=replace(TINY, cross_image=replace(TINY.cross_image, heads=2)), train=TrainConfig(compile=True)
)
CPU = torch.device("cpu")


@pytest.mark.parametrize(
    ("engine", "train", "reason"),
    [
        ("fsdp2", COMPILED.train, "not for fsdp2"),
        ("deepspeed", COMPILED.train, "not for deepspeed"),
        ("ddp", replace(COMPILED.train, encode_chunk=4), "does not go with train.encode_chunk"),
    ],
)
def test_refused_with_the_reason(engine: str, train: TrainConfig, reason: str) -> None:
    model = build_model(COMPILED.model, 28)
    with pytest.raises(UsageError, match=reason):
        compile_backbone(model, replace(COMPILED, train=train), engine, CPU)
    assert all(block._compiled_call_impl is None for block in model.backbone.blocks)


def test_a_machine_without_a_compiler_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(function: Any) -> Any:
        raise RuntimeError("\nno C++ compiler")

    monkeypatch.setattr(torch, "compile", broken)
    with pytest.raises(UsageError, match=r"does not work here \(no C\+\+ compiler\)"):
        compile_backbone(build_model(COMPILED.model, 28), COMPILED, "ddp", CPU)


@pytest.mark.slow
@pytest.mark.timeout(1200)  # three trainings, two of which compile: minutes where other work runs beside
@pytest.mark.skipif(shutil.which("g++") is None, reason="torch.compile needs a C++ compiler on CPU")
def test_the_same_training_alone_and_under_ddp(tmp_path: Path) -> None:
    """The real job: three SGD steps without dropout, then weights, buffers, names and validated recalls agree."""
    root = prepare(tmp_path)
    config = tiny_config(root)
    launch(config, "plain", 1)
    launch(config, "compiled", 1, "--train.compile", "true")
    launch(config, "compiled-ddp", 2, "--train.compile", "true")
    truth = weights(root, "plain")
    start = build_model_of(config)
    moved = max((truth[n] - start[n]).abs().max().item() for n in truth if n in start)
    assert moved > 1e-3
    for name in ("compiled", "compiled-ddp"):
        found = weights(root, name)
        assert found.keys() == truth.keys()
        for key, value in truth.items():
            # adapters: a bias before a BatchNorm has no gradient but rounding; nor has a BatchNorm's own bias where its
            # channel is all but constant, so that rounding decides which values ReLU cuts
            near = 1e-4 if ".adapter." in key and key.endswith(".bias") else 1e-5
            torch.testing.assert_close(
                found[key],
                value,
                rtol=1e-3,
                atol=near if value.is_floating_point() else 0,
                msg=lambda m, k=key: f"{k}: {m}",
            )


def build_model_of(config: Path) -> dict[str, torch.Tensor]:
    """The weights a run of this config starts from, by the names its checkpoint has."""
    from pipeline.config import from_dict
    from pipeline.model.weights.names import to_published

    run: RunConfig = from_dict(RunConfig, yaml.safe_load(config.read_text()))
    torch.manual_seed(run.seed)
    return to_published(build_model(run.model, run.data.image_size).state_dict())
