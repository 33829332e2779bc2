"""What a step sends, receives and computes on one rank as the number of ranks W grows: a model, checked by counting.

Invariant: pure functions of sizes; every collective of a DDP training step appears once, with the bytes it is handed,
and a test counts those bytes on real ranks. Bytes on the wire follow from the ring algorithms: an all-gather or a
reduce-scatter whose large side holds n bytes moves (W - 1) / W * n each way, an all-reduce twice that.

Shapes: b images on a rank, B = b W in the global batch, R regions, D channels, T tokens of an image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from pipeline.common.errors import UsageError
from pipeline.common.text import Table
from pipeline.config import ModelConfig
from pipeline.model.adapters import ConvAdapter
from pipeline.model.backbones.transformer import Backbone
from pipeline.model.batch_norm import GlobalBatchNorm2d
from pipeline.model.vpr import PlaceModel, build_model, parameter_counts

ROUNDS = {"all_gather": 1, "reduce_scatter": 1, "all_reduce": 2}


@dataclass(frozen=True)
class StepSizes:
    """What the cost of a step depends on, W aside.

    Attributes:
        images: b, on a rank.
        regions, dim, layers, feedforward: R, D and the cross-image encoder.
        tokens, depth: T and the backbone's blocks.
        norms: channels of each exchange of BatchNorm statistics: of an adapter's 1x1 paths, then of its wider ones.
        trained, total: parameters.
        key_bytes: of a gathered key or value: 4, or 2 under bf16 autocast.
        passes: descriptions of an image: 1, or 2 in joint training, of which the second needs no other image.
    """

    images: int
    regions: int
    dim: int
    layers: int
    feedforward: int
    tokens: int
    depth: int
    norms: tuple[int, ...]
    trained: int
    total: int
    key_bytes: int = 4
    passes: int = 1


def step_sizes(model: PlaceModel, images: int, key_bytes: int = 4, passes: int = 1) -> StepSizes:
    """Sizes of a step of this model with b = `images` on a rank; the model may be on the meta device.

    Raises:
        UsageError: a backbone whose operations are not those of a vision transformer.
    """
    if not isinstance(model.backbone, Backbone):
        raise UsageError(f"the cost model knows vision transformers, not {model.config.backbone.name}")
    counts = parameter_counts(model)
    encoder = model.config.cross_image
    return StepSizes(
        images=images,
        regions=model.regions,
        dim=model.descriptor_dim // model.regions,
        layers=encoder.layers,
        feedforward=encoder.feedforward,
        tokens=1 + math.prod(model.backbone.grid),
        depth=model.backbone.depth,
        norms=_exchanges(model.backbone),
        trained=counts["trainable"],
        total=counts["total"],
        key_bytes=key_bytes,
        passes=passes,
    )


def _exchanges(backbone: Backbone) -> tuple[int, ...]:
    """Channels of every group of BatchNorms that share an exchange."""
    groups = [steps for a in backbone.adapters() if isinstance(a, ConvAdapter) for steps in a.steps()]
    return tuple(
        sum(step.conv.out_channels for step in steps)
        for steps in groups
        if steps and isinstance(steps[0].norm, GlobalBatchNorm2d)
    )


@dataclass(frozen=True)
class Collective:
    """One kind of collective in one part of the step.

    Attributes:
        part: of the step.
        kind: all_gather, reduce_scatter or all_reduce.
        nbytes: handed to it on a rank in a step, on its large side (the gathered, the unreduced tensor).
    """

    part: str
    kind: str
    nbytes: int

    def wire(self, w: int) -> float:
        """Bytes a rank receives (and sends) in a step over W ranks."""
        return ROUNDS[self.kind] * (w - 1) / w * self.nbytes


def collectives(sizes: StepSizes, w: int) -> list[Collective]:
    """Every collective of one DDP step in float32, `train.encode_chunk` unset; none at W = 1."""
    if w == 1:
        return []
    everyone = sizes.images * w
    keys = sizes.layers * everyone * sizes.regions * 2 * sizes.dim * sizes.key_bytes
    descriptors = sizes.passes * everyone * sizes.regions * sizes.dim * 4
    channels = sum(sizes.norms)
    return [
        Collective("keys and values", "all_gather", keys),
        Collective("keys and values", "reduce_scatter", keys),
        Collective("descriptors", "all_gather", descriptors),
        Collective("descriptors", "reduce_scatter", descriptors),
        Collective("labels", "all_gather", sizes.passes * everyone * 8),
        Collective("BatchNorm", "all_gather", w * 4 * (2 * channels + len(sizes.norms))),
        Collective("BatchNorm", "all_reduce", 4 * 2 * channels),
        Collective("gradients", "all_reduce", 4 * sizes.trained),
        Collective("loss, mining and stop flag", "all_reduce", 4 * (4 + sizes.passes)),
    ]


def engine_wire(engine: str, sizes: StepSizes, w: int) -> float:
    """Bytes a rank receives in a step for gradients and parameters alone (float32), modelled.

    FSDP2 and ZeRO-3 gather every parameter, frozen ones too, before forward and again before backward.
    """
    share = (w - 1) / w * 4
    if engine in ("ddp", "zero1", "zero2"):  # all-reduce; or reduce-scatter and all-gather of what was updated
        return 2 * share * sizes.trained
    return share * (2 * sizes.total + sizes.trained)


def forward_flops(sizes: StepSizes, w: int) -> dict[str, float]:
    """Floating-point operations of a rank's forward pass, by part (a multiply-add is two).

    `own rows` is what this project computes in encoder attention and similarity; `redundant` what a rank would
    compute beyond it if every rank ran encoder and loss on the whole gathered batch.
    """
    b, everyone, row = sizes.images, sizes.images * w, sizes.regions * sizes.dim
    block = 24 * sizes.tokens * sizes.dim**2 + 4 * sizes.tokens**2 * sizes.dim
    forward, square = 4 * sizes.dim * sizes.feedforward, sizes.dim**2
    dense = sizes.layers * sizes.regions * (8 * square + forward)
    alone = (sizes.passes - 1) * sizes.layers * sizes.regions * (4 * square + forward)  # values, no queries nor keys
    pairs = (4 * sizes.layers + 2 * sizes.passes**2) * row
    return {
        "backbone": float(b * sizes.depth * block),
        "encoder, per image": float(b * (dense + alone)),
        "own rows": float(pairs * b * everyone),
        "redundant": float((everyone - b) * (dense + alone + pairs * everyone)),
    }


def kept_keys(sizes: StepSizes, w: int) -> int:
    """Bytes of gathered keys and values a rank keeps for backward."""
    return sizes.layers * sizes.images * w * sizes.regions * 2 * sizes.dim * sizes.key_bytes


def table(sizes: StepSizes, worlds: Sequence[int]) -> Table:
    """A row for each W: MB received by part, keys kept, GFLOP by part."""
    parts = ["keys and values", "descriptors", "BatchNorm", "gradients"]
    head = ["W", "B", *(f"{part} MB" for part in parts), "all MB", "keys kept MB"]
    head += ["backbone GFLOP", "own rows GFLOP", "redundant form GFLOP"]
    rows = []
    for w in worlds:
        found = collectives(sizes, w)
        flops = forward_flops(sizes, w)
        wire = [sum(c.wire(w) for c in found if c.part == part) for part in parts]
        numbers = [*wire, sum(c.wire(w) for c in found), float(kept_keys(sizes, w))]
        rows.append(
            [str(w), f"{sizes.images * w:,}", *(f"{n / 1e6:,.1f}" for n in numbers)]
            + [f"{flops[part] / 1e9:,.0f}" for part in ("backbone", "own rows", "redundant")]
        )
    return Table(head, rows, left=())


def tables(
    config: ModelConfig,
    image_size: int | str,
    places_per_rank: int,
    worlds: Sequence[int],
    key_bytes: int = 4,
    passes: int = 1,
) -> tuple[Table, Table]:
    """Of a model: the parts of a step; MB received for parameters and gradients under each engine, float32.

    The model is built of shapes alone: no memory, and no weights file.
    """
    with torch.device("meta"):
        model = build_model(replace(config, backbone=replace(config.backbone, weights=None)), image_size)
    sizes = step_sizes(model, 4 * places_per_rank, key_bytes, passes)
    rows = [[str(w), *(f"{engine_wire(e, sizes, w) / 1e6:,.0f}" for e in ("ddp", "fsdp2"))] for w in worlds]
    return table(sizes, worlds), Table(["W", "ddp, zero1, zero2", "fsdp2, zero3"], rows, left=())
