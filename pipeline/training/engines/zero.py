"""DeepSpeed ZeRO-1, 2 and 3 as an engine: optimiser state, gradients and (3) parameters partitioned over ranks.

Invariant: the same numbers as DDP up to float32 rounding (DeepSpeed keeps its master weights in float32), and the same
checkpoints: whole tensors under the model's names, which any other engine and any number of ranks continues. DeepSpeed
is imported only where a run was launched with it.
"""

from __future__ import annotations

import copy
from collections.abc import Container, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from pipeline.common.errors import UsageError
from pipeline.distributed import rank, world_size
from pipeline.model.vpr import PlaceModel
from pipeline.training.engines.base import COUNTER, BuildOptimizer, Engine

BUCKET = 50_000_000  # numbers reduced or gathered at a time; DeepSpeed's "auto" needs a transformers config
STAGES = (1, 2, 3)


class ZeroEngine(Engine):
    """A model and its optimiser inside `deepspeed.initialize`.

    Called directly rather than through `Accelerator.prepare`: the launcher's settings are read from its plugin, and
    what it leaves open (micro batch, clipping, bucket sizes) is known here.

    Args:
        accelerator, model, build, max_grad_norm: as in `Engine`.
        micro_batch: images on this rank.

    Raises:
        UsageError: settings under which the numbers, or the checkpoints, would not be those of the other engines.
    """

    name = "zero"

    def __init__(
        self, accelerator: Any, model: PlaceModel, build: BuildOptimizer, max_grad_norm: float | None, micro_batch: int
    ) -> None:
        plugin = accelerator.state.deepspeed_plugin
        self._settings = zero_settings(plugin.deepspeed_config, accelerator.mixed_precision, max_grad_norm, micro_batch)
        self.stage = int(self._settings["zero_optimization"]["stage"])
        self.name = f"zero{self.stage}"
        super().__init__(accelerator, model, build, max_grad_norm)

    def _wrap(self, model: PlaceModel, build: BuildOptimizer) -> None:
        import logging

        import deepspeed

        logging.getLogger("DeepSpeed").setLevel(logging.WARNING)
        self._template = copy.deepcopy(model) if self.stage == 3 else None
        self.module, self._zero, _, _ = deepspeed.initialize(
            model=model, optimizer=build(model.parameters()), config=self._settings
        )
        self.model = model
        self.optimizer = self._zero.optimizer  # torch's own, over this rank's flat partitions

    def step(self, loss: Tensor, rate: float) -> None:
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.module.backward(loss)
        self.module.step()

    def gradients(self, loss: Tensor) -> dict[str, Tensor]:
        """As in `Engine`; DeepSpeed clears its buffers in a step only, so one of rate 0 is taken (moments move)."""
        from deepspeed.utils import safe_get_full_grad

        self.module.backward(loss)
        found = {name: safe_get_full_grad(p).detach().cpu().clone() for name, p in self.names().items()}
        for group in self.optimizer.param_groups:
            group["lr"] = 0.0
        self.module.step()
        return found

    def state(self, wanted: Container[str]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        from deepspeed.utils import safe_get_full_optimizer_state

        model = self._collect(self._tensors(wanted))
        held = self.optimizer.state.get(self._flat()[0], {})
        optimizer: dict[str, Tensor] = {}
        for name, parameter in self.names().items():
            for key, value in held.items():
                whole = value if key == COUNTER else safe_get_full_optimizer_state(parameter, key)
                if rank() == 0:
                    whole = whole if isinstance(whole, Tensor) else torch.tensor(float(whole))
                    optimizer[f"{name}/{key}"] = whole.detach().cpu().clone()
        return model, optimizer

    def load(self, optimizer: dict[str, Tensor], scaler: dict[str, float]) -> None:
        if not optimizer:
            return
        parameters = self.names()
        states = {key.rsplit("/", 1)[1]: value for key, value in optimizer.items()}
        counter = states.pop(COUNTER, None)
        for flat in self._flat():
            counted = {} if counter is None else {COUNTER: counter.clone()}
            self.optimizer.state[flat] = {**counted, **{key: torch.zeros_like(flat) for key in sorted(states)}}
        if self.stage < 3:
            from deepspeed.utils import lazy_init_hp_params_optimizer_state

            for group, flat in zip(self._zero.bit16_groups, self._flat(), strict=True):
                lazy_init_hp_params_optimizer_state(group, flat, self.optimizer.state)
        for key, value in optimizer.items():
            name, state = key.rsplit("/", 1)
            if state != COUNTER:
                self._put(parameters[name], value.float().reshape(value.shape or (1,)), state)

    def _put(self, parameter: nn.Parameter, value: Tensor, key: str) -> None:
        """This rank's part of a whole optimiser tensor into its partition."""
        from deepspeed.utils import safe_set_full_optimizer_state, safe_set_local_optimizer_state

        value = value.to(self.accelerator.device)
        if self.stage < 3:
            safe_set_full_optimizer_state(parameter, value, key)
            return
        # DeepSpeed's own "full" setter forgets that partitions are padded to equal sizes
        size = parameter.ds_tensor.numel()  # type: ignore[attr-defined]
        padded = value.new_zeros(size * world_size())
        padded[: value.numel()] = value.flatten()
        safe_set_local_optimizer_state(parameter, padded[rank() * size : (rank() + 1) * size], key)

    def _flat(self) -> list[Tensor]:
        """This rank's partitions of the trained parameters in float32, one a group."""
        zero = self._zero
        flat = zero.fp32_partitioned_groups_flat if self.stage == 3 else zero.single_partition_of_fp32_groups
        return list(flat)

    def _tensors(self, wanted: Container[str]) -> Iterator[tuple[str, Tensor]]:
        """The wanted tensors of the model, each whole for as long as the caller looks at it (collective)."""
        import deepspeed

        parameters = dict(self.model.named_parameters())
        for name, tensor in self.model.state_dict().items():
            if name not in wanted:
                continue
            if self.stage == 3 and name in parameters:
                with deepspeed.zero.GatheredParameters([parameters[name]]):
                    yield name, parameters[name].detach()
            else:
                yield name, tensor

    @contextmanager
    def plain(self) -> Iterator[PlaceModel]:
        if self._template is None:  # ZeRO-1 and 2 keep whole parameters on every rank
            with super().plain() as model:
                yield model
            return
        self._template.to(self.accelerator.device)
        targets = self._template.state_dict()
        with torch.no_grad():
            for name, tensor in self._tensors(self.model.state_dict()):
                targets[name].copy_(tensor)
        self._template.eval()
        try:
            yield self._template
        finally:
            self._template.to("cpu")


def zero_settings(
    given: dict[str, Any], precision: str, max_grad_norm: float | None, micro_batch: int
) -> dict[str, Any]:
    """The DeepSpeed config: what the launcher gave, completed; bf16 as autocast over float32 weights.

    Args:
        given: the launcher's DeepSpeed config.
        precision: Accelerate's mixed precision.
        max_grad_norm: largest gradient norm, or None.
        micro_batch: images on a rank.

    Raises:
        UsageError: what this project cannot do exactly under ZeRO, with the reason.
    """
    zero = {key: value for key, value in given.get("zero_optimization", {}).items() if value != "auto"}
    stage = zero.get("stage")
    if stage not in STAGES:
        raise UsageError(
            f"DeepSpeed zero_stage {stage} is not one of 1, 2, 3; without ZeRO use jobs/accelerate/ddp.yaml"
        )
    if precision == "fp16" or given.get("fp16", {}).get("enabled") is True:
        raise UsageError("engine zero: fp16 makes DeepSpeed cast the weights themselves; use bf16, or DDP for fp16")
    if precision != "bf16" and given.get("bf16", {}).get("enabled") is True:
        raise UsageError(
            "engine zero: a DeepSpeed config with bf16 enabled casts the weights themselves; take it out and launch "
            "with --mixed_precision bf16, which computes in bf16 over float32 weights"
        )
    if given.get("gradient_accumulation_steps", 1) not in (1, "auto"):
        raise UsageError(
            "engine zero: gradient_accumulation_steps must be 1, since the loss is over the global batch and not a sum "
            "over parts; to save memory use train.encode_chunk"
        )
    for what in ("optimizer", "param"):
        device = (zero.pop(f"offload_{what}", None) or {}).get("device", "none")
        if device != "none":
            raise UsageError(f"engine zero: offload_{what}_device {device} is not supported; use more ranks")
    settings: dict[str, Any] = {
        "train_micro_batch_size_per_gpu": micro_batch,
        "gradient_accumulation_steps": 1,
        "gradient_clipping": max_grad_norm or 0.0,
        "steps_per_print": 1 << 40,
        "zero_allow_untested_optimizer": True,  # plain SGD
        "zero_optimization": {
            "reduce_bucket_size": BUCKET,
            "allgather_bucket_size": BUCKET,
            **({"stage3_prefetch_bucket_size": BUCKET, "stage3_param_persistence_threshold": 100_000}
               if stage == 3 else {}),
            **zero,
        },
    }  # fmt: skip
    if precision == "bf16":
        # no module counts as safe for low-precision reduction: gradients are averaged in float32, as under DDP
        settings["torch_autocast"] = {"enabled": True, "dtype": "bfloat16", "lower_precision_safe_modules": []}
    return settings
