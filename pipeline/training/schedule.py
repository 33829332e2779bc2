"""The optimiser and its learning rate as a pure function of the step.

Invariant: the rate depends on (config, step, steps an epoch) alone; no scheduler object, so nothing to save, nothing
that a data-parallel wrapper could step W times, and a resumed run has the rate the uninterrupted one would have.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import nn

from pipeline.config import TrainConfig


def learning_rate(config: TrainConfig, step: int, steps_per_epoch: int, total_steps: int) -> float:
    """Rate of the step with this number, counted from 0 over the whole run.

    `step` is the published schedule: times `step_factor` after every `step_epochs` epochs (paper, section 4.2);
    `cosine` ends at 0 after `total_steps`. A linear warm-up over `warmup_steps` multiplies either.
    """
    warmup = min(1.0, (step + 1) / config.warmup_steps) if config.warmup_steps else 1.0
    if config.schedule == "step":
        factor = config.step_factor ** (step // max(1, round(config.step_epochs * steps_per_epoch)))
    elif config.schedule == "cosine":
        factor = 0.5 * (1 + math.cos(math.pi * min(1.0, step / max(1, total_steps))))
    else:
        factor = 1.0
    return config.lr * warmup * factor


def build_optimizer(
    config: TrainConfig, parameters: Iterable[nn.Parameter], fused: bool = False
) -> torch.optim.Optimizer:
    """The configured optimiser over the trainable parameters; plain SGD has no momentum.

    `fused`: Adam in one kernel for all parameters, on a GPU and where no engine shards them.
    """
    trainable = [p for p in parameters if p.requires_grad]
    if config.optimizer == "sgd":
        return torch.optim.SGD(trainable, lr=config.lr, weight_decay=config.weight_decay)
    kind = torch.optim.AdamW if config.optimizer == "adamw" else torch.optim.Adam
    return kind(trainable, lr=config.lr, weight_decay=config.weight_decay, fused=fused or None)
