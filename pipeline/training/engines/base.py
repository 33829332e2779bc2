"""One face for every way of wrapping the model: one process, DDP, FSDP2, DeepSpeed ZeRO.

Invariant: whatever the engine, gradients are the average over ranks of each rank's gradient (pipeline.distributed says
why that is the gradient of the global batch), and `state` gives whole tensors under the model's own names, so a
checkpoint does not know which engine or how many ranks wrote it.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from pipeline.distributed import rank
from pipeline.model.vpr import PlaceModel

COUNTER = "step"  # the optimiser state that counts a parameter's steps; every other has the parameter's shape
BuildOptimizer = Callable[[Iterator[nn.Parameter]], torch.optim.Optimizer]


class Engine:
    """A model and its optimiser under data parallelism. This class serves one process and DDP.

    Args:
        accelerator: owns device, precision and wrapping.
        model: on the CPU, identical on all ranks; afterwards `self.model`, inside its wrapper `self.module`.
        build: makes the optimiser over the parameters of the module it is given.
        max_grad_norm: largest gradient norm, or None.
    """

    name = "ddp"

    def __init__(
        self,
        accelerator: Any,
        model: PlaceModel,
        build: BuildOptimizer,
        max_grad_norm: float | None,
    ) -> None:
        self.accelerator, self.max_grad_norm = accelerator, max_grad_norm
        self._wrap(model, build)

    def _wrap(self, model: PlaceModel, build: BuildOptimizer) -> None:
        self.model = model  # the wrapper holds this very object
        self.module, self.optimizer = self.accelerator.prepare(model, build(model.parameters()))

    def names(self) -> dict[str, nn.Parameter]:
        """Trainable parameters by the model's names."""
        return {n: p for n, p in self.model.named_parameters() if p.requires_grad}

    def __call__(self, *args: Any, **kwargs: Any) -> Tensor:
        out: Tensor = self.module(*args, **kwargs)
        return out

    def step(self, loss: Tensor, rate: float) -> None:
        """Backward, clip, update at this learning rate, clear gradients."""
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.accelerator.backward(loss)
        if self.max_grad_norm is not None:
            self.accelerator.clip_grad_norm_(self.module.parameters(), self.max_grad_norm)
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)

    def gradients(self, loss: Tensor) -> dict[str, Tensor]:
        """The averaged gradients of `loss` as whole tensors (collective), cleared afterwards; for tests and tables."""
        self.accelerator.backward(loss)
        found = {n: whole(p.grad).detach().cpu().clone() for n, p in self.names().items() if p.grad is not None}
        self.optimizer.zero_grad(set_to_none=True)
        return found

    def state(self, wanted: Container[str]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Whole model tensors and optimiser tensors on the CPU (collective; complete on rank 0, empty elsewhere).

        Args:
            wanted: names of the model tensors to collect, the same on every rank.

        Optimiser tensors are named `<parameter>/<state>`, for example `cross_image.layers.0.linear1.weight/exp_avg`.
        """
        model = self._collect((n, t) for n, t in self.model.state_dict().items() if n in wanted)
        inner = getattr(self.optimizer, "optimizer", self.optimizer)
        moments = (
            (f"{name}/{key}", value if isinstance(value, Tensor) else torch.tensor(float(value)))
            for name, parameter in self.names().items()
            for key, value in inner.state.get(parameter, {}).items()
        )
        return model, self._collect(moments)

    def scaler(self) -> dict[str, float]:
        """The loss scaler's state under fp16, else {}."""
        held = getattr(self.accelerator, "scaler", None)
        return {} if held is None else {key: float(value) for key, value in held.state_dict().items()}

    def load(self, optimizer: dict[str, Tensor], scaler: dict[str, float]) -> None:
        """Puts whole optimiser tensors, as `state` gave them, and the loss scaler's state where they belong.

        (The weights are loaded into the model before it is wrapped.)
        """
        if scaler and getattr(self.accelerator, "scaler", None) is not None:
            integers = ("growth_interval", "_growth_tracker")
            self.accelerator.scaler.load_state_dict({k: int(v) if k in integers else v for k, v in scaler.items()})
        inner = getattr(self.optimizer, "optimizer", self.optimizer)
        parameters = self.names()
        fused = any(group.get("fused") for group in inner.param_groups)
        for key, value in optimizer.items():
            name, state = key.rsplit("/", 1)
            parameter = parameters[name]
            if state == COUNTER:  # torch keeps it on the CPU, and beside the parameter where the update is fused
                inner.state[parameter][state] = value.to(parameter.device if fused else "cpu", copy=True)
            else:
                inner.state[parameter][state] = placed_like(value, parameter)

    @contextmanager
    def plain(self) -> Iterator[PlaceModel]:
        """The whole model, unwrapped, in evaluation mode, usable on each rank alone; then training mode again."""
        model = self.model
        model.eval()
        try:
            yield model
        finally:
            model.train()

    @staticmethod
    def _collect(tensors: Any) -> dict[str, Tensor]:
        keep = rank() == 0
        found: dict[str, Tensor] = {}
        for name, tensor in tensors:
            full = whole(tensor)  # collective: every rank takes part, rank 0 keeps
            if keep:
                found[name] = full.detach().cpu().clone()
        return found


def whole(tensor: Any) -> Tensor:
    """The full tensor of a sharded one (collective); any other as it is."""
    full: Tensor = tensor.full_tensor() if hasattr(tensor, "full_tensor") else tensor
    return full


def placed_like(value: Tensor, target: Any) -> Tensor:
    """`value` placed as `target` is: device, dtype, and its shard where the target is sharded."""
    value = value.to(device=target.device, dtype=target.dtype)
    if value.ndim == 0 and target.ndim == 1:  # older checkpoints hold SALAD's dustbin as a single number
        value = value[None]
    if hasattr(target, "full_tensor"):
        from torch.distributed.tensor import distribute_tensor

        return distribute_tensor(value, target.device_mesh, target.placements)
    return value.clone()
