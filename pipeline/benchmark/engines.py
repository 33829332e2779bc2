"""How far an engine is from one process: three steps on the same small global batches, whole tensors out.

`differences` launches every engine in processes of its own; each of them is this file, run by a launcher:
`accelerate launch --config_file FILE -m pipeline.benchmark.engines --write TENSORS`.

Invariant: the batches, the weights they start from and the steps are functions of nothing but the code, dropout is 0,
every rank has different images, and the optimiser is plain SGD, which does not hide a wrong scale as Adam does. So
whatever the launch, the answers may differ by rounding alone.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from pipeline.common.errors import UsageError
from pipeline.config import AdapterConfig, BackboneConfig, CrossImageConfig, ModelConfig, TrainConfig
from pipeline.distributed import rank_slice
from pipeline.model.vpr import build_model
from pipeline.training.engines.build import build_engine
from pipeline.training.launch import launched
from pipeline.training.loss import MultiSimilarityLoss

MODEL = ModelConfig(
    backbone=BackboneConfig(name="custom", dim=32, depth=2, heads=2, patch=14, pretrain_grid=4),
    adapter=AdapterConfig(reduced=4),
    cross_image=CrossImageConfig(layers=2, heads=4, feedforward=48, dropout=0.0),
    trainable="full",
)
Trainable = Literal["adapters", "full", "frozen", "last"]
# DeepSpeed keeps its master weights in float32, whatever it is given
PRECISIONS = {"ddp": ("float64", "float32"), "fsdp2": ("float64", "float32")}
PLACES, VIEWS, SIZE, STEPS, RATE = 8, 4, 56, 3, 0.1


@dataclasses.dataclass(frozen=True)
class Difference:
    """Largest difference between two sets of tensors.

    Attributes:
        gradient: of the first step's gradients, relative to each tensor's norm; the largest tensor's.
        tensor: which tensor that is.
        weight: of the weights after three steps, relative to the largest change that the steps made.
        tensors: how many were compared.
    """

    gradient: float
    tensor: str
    weight: float
    tensors: int


def batches(dtype: torch.dtype) -> list[Tensor]:
    """The global batches: three of [32, 3, 56, 56], noisy views of eight places, so that mining finds pairs."""
    generator = torch.Generator().manual_seed(5)
    places = torch.randn(PLACES, 1, 3, SIZE, SIZE, generator=generator, dtype=torch.float64)
    noise = torch.randn(STEPS, PLACES, VIEWS, 3, SIZE, SIZE, generator=generator, dtype=torch.float64)
    return [(0.3 * places + n).reshape(PLACES * VIEWS, 3, SIZE, SIZE).to(dtype) for n in noise]


def measure(
    accelerator: Any, config: TrainConfig, dtype: torch.dtype, trainable: Trainable = "full"
) -> dict[str, Tensor]:
    """Three SGD steps under this launch's engine (collective).

    Args:
        accelerator: from `launch.start`.
        config: `engine`, `encode_chunk` and `passes` are used.
        dtype: of weights and images.
        trainable: `ModelConfig.trainable`.

    Returns:
        On rank 0 `start/<name>`, `gradient/<name>` (first batch, averaged over ranks), `weight/<name>` (after the
        steps, buffers too); {} elsewhere.
    """
    torch.manual_seed(3)
    model = build_model(dataclasses.replace(MODEL, trainable=trainable), SIZE)
    for adapter in model.backbone.adapters():  # they start at a zero output; give them one, so that all parts matter
        for parameter in adapter.parameters():
            torch.nn.init.normal_(parameter, std=0.1)
    model = model.to(dtype).train()
    start = {f"start/{name}": tensor.clone() for name, tensor in model.state_dict().items()}
    micro = len(batches(dtype)[0][rank_slice(PLACES * VIEWS)])
    engine = build_engine(config, accelerator, model, _sgd, micro)
    loss_function = MultiSimilarityLoss()
    labels = torch.arange(PLACES).repeat_interleave(VIEWS)
    mine = rank_slice(PLACES * VIEWS)

    def loss(images: Tensor) -> Tensor:
        part = images[mine].to(accelerator.device)
        with accelerator.autocast():
            descriptors = engine(part, chunk=config.encode_chunk, joint=config.passes == "joint")
        value: Tensor = loss_function(descriptors, labels[mine].to(accelerator.device))
        return value

    data = batches(dtype)
    engine.model.train()
    gradients = engine.gradients(loss(data[0]))
    for images in data:
        engine.step(loss(images), RATE)
    weights, _ = engine.state(list(engine.model.state_dict()))
    if not weights:
        return {}
    return {
        **start,
        **{f"gradient/{name}": tensor for name, tensor in gradients.items()},
        **{f"weight/{name}": tensor for name, tensor in weights.items()},
    }


def _sgd(parameters: Any) -> torch.optim.Optimizer:
    return torch.optim.SGD([p for p in parameters if p.requires_grad], lr=RATE)


def compare(truth: dict[str, Tensor], found: dict[str, Tensor]) -> Difference:
    """How far `found` is from `truth`, both from `measure`.

    A tensor whose true gradient is zero (a bias in front of BatchNorm, or on attention keys) is measured against the
    largest gradient of all, for its own norm is rounding.

    Raises:
        ValueError: they do not hold the same tensors.
    """
    if truth.keys() != found.keys():
        raise ValueError(f"not the same tensors: {sorted(truth.keys() ^ found.keys())[:3]}")
    gradients = [name for name in truth if name.startswith("gradient/")]
    largest = max(truth[name].double().norm().item() for name in gradients)
    worst, where = 0.0, ""
    for name in gradients:
        norm = truth[name].double().norm().item()
        scale = norm if norm > 1e-6 * largest else largest
        difference = (truth[name].double() - found[name].double()).norm().item() / scale
        if difference >= worst:
            worst, where = difference, name.removeprefix("gradient/")
    floats = [name.removeprefix("weight/") for name in truth if name.startswith("weight/")]
    floats = [name for name in floats if truth[f"weight/{name}"].is_floating_point()]
    moved = max((truth[f"weight/{n}"].double() - truth[f"start/{n}"].double()).abs().max().item() for n in floats)
    apart = max((truth[f"weight/{n}"].double() - found[f"weight/{n}"].double()).abs().max().item() for n in floats)
    return Difference(worst, where, apart / moved, len(gradients))


def differences(
    configs: Path, engines: Sequence[str], processes: int, trainable: Trainable, config: TrainConfig
) -> Iterator[str]:
    """Launches one process in float64, then every engine; a markdown table, line by line.

    Args:
        configs: folder of the launchers' configurations, `<engine>.yaml`.
        engines: names of its files.
        processes: ranks of each launch.
        trainable: what of the backbone is trained.
        config: `encode_chunk` and `passes` are used.

    Raises:
        UsageError: no such engine, or its launch failed.
    """
    for engine in engines:
        if not (configs / f"{engine}.yaml").exists():
            known = sorted(path.stem for path in configs.glob("*.yaml"))
            raise UsageError(f"no engine '{engine}'; there are {', '.join(known)}")

    def tensors(engine: str, world: int, dtype: str) -> dict[str, Tensor]:
        file = Path(folder) / f"{engine}.{dtype}.safetensors"
        options = ["--write", str(file), "--dtype", dtype, "--trainable", trainable]
        options += ["--passes", config.passes]
        options += [] if config.encode_chunk is None else ["--encode_chunk", str(config.encode_chunk)]
        command = [sys.executable, "-m", "accelerate.commands.accelerate_cli", "launch", "--config_file"]
        command += [str(configs / f"{engine}.yaml"), "--num_processes", str(world), "--mixed_precision", "no"]
        command += ["-m", "pipeline.benchmark.engines", *options]
        done = subprocess.run(command, capture_output=True, text=True, env={"OMP_NUM_THREADS": "1", **os.environ})
        if done.returncode:
            told = [line for line in done.stderr.splitlines() if line.startswith(UsageError.__module__)]
            raise UsageError(f"engine {engine} failed: {told[0] if told else done.stderr[-2000:]}")
        return load_file(file)

    with tempfile.TemporaryDirectory() as folder:
        truth = tensors("single", 1, "float64")
        yield "| engine | numbers | gradients of the first step | weights after three steps | tensors |"
        yield "|---|---|---|---|---|"
        for engine in engines:
            for dtype in PRECISIONS.get(engine, ("float32",)):
                told = compare(truth, tensors(engine, processes, dtype))
                yield f"| {engine} | {dtype} | {told.gradient:.1e} | {told.weight:.1e} | {told.tensors} |"


def main() -> None:
    """One measurement on this rank; rank 0 writes its tensors."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--write", required=True)
    parser.add_argument("--dtype", choices=("float64", "float32"), default="float64")
    parser.add_argument("--trainable", choices=get_args(Trainable), default="full")
    parser.add_argument("--encode_chunk", type=int)
    parser.add_argument("--passes", choices=("group", "joint"), default="group")
    given = parser.parse_args()
    with launched(timeout=300.0) as accelerator:
        config = TrainConfig(encode_chunk=given.encode_chunk, passes=given.passes)
        tensors = measure(accelerator, config, getattr(torch, given.dtype), given.trainable)
        if tensors:
            save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, given.write)


if __name__ == "__main__":
    main()
