"""Where the tests of this folder compute: on a GPU (`make test-gpu`), and, to prove that they work, on the CPU."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
import torch

os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # for deterministic products, read once a process


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> Iterator[torch.device]:
    """The device under test, in full float32; torch's switches are afterwards as before."""
    chosen = torch.device(request.param)
    if chosen.type == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    cudnn = torch.backends.cudnn
    tf32, benchmark, deterministic = cudnn.allow_tf32, cudnn.benchmark, torch.are_deterministic_algorithms_enabled()
    cudnn.allow_tf32 = False
    yield chosen
    cudnn.allow_tf32, cudnn.benchmark = tf32, benchmark
    torch.use_deterministic_algorithms(deterministic)
