"""The modelled bytes of a step are the bytes that pass through the collectives of real ranks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
import torch.distributed as dist
from processes import run_ranks
from torch.nn.parallel import DistributedDataParallel

from pipeline import distributed
from pipeline.benchmark.cost import ROUNDS, StepSizes, collectives, engine_wire, forward_flops, step_sizes, table
from pipeline.config import AdapterConfig, BackboneConfig, CrossImageConfig, ModelConfig
from pipeline.model.vpr import build_model
from pipeline.training.loss import MultiSimilarityLoss

SMALL = ModelConfig(
    backbone=BackboneConfig(name="custom", dim=32, depth=2, heads=2, patch=14, pretrain_grid=4),
    adapter=AdapterConfig(reduced=4),
    cross_image=CrossImageConfig(layers=2, heads=4, feedforward=48, dropout=0.0),
    trainable="full",
)
VIT_B = StepSizes(
    images=288, regions=14, dim=768, layers=2, feedforward=2048, tokens=257, depth=12,
    norms=(240, 192) * 12, trained=20_181_185, total=106_761_665,
)  # fmt: skip


def counted(joint: bool) -> dict[str, int]:
    """Bytes on the large side of every collective of one training step on this rank."""
    found = dict.fromkeys(ROUNDS, 0)

    def count(kind: str, inner: Any, side: int) -> Any:
        def wrapped(*tensors: Any, **options: Any) -> Any:
            found[kind] += tensors[side].nbytes
            return inner(*tensors, **options)

        return wrapped

    torch.manual_seed(0)
    model = build_model(SMALL, 56).train()
    module = DistributedDataParallel(model, broadcast_buffers=False)

    def average(state, bucket):  # type: ignore[no-untyped-def]  # torch reads the annotations, and wants no strings
        found["all_reduce"] += bucket.buffer().nbytes
        work = plain_all_reduce(bucket.buffer().div_(dist.get_world_size()), async_op=True)
        return work.get_future().then(lambda done: done.value()[0])

    plain_all_reduce = dist.all_reduce
    module.register_comm_hook(None, average)
    loss_function = MultiSimilarityLoss()
    distributed._all_gather = count("all_gather", distributed._all_gather, 0)
    distributed._reduce_scatter = count("reduce_scatter", distributed._reduce_scatter, 1)
    dist.all_reduce = count("all_reduce", dist.all_reduce, 0)
    labels = torch.arange(2 * dist.get_rank(), 2 * dist.get_rank() + 2).repeat_interleave(4)
    loss_function(module(torch.randn(8, 3, 56, 56), joint=joint), labels).backward()
    return found


@pytest.mark.parametrize(("world", "passes"), [(2, 1), (4, 1), (2, 2)])
def test_bytes_of_a_step_are_those_of_the_model(world: int, passes: int) -> None:
    sizes = step_sizes(build_model(SMALL, 56), images=8, passes=passes)
    wanted = dict.fromkeys(ROUNDS, 0)
    for collective in collectives(sizes, world):
        wanted[collective.kind] += collective.nbytes
    for found in run_ranks(counted, world, passes == 2):
        assert found == wanted


def test_sizes_of_the_published_model() -> None:
    with torch.device("meta"):
        model = build_model(ModelConfig(), 224)
    assert step_sizes(model, 288) == VIT_B


def test_nothing_grows_faster_than_keys_and_own_rows() -> None:
    """From W to 2 W: gathered parts at most double (a little more while W - 1 is not yet W), the rest stays."""
    for w in (4, 8, 16, 32):
        small, large = collectives(VIT_B, w), collectives(VIT_B, 2 * w)
        for a, b in zip(small, large, strict=True):
            growth = b.wire(2 * w) / a.wire(w)
            assert growth <= 1 / (1 - 1 / w) * (1 - 1 / (2 * w)) * (1 if a.kind == "all_reduce" else 2) + 1e-9
        assert forward_flops(VIT_B, 2 * w)["own rows"] == 2 * forward_flops(VIT_B, w)["own rows"]
        assert forward_flops(VIT_B, 2 * w)["backbone"] == forward_flops(VIT_B, w)["backbone"]
    flops = forward_flops(VIT_B, 64)
    assert flops["own rows"] < 0.1 * flops["backbone"] < flops["redundant"]


def test_table_and_engines() -> None:
    rows = table(VIT_B, (1, 2, 64)).rows
    assert len(rows) == 3
    assert rows[0][:3] == ["1", "288", "0.0"]
    assert collectives(VIT_B, 1) == []
    once, twice = forward_flops(VIT_B, 2), forward_flops(replace(VIT_B, passes=2), 2)
    assert twice["backbone"] == once["backbone"]  # joint training: one pass of the backbone, under 1 % more in all
    own = [sum(flops.values()) - flops["redundant"] for flops in (once, twice)]
    assert 1 < own[1] / own[0] < 1.01
    half = replace(VIT_B, key_bytes=2)
    assert collectives(half, 2)[0].nbytes * 2 == collectives(VIT_B, 2)[0].nbytes
    # sharded parameters travel whole, frozen ones too: five times the bytes of DDP's gradients at ViT-B with adapters
    assert 5 < engine_wire("fsdp2", VIT_B, 8) / engine_wire("ddp", VIT_B, 8) < 6
