"""What a model learns from images before its first step: NetVLAD's cluster centres.

Invariant: done once, before the first step of a new run, on rank 0 alone, from images that (shards, seed) determine,
and then made the same on all ranks; a resumed run reads the result from its checkpoint.
"""

from __future__ import annotations

import dataclasses
import sys

import torch
from torch import Tensor

from pipeline.config import ModelConfig, RunConfig
from pipeline.data.images import normalise
from pipeline.data.places import build_loader
from pipeline.distributed import broadcast_tensors, on_rank_0
from pipeline.model.aggregators.netvlad import NetVLAD
from pipeline.model.vpr import PlaceModel
from shards.index import ShardIndex


def initialise(model: PlaceModel, index: ShardIndex, config: RunConfig, device: torch.device | str) -> None:
    """Sets what has to be set from images; nothing for models that need none. Collective.

    Args:
        model: on the CPU, the same on all ranks; returned to the CPU.
        index: the shards to draw from.
        config: its data (without augmentation) and seed.
        device: where features are computed.

    Raises:
        DataError: shards that cannot be read; the same on all ranks.
    """
    if not isinstance(model.pooling, NetVLAD):
        return

    def cluster() -> None:
        print("clustering patch features for NetVLAD's start", file=sys.stderr, flush=True)
        features = sample_features(model, index, config, device)
        model.pooling.to(device).cluster(features, config.seed)
        model.cpu()

    on_rank_0(cluster, what="clustering patch features")
    with torch.no_grad():
        for name, value in broadcast_tensors(dict(model.pooling.named_parameters())).items():
            model.pooling.get_parameter(name).copy_(value)


@torch.no_grad()
def sample_features(model: PlaceModel, index: ShardIndex, config: RunConfig, device: torch.device | str) -> Tensor:
    """Patch features [n, D], at most `samples` in all and `per_image` an image, of epoch 0's first places."""
    wanted = config.model.pooling.netvlad
    data = dataclasses.replace(config.data, augment="off", places_per_batch=min(8, config.data.places_per_batch))
    generator = torch.Generator().manual_seed(config.seed)
    found: list[Tensor] = []
    model.to(device).eval()
    for batch in build_loader(index, data, config.seed, 0, 0, 0, 1):
        patches = model.backbone(normalise(batch.images.to(device)))[:, 1:]
        for image in patches:
            chosen = torch.randperm(len(image), generator=generator)[: wanted.per_image]
            found.append(image[chosen.to(image.device)])
        if sum(len(part) for part in found) >= wanted.samples:
            break
    model.train()
    return torch.cat(found)[: wanted.samples]


def random_and_frozen(model: ModelConfig) -> str:
    """What is odd about a backbone of random numbers that training leaves frozen, and what to do; "" where none is."""
    if model.trainable == "full" or model.backbone.weights is not None:
        return ""
    return (
        f"model.backbone.weights is not set, and model.trainable '{model.trainable}' leaves (a part of) the backbone "
        "frozen, as random numbers; give the file of released weights (docs/weights.md), or train it whole with "
        "--model.trainable full"
    )
