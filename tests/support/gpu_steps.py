"""What the GPU kit repeats: gradients of a rank, steps of an engine. Needs torch, transformers and accelerate alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from pipeline.benchmark.sizes import SIZES, batch, build
from pipeline.config import PoolingConfig, TrainConfig
from pipeline.config.baselines import BoQConfig, CosPlaceConfig, MixVPRConfig, NetVLADConfig, SALADConfig
from pipeline.distributed import rank_slice, world_size
from pipeline.training.engines.base import Engine
from pipeline.training.loss import MultiSimilarityLoss
from pipeline.training.schedule import build_optimizer

TINY = SIZES["tiny"]
IMAGES = 16
POOLINGS = {
    "spm": PoolingConfig(),
    "gem": PoolingConfig(kind="gem"),
    "netvlad": PoolingConfig(kind="netvlad", netvlad=NetVLADConfig(clusters=4)),
    "cosplace": PoolingConfig(kind="cosplace", cosplace=CosPlaceConfig(dim=16)),
    "mixvpr": PoolingConfig(kind="mixvpr", mixvpr=MixVPRConfig(channels=8, rows=4)),
    "salad": PoolingConfig(kind="salad", salad=SALADConfig(clusters=4, channels=4, token=8, hidden=16, dropout=0.0)),
    "boq": PoolingConfig(kind="boq", boq=BoQConfig(channels=64, queries=4)),
}


def gradients(device: torch.device, chunk: int | None = None) -> dict[str, Tensor]:
    """Averaged gradients and BatchNorm's buffers of one float64 step of this rank's images, on the CPU."""
    model: Any = build(TINY).double().to(device)
    images, labels = batch(TINY, IMAGES, device)
    mine = rank_slice(IMAGES)
    module = DistributedDataParallel(model, broadcast_buffers=False) if world_size() > 1 else model
    MultiSimilarityLoss()(module(images[mine].double(), chunk=chunk), labels[mine]).backward()
    found = {n: p.grad.cpu().clone() for n, p in model.named_parameters() if p.grad is not None}
    return found | {n: b.cpu().clone() for n, b in model.named_buffers() if b.is_floating_point()}


def spawned_rank(r: int, world: int, folder: str) -> None:
    """One rank of a gloo group whose tensors are on the GPU that all ranks share; writes its `gradients`."""
    store = dist.FileStore(f"{folder}/store", world)
    dist.init_process_group("gloo", store=store, rank=r, world_size=world)
    torch.save(gradients(torch.device("cuda")), f"{folder}/{r}.pt")
    dist.barrier()
    dist.destroy_process_group()


def engine(device: torch.device, precision: str, pooling: str) -> Engine:
    """The engine of one process around the tiny model with this pooling; Adam is fused on a GPU, as in a training."""
    from accelerate import Accelerator
    from accelerate.state import AcceleratorState

    AcceleratorState._reset_state(reset_partial_state=True)
    accelerator = Accelerator(cpu=device.type == "cpu", mixed_precision=precision)
    model = build(replace(TINY, model=replace(TINY.model, pooling=POOLINGS[pooling])))
    fused = device.type == "cuda"
    return Engine(accelerator, model, lambda parameters: build_optimizer(TrainConfig(lr=1e-3), parameters, fused), 1.0)


def steps(trained: Engine, first: int, last: int) -> None:
    """Trains the steps first ... last - 1; each has its own images."""
    device = trained.accelerator.device
    images, labels = batch(TINY, IMAGES, device)
    for number in range(first, last):
        with trained.accelerator.autocast():
            descriptors = trained(images.roll(number, -1))
        trained.step(MultiSimilarityLoss()(descriptors, labels), 1e-3)


def whole_state(trained: Engine) -> tuple[dict[str, Tensor], dict[str, Tensor], dict[str, float]]:
    """Weights and buffers, optimiser tensors, the loss scaler's state."""
    weights, moments = trained.state(set(trained.model.state_dict()))
    return weights, moments, trained.scaler()
