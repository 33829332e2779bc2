"""Half precision against float64, and the real job under bf16 on one and two processes."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from job_process import JobProcess
from precision_runs import launch, tiny_config, weights
from tiny import prepare

from pipeline.benchmark.precision import compare
from pipeline.benchmark.sizes import SIZES
from pipeline.training.loss import MultiSimilarityLoss


def distance(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> float:
    """Of all floating tensors, norm of the difference."""
    assert a.keys() == b.keys()
    return sum(((a[n] - b[n]).double() ** 2).sum().item() for n in a if a[n].is_floating_point()) ** 0.5


@pytest.mark.parametrize("joint", [False, True])
def test_half_precision_strays_little_from_float64(joint: bool) -> None:
    """Bounds a few times above what docs/performance.md measures; float32 shows that the comparison is a sharp one."""
    found = compare(SIZES["tiny"], 16, torch.device("cpu"), joint)
    for name, descriptor, loss, gradient in (
        ("float32", 1e-5, 1e-6, 1e-4),
        ("bf16", 3e-2, 1e-2, 1e-1),
        ("fp16", 4e-3, 2e-3, 3e-2),
    ):
        e = found[name]
        assert e.finite
        assert e.descriptor < descriptor and e.loss < loss and e.gradient < gradient, (name, e)
    assert found["bf16"].descriptor > 100 * found["float32"].descriptor  # half precision really ran


def test_similarities_stay_float32_under_autocast() -> None:
    """beta = 50 makes of an error of 1e-2 in a similarity a factor of 1.6: the loss must not be computed in bf16."""
    generator = torch.Generator().manual_seed(0)
    descriptors = torch.randn(8, 1, 96, generator=generator) + 3 * torch.randn(8, 4, 96, generator=generator)
    flat = torch.nn.functional.normalize(descriptors.flatten(0, 1), dim=1)
    labels = torch.arange(8).repeat_interleave(4)
    loss = MultiSimilarityLoss()
    exact = loss(flat.double(), labels)
    with torch.autocast("cpu", torch.bfloat16):
        assert (loss(flat, labels) - exact).abs() < 1e-5 * exact.abs()
        rounded = (flat @ flat.T).double()  # what it would see otherwise
    assert (rounded - flat.double() @ flat.double().T).abs().max() > 1e-4


def moved_from_start(root: Path, plain: dict[str, torch.Tensor]) -> float:
    """How far two of three steps took the weights."""
    return distance(plain, weights(root, "float32", step=1))


def test_bf16_through_the_real_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three SGD steps of joint training. bf16 really ran (the weights differ from float32's) and strays little; the
    weights themselves stay float32."""
    root, _ = both_precisions(tmp_path, monkeypatch)
    plain, half = (weights(root, name) for name in ("float32", "bf16"))
    assert all(t.dtype == torch.float32 for t in half.values() if t.is_floating_point())
    assert 0 < distance(plain, half) < 0.1 * moved_from_start(root, plain)


@pytest.mark.slow
def test_bf16_on_two_processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same as on one, to bf16's own rounding."""
    root, config = both_precisions(tmp_path, monkeypatch)
    launch(config, "bf16-two", 2, "--train.passes", "joint", precision="bf16")
    plain, half, two = (weights(root, name) for name in ("float32", "bf16", "bf16-two"))
    moved = moved_from_start(root, plain)
    assert 0 < distance(plain, two) < 0.1 * moved
    assert distance(half, two) < 0.1 * moved


def both_precisions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """Runs of one process in float32 and bf16, as accelerate's launcher would ask for them."""
    root = prepare(tmp_path)
    config = tiny_config(root)
    for name, precision in (("float32", "no"), ("bf16", "bf16")):
        monkeypatch.setenv("ACCELERATE_MIXED_PRECISION", precision)
        options = ["--config", str(config), "--name", name, "--train.passes", "joint"]
        job = JobProcess("jobs.train", options, tmp_path / f"{name}.txt")
        assert job.wait(240) == 0, job.text()[-3000:]
    return root, config
