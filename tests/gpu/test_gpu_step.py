"""A training step on a GPU: the numbers of float64 on the CPU, in every precision, compiled, in chunks, resumed, W = 2.

Run by `make test-gpu`. Needs torch, transformers and accelerate alone.
"""

from __future__ import annotations

import copy
from pathlib import Path

import pytest
import torch
from gpu_steps import IMAGES, POOLINGS, TINY, engine, gradients, spawned_rank, steps, whole_state
from processes import run_ranks
from torch import Tensor

from pipeline.benchmark.precision import PRECISIONS, Result, errors, run
from pipeline.benchmark.sizes import batch, build
from pipeline.config import TrainConfig
from pipeline.training.numerics import set_numerics

BOUNDS = {"float32": (1e-5, 1e-6, 1e-4), "bf16": (3e-2, 1e-2, 1e-1), "fp16": (4e-3, 2e-3, 3e-2)}


def on_cpu(found: Result) -> Result:
    return Result(found.descriptors.cpu(), found.loss.cpu(), {n: g.cpu() for n, g in found.gradients.items()})


def worst(truth: dict[str, Tensor], found: dict[str, Tensor]) -> float:
    """Largest difference, relative to the largest number of all tensors."""
    assert truth.keys() == found.keys()
    scale = max(t.abs().max().item() for t in truth.values())
    return max((truth[n] - found[n]).abs().max().item() for n in truth) / scale


@pytest.mark.parametrize("joint", [False, True])
def test_descriptors_loss_and_gradients_are_those_of_float64_on_the_cpu(device: torch.device, joint: bool) -> None:
    images, labels = batch(TINY, IMAGES)
    model = build(TINY)
    truth = run(copy.deepcopy(model).double(), images.double(), labels, None, joint)
    model.to(device)
    for name, (descriptor, loss, gradient) in BOUNDS.items():
        e = errors(truth, on_cpu(run(model, images.to(device), labels.to(device), PRECISIONS[name], joint)))
        assert e.finite and e.descriptor < descriptor and e.loss < loss and e.gradient < gradient, (name, e)


def test_chunks_give_the_same_gradients(device: torch.device) -> None:
    """In float64, with BatchNorm's buffers."""
    truth = gradients(torch.device("cpu"))
    assert worst(truth, gradients(device)) < 1e-9
    assert worst(truth, gradients(device, chunk=5)) < 1e-9


def test_two_ranks_give_the_gradients_of_one(device: torch.device, tmp_path: Path) -> None:
    """gloo with the tensors of one GPU stands for NCCL: the same calls, on the same tensors."""
    truth = gradients(torch.device("cpu"))
    if device.type == "cpu":
        ranks = run_ranks(gradients, 2, device)
    else:
        torch.multiprocessing.spawn(spawned_rank, (2, str(tmp_path)), nprocs=2)  # type: ignore[no-untyped-call]
        ranks = [torch.load(tmp_path / f"{r}.pt") for r in range(2)]
    for found in ranks:
        assert worst(truth, found) < 1e-9


@pytest.mark.gpu
@pytest.mark.parametrize("dtype", [None, torch.bfloat16])
def test_compiled_blocks_give_the_same_gradients(dtype: torch.dtype | None) -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    images, labels = batch(TINY, IMAGES, "cuda")
    plain, compiled = build(TINY).cuda(), build(TINY).cuda()
    for block in compiled.backbone.blocks:
        block.compile()
    e = errors(run(plain, images, labels, dtype), run(compiled, images, labels, dtype))
    assert e.gradient < (1e-4 if dtype is None else 1e-1) and e.finite


@pytest.mark.parametrize(
    ("pooling", "precision"),
    [
        ("spm", "no"),
        ("salad", "no"),
        ("spm", "bf16"),
        *(pytest.param(name, "no", marks=pytest.mark.gpu) for name in POOLINGS if name not in ("spm", "salad")),
        pytest.param("spm", "fp16", marks=pytest.mark.gpu),
    ],
)
def test_resumed_training_gives_the_same_bits(device: torch.device, pooling: str, precision: str) -> None:
    """Four steps at once, and two, a new engine from what the first would have saved, and two more. With deterministic
    kernels (`train.deterministic`): other convolutions add in an order that may change from run to run."""
    if device.type == "cpu" and precision == "fp16":
        pytest.skip("accelerate has no loss scaler on a CPU")
    set_numerics(TrainConfig(deterministic=True), device)
    whole = engine(device, precision, pooling)
    steps(whole, 0, 4)
    truth = whole_state(whole)

    first = engine(device, precision, pooling)
    steps(first, 0, 2)
    weights, moments, scaler = whole_state(first)
    assert bool(scaler) == (precision == "fp16")
    second = engine(device, precision, pooling)
    second.model.load_state_dict(weights)
    second.load(moments, scaler)
    assert all(p.device.type == device.type for p in second.model.parameters())
    steps(second, 2, 4)
    found = whole_state(second)
    for saved, again in zip(truth[:2], found[:2], strict=True):
        assert saved.keys() == again.keys()
        for name, value in saved.items():
            assert torch.equal(value, again[name]), name
    assert truth[2] == found[2]
    assert any(not torch.equal(truth[0][name], weights[name]) for name in weights)  # the last two steps moved something


@pytest.mark.gpu
def test_the_benchmark_runs_on_a_gpu() -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    from pipeline.benchmark import step

    found = step.measure(TINY, torch.device("cuda"), 2, 8, full=False)
    assert all(row.seconds > 0 for comparison in found for row in comparison.rows)
