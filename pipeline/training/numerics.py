"""How a GPU computes in float32: TF32 or not, which convolution algorithms, deterministic or not. Said here alone.

Invariant: nothing is in TF32 unless `train.tf32` asks for it (torch's own default computes convolutions in TF32), and
never in evaluation, so that a validated recall is the one that `jobs.evaluate` finds. On a CPU nothing changes.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from pipeline.config import TrainConfig


def set_numerics(config: TrainConfig, device: torch.device) -> str:
    """Sets torch for a training; says what was set in one line, "" on a CPU, where there is nothing to set.

    Images of a training have one shape, so cuDNN tries its algorithms once and keeps the fastest, which need not be the
    same one in the next process; not where `train.deterministic` is set.
    """
    if device.type != "cuda":
        return ""
    _set_tf32(config.tf32)
    torch.backends.cudnn.benchmark = not config.deterministic
    if config.deterministic:
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # read at cuBLAS's first product
    torch.use_deterministic_algorithms(config.deterministic)
    return (
        f"float32 products and convolutions in {'TF32' if config.tf32 else 'float32'}, "
        f"{'deterministic' if config.deterministic else 'cuDNN benchmark'}"
    )


@contextmanager
def full_float32() -> Iterator[None]:
    """Within it nothing is computed in TF32."""
    before = torch.get_float32_matmul_precision(), torch.backends.cudnn.allow_tf32
    _set_tf32(False)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before[0])
        torch.backends.cudnn.allow_tf32 = before[1]


def _set_tf32(on: bool) -> None:
    torch.set_float32_matmul_precision("high" if on else "highest")
    torch.backends.cudnn.allow_tf32 = on
