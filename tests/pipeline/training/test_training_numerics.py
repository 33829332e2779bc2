"""Which switches of torch a training sets on a GPU; nothing on a CPU, and nothing in TF32 in a validation."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator

import pytest
import torch

from pipeline.config import TrainConfig
from pipeline.training.numerics import full_float32, set_numerics
from pipeline.training.schedule import build_optimizer


def switches() -> tuple[object, ...]:
    cudnn = torch.backends.cudnn
    deterministic = torch.are_deterministic_algorithms_enabled()
    return torch.get_float32_matmul_precision(), cudnn.allow_tf32, cudnn.benchmark, deterministic


@pytest.fixture(autouse=True)
def as_before(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    precision, tf32, benchmark, deterministic = switches()
    yield
    torch.set_float32_matmul_precision(str(precision))
    torch.backends.cudnn.allow_tf32, torch.backends.cudnn.benchmark = bool(tf32), bool(benchmark)
    torch.use_deterministic_algorithms(bool(deterministic))


def test_a_gpu_computes_as_the_settings_say() -> None:
    gpu, before = torch.device("cuda"), switches()
    assert set_numerics(TrainConfig(tf32=True), torch.device("cpu")) == "" and switches() == before
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert "in TF32, cuDNN benchmark" in set_numerics(TrainConfig(tf32=True), gpu)
        assert switches() == ("high", True, True, False)
        with full_float32():
            assert switches()[:2] == ("highest", False)
        assert switches()[:2] == ("high", True)
        assert "in float32, deterministic" in set_numerics(TrainConfig(deterministic=True), gpu)
    assert switches() == ("highest", False, False, True)
    assert os.environ["CUBLAS_WORKSPACE_CONFIG"]


@pytest.mark.parametrize("kind", ["adam", "adamw"])
def test_fused_adam_takes_the_same_steps(kind: str) -> None:
    """torch has the fused update for CPUs, too."""
    found = []
    for fused in (False, True):
        torch.manual_seed(0)
        layer = torch.nn.Linear(5, 3).double()
        optimizer = build_optimizer(TrainConfig(optimizer=kind, weight_decay=0.1), layer.parameters(), fused)  # type: ignore[arg-type]
        assert bool(optimizer.param_groups[0]["fused"]) == fused
        for _ in range(3):
            layer(torch.randn(4, 5, dtype=torch.float64)).square().sum().backward()
            optimizer.step()
        found.append(layer.weight.detach())
    assert torch.allclose(*found, rtol=1e-12, atol=0)
