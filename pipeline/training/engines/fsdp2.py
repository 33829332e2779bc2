"""FSDP2 as an engine: parameters, gradients and optimiser state sharded over ranks, block by block.

Invariant: the same numbers as DDP. Parameters stay float32 (or float64) also under bf16: they are gathered whole,
autocast casts where it computes, exactly as under DDP, so norms, GeM's exponent and BatchNorm keep their digits.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from pipeline.distributed import world_size
from pipeline.model.vpr import PlaceModel
from pipeline.training.engines.base import BuildOptimizer, Engine, whole


class ShardedEngine(Engine):
    """`fully_shard` on every transformer block, every cross-image layer, and the rest as one.

    Called directly rather than through Accelerate, whose FSDP2 path does not exist on CPU; the same code then runs in
    the tests and on GPUs.
    """

    name = "fsdp2"

    def _wrap(self, model: PlaceModel, build: BuildOptimizer) -> None:
        from torch.distributed.device_mesh import init_device_mesh
        from torch.distributed.fsdp import fully_shard

        device = self.accelerator.device
        self._template = copy.deepcopy(model)
        model = model.to(device)
        mesh = init_device_mesh(device.type, (world_size(),), mesh_dim_names=("data",))
        for block in [*model.backbone.blocks, *model.cross_image.layers]:
            fully_shard(block, mesh=mesh)
        fully_shard(model, mesh=mesh)
        self.model = self.module = model
        self.optimizer = build(model.parameters())

    def step(self, loss: Tensor, rate: float) -> None:
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        loss.backward()
        if self.max_grad_norm is not None:
            torch.nn.utils.clip_grad_norm_(self.model.parameters(), self.max_grad_norm)  # norm over all shards
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)

    @contextmanager
    def plain(self) -> Iterator[PlaceModel]:
        # a sharded model cannot be called a different number of times on each rank, as evaluation does
        sharded = self.model.state_dict()
        self._template.to(self.accelerator.device)
        with torch.no_grad():
            for name, target in self._template.state_dict().items():
                target.copy_(whole(sharded[name]))
        self._template.eval()
        try:
            yield self._template
        finally:
            self._template.to("cpu")
