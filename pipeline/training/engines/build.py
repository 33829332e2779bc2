"""Which engine a launch asks for, and making it."""

from __future__ import annotations

import os
from typing import Any

from pipeline.common.errors import UsageError
from pipeline.config import TrainConfig
from pipeline.distributed import is_distributed
from pipeline.model.vpr import PlaceModel
from pipeline.training.engines.base import BuildOptimizer, Engine
from pipeline.training.engines.fsdp2 import ShardedEngine
from pipeline.training.engines.zero import ZeroEngine


def choose(setting: str) -> str:
    """Which engine this launch asks for: "ddp", "fsdp2" or "deepspeed".

    Raises:
        UsageError: the setting contradicts the launch.
    """
    launched = "ddp"
    if os.environ.get("ACCELERATE_USE_DEEPSPEED", "false").lower() == "true":
        launched = "deepspeed"
    elif os.environ.get("ACCELERATE_USE_FSDP", "false").lower() == "true":
        launched = "fsdp2"
    if setting != "auto" and launched == "deepspeed":
        raise UsageError(f"train.engine is {setting}, but accelerate was launched with DeepSpeed; set it to auto")
    chosen = launched if setting == "auto" else setting
    if chosen != "ddp" and not is_distributed():
        raise UsageError(
            f"engine {chosen} shards over ranks and needs at least two; launch with --num_processes 2, or one process "
            "with jobs/accelerate/single.yaml (which continues the same checkpoints)"
        )
    if launched == "fsdp2":
        _check_fsdp_plugin()
    return chosen


def _check_fsdp_plugin() -> None:
    """Refuses what the launcher's FSDP section asks for and this engine would silently not do."""
    wrong = {
        "FSDP_VERSION": ("1", "fsdp_version 1 is not supported; set fsdp_version: 2"),
        "FSDP_OFFLOAD_PARAMS": ("true", "fsdp_offload_params is not supported; more ranks shard further"),
        "FSDP_ACTIVATION_CHECKPOINTING": ("true", "fsdp_activation_checkpointing is train.encode_chunk here"),
    }
    for variable, (value, reason) in wrong.items():
        if os.environ.get(variable, "").lower() == value:
            raise UsageError(f"engine fsdp2: {reason}")


def build_engine(
    config: TrainConfig, accelerator: Any, model: PlaceModel, build: BuildOptimizer, micro_batch: int
) -> Engine:
    """The engine for this launch; `micro_batch` is b, images on this rank (DeepSpeed wants it said).

    Raises:
        UsageError: the engine cannot do what the config asks for.
    """
    chosen = choose(config.engine)
    if chosen == "deepspeed":
        return ZeroEngine(accelerator, model, build, config.max_grad_norm, micro_batch)
    if chosen == "fsdp2":
        if accelerator.mixed_precision == "fp16":
            raise UsageError("engine fsdp2 has no loss scaler for fp16; use bf16, or DDP")
        return ShardedEngine(accelerator, model, build, config.max_grad_norm)
    return Engine(accelerator, model, build, config.max_grad_norm)
