"""`train.compile`: the transformer blocks through torch.compile, in place.

Invariant: names of parameters and buffers stay as they are, so checkpoints do not know of it; every block is the same
code, so it is compiled once and used `depth` times; validation runs uncompiled, so a validated recall is the one that
`jobs.evaluate` finds in the saved weights. What does not go together is refused at the start, with the reason.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import torch

from pipeline.common.errors import UsageError
from pipeline.config import RunConfig
from pipeline.model.vpr import PlaceModel


def compile_backbone(model: PlaceModel, config: RunConfig, engine: str, device: torch.device) -> None:
    """Compiles the model's blocks at their first forward; nothing where the config does not ask for it.

    Args:
        model: not yet wrapped.
        config: the run.
        engine: "ddp" (also one process), "fsdp2" or "deepspeed".
        device: where training runs; the compiler is tried there first.

    Raises:
        UsageError: an engine or chunks that it does not go with, or no working compiler on this machine.
    """
    if not config.train.compile:
        return
    if engine != "ddp":
        raise UsageError(
            f"train.compile is for one process and DDP, not for {engine}, whose hooks gather each block's parameters "
            "around its call; launch with jobs/accelerate/ddp.yaml or leave train.compile out"
        )
    if config.train.encode_chunk is not None:
        raise UsageError(
            "train.compile does not go with train.encode_chunk: chunks recompute each block in backward, and "
            "compiled code cannot tell BatchNorm so; leave one of the two out"
        )
    _try_compiler(device)
    for block in model.backbone.blocks:
        block.compile()


def _try_compiler(device: torch.device) -> None:
    """Compiles one line, so that a machine without a compiler is told so before the data are read."""
    try:
        torch.compile(_one_line)(torch.zeros(8, device=device))
    except Exception as error:  # the compiler's errors have no common kind
        reason = next(line for line in [*str(error).splitlines(), type(error).__name__] if line.strip())
        raise UsageError(f"train.compile: torch.compile does not work here ({reason}); leave it out") from error


def _one_line(x: torch.Tensor) -> torch.Tensor:
    return torch.sin(x) + 1


@contextmanager
def uncompiled(compiled: bool) -> Iterator[None]:
    """Within it compiled modules run as they were written: other shapes and modes are not worth compiling for.

    Where nothing is `compiled` it does nothing, and spares the second that loading the compiler takes.
    """
    with torch.compiler.set_stance("force_eager") if compiled else nullcontext():
        yield
