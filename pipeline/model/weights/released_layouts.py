"""The published state dicts of other methods, written down: which settings of ours they are, and what each tensor of
ours is called there.

Invariant: a layout is read off names and shapes alone. Sources (public code, read and restated in
tests/pipeline/model/test_model_releases.py): CosPlace and EigenPlaces: `GeoLocalizationNet` of gmberton/CosPlace and
gmberton/EigenPlaces; MixVPR: amaralibey/MixVPR; SALAD: serizba/salad; BoQ: amaralibey/Bag-of-Queries; NetVLAD:
Nanne/pytorch-NetVlad, QVPR/Patch-NetVLAD (its global descriptor), and the deep visual geo-localisation benchmark, as is
GeM; SFRS: yxgeee/OpenIBL; GCL: marialeyvallina/generalized_contrastive_loss; TransVPR:
RuotongWANG/TransVPR-model-implementation.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from pipeline.common.errors import UsageError
from pipeline.config import BackboneConfig, ModelConfig
from pipeline.config.baselines import (
    AttentionMapsConfig,
    BoQConfig,
    CosPlaceConfig,
    MixVPRConfig,
    NetVLADConfig,
    ResNetConfig,
    SALADConfig,
    TransVPRConfig,
    VGGConfig,
)
from pipeline.config.image_size import ImageSize
from pipeline.model.backbones.resnet import BASIC, GROUPS, STAGES
from pipeline.model.backbones.transformer import SIZES
from pipeline.model.variants import variant

# what the public code evaluates at: the benchmark's --resize, and the size in OpenIBL, Patch-NetVLAD, GCL and TransVPR;
# CosPlace and EigenPlaces take photos as they are
BENCHMARK, PHOTOS = "480x640", "native640"
NEVER = r"(?!)"  # matches nothing
COUNTERS = r"\.num_batches_tracked$"


def shape_text(shape: Iterable[int]) -> str:
    """A shape for people: 512 x 3 x 3."""
    return " x ".join(map(str, shape)) or "a single number"


class Shapes:
    """Names and shapes of a file's tensors, and questions to them."""

    def __init__(self, tensors: Mapping[str, Tensor], source: str) -> None:
        self.shapes, self.source = {name: tuple(t.shape) for name, t in tensors.items()}, source

    def __contains__(self, name: str) -> bool:
        return name in self.shapes

    def of(self, name: str, dimensions: int) -> tuple[int, ...]:
        """The shape of a tensor that must be there with so many dimensions.

        Raises:
            UsageError: it is not, or with others.
        """
        if name not in self.shapes:
            raise UsageError(f"{self.source}: lacks '{name}', which tells its sizes; give the file as it was released")
        if len(self.shapes[name]) != dimensions:
            raise UsageError(
                f"{self.source}: '{name}' is {shape_text(self.shapes[name])}, not of {dimensions} dimensions; the file "
                "is of a variant that is not known here, or damaged"
            )
        return self.shapes[name]

    def count(self, pattern: str) -> int:
        """One more than the largest number that the pattern's group finds at the start of a name; 0: none."""
        found = [int(m[1]) for name in self.shapes if (m := re.match(pattern, name))]
        return max(found, default=-1) + 1

    def refuse(self, why: str) -> UsageError:
        """An error that names the file."""
        return UsageError(f"{self.source}: {why}")


Rule = tuple[str, str | Callable[[re.Match[str]], str]]


@dataclass(frozen=True)
class Layout:
    """A release read off its shapes.

    Attributes:
        kind: its name in `releases.RELEASES`.
        config: our model's settings.
        image_size: of the input where the user gives none: that of the method's own evaluation.
        rules: pattern of our published names -> the release's; the first that matches counts.
        fixed: whether the weights are for this size alone.
        unused: pattern of the file's tensors that take no part in descriptors.
        optional: pattern of the file's tensors whose absence means zeros.
    """

    kind: str
    config: ModelConfig
    image_size: int | str
    rules: tuple[Rule, ...]
    fixed: bool = False
    unused: str = NEVER
    optional: str = COUNTERS

    def release_name(self, own: str) -> str:
        """What the release calls a tensor of ours (by its published name)."""
        for pattern, replacement in self.rules:
            name, times = re.subn(pattern, replacement, own)
            if times:
                return name
        return own

    def size(self, wanted: int | str | None, source: str) -> int | str:
        """The size of the input.

        Raises:
            UsageError: another than the only one the weights are for.
        """
        if wanted is None:
            return self.image_size
        size = ImageSize.of(wanted)
        if self.fixed and size.setting != self.image_size:
            raise UsageError(f"{source}: its weights are for {self.image_size} px alone, not for {size.text} px")
        return size.setting


def _model(base: str, backbone: BackboneConfig, **pooling: Any) -> ModelConfig:
    """A baseline's settings with the backbone and the sizes of a release."""
    config = variant(base)
    last = {"vgg16": 1, "custom": min(config.last_blocks, backbone.depth)}.get(backbone.name, config.last_blocks)
    pools = dataclasses.replace(config.pooling, **pooling)
    return dataclasses.replace(config, backbone=backbone, pooling=pools, last_blocks=last)


def _sequence(shapes: Shapes, prefix: str, pool_last: bool = False, matconvnet: bool = False) -> Any:
    """A torchvision network cut open into one `nn.Sequential`: VGG-16's features or a residual network.

    Returns:
        The backbone's settings and the rules for its names.
    """
    if f"{prefix}0.weight" not in shapes:
        raise shapes.refuse(
            f"lacks '{prefix}0.weight', the first layer of VGG-16 or a ResNet, the networks known here (its first "
            f"tensor is '{next(iter(shapes.shapes))}')"
        )
    first = shapes.of(f"{prefix}0.weight", 4)
    if first == (64, 3, 3, 3) and f"{prefix}28.weight" in shapes and f"{prefix}1.weight" not in shapes:
        vgg = VGGConfig(cut="pool5" if pool_last else "conv5_3", layout="matconvnet" if matconvnet else "torchvision")
        return BackboneConfig(name="vgg16", vgg=vgg), ((r"^backbone\.features\.", prefix),)
    if first[1:] != (3, 7, 7):
        raise shapes.refuse(
            f"'{prefix}0.weight' is {shape_text(first)}, the first layer of no network known here (VGG-16: "
            "64 x 3 x 3 x 3, ResNets: 64 x 3 x 7 x 7)"
        )
    return _resnet(shapes, [f"{prefix}0.", f"{prefix}1.", *(f"{prefix}{i}." for i in (4, 5, 6, 7))])


def _resnet(shapes: Shapes, parts: list[str]) -> Any:
    """A residual network whose first convolution, its norm, and up to four stages are called `parts`."""
    width = shapes.of(f"{parts[0]}weight", 4)[0]
    counts = tuple(shapes.count(rf"{re.escape(part)}(\d+)\.") for part in parts[2:])
    used = counts[: counts.index(0)] if 0 in counts else counts
    if len(used) < 2:
        raise shapes.refuse("a residual network of fewer than two stages, which no release has")
    basic = f"{parts[2]}0.conv3.weight" not in shapes
    middle = shapes.of(f"{parts[2]}0.conv2.weight", 4)
    groups = middle[0] // middle[1]
    cut: Any = f"layer{len(used)}"
    rules = [(r"^backbone\.conv1\.", parts[0]), (r"^backbone\.bn1\.", parts[1])]
    rules += [(rf"^backbone\.layer{i}\.", part) for i, part in enumerate(parts[2:], 1)]
    name: Any
    for name, stages in STAGES.items():
        if (stages[: len(used)], name in BASIC, GROUPS.get(name, 1), 64) == (used, basic, groups, width):
            return BackboneConfig(name=name, resnet=ResNetConfig(cut=cut)), tuple(rules)
    if width == 64 or basic or groups > 1:
        raise shapes.refuse(f"a residual network with {used} blocks in its stages, none of {', '.join(STAGES)}")
    resnet = ResNetConfig(cut=cut, stages=used, width=width)
    return BackboneConfig(name="resnet_custom", resnet=resnet), tuple(rules)


def _dinov2(shapes: Shapes, prefix: str, final_norm: bool) -> Any:
    """DINOv2 under its release's names behind `prefix`; heads are 64 wide in all of them."""
    dim, _, patch, _ = shapes.of(f"{prefix}patch_embed.proj.weight", 4)
    depth = shapes.count(rf"{re.escape(prefix)}blocks\.(\d+)\.")
    swiglu, registers = f"{prefix}blocks.0.mlp.w12.weight" in shapes, f"{prefix}register_tokens" in shapes
    rules = ((r"^backbone\.", prefix),)
    name: Any
    for name, size in SIZES.items():
        parts = (size.dim, size.depth, size.patch, size.swiglu, size.registers > 0, size.rope)
        if parts == (dim, depth, patch, swiglu, registers, False):
            return BackboneConfig(name=name, final_norm=final_norm), rules
    if dim in {size.dim for size in SIZES.values()} or dim % 64 or swiglu or registers:
        raise shapes.refuse(f"a transformer of {depth} blocks of width {dim}, which is no DINOv2 known here")
    positions = shapes.of(f"{prefix}pos_embed", 3)[1] - 1
    hidden = shapes.of(f"{prefix}blocks.0.mlp.fc1.weight", 2)[0]
    backbone = BackboneConfig(
        name="custom", dim=dim, depth=depth, heads=dim // 64, patch=patch, mlp_ratio=hidden // dim,
        pretrain_grid=round(positions**0.5), final_norm=final_norm,
    )  # fmt: skip
    return backbone, rules


def cosplace(shapes: Shapes) -> Layout:
    """CosPlace and EigenPlaces: L2 over channels, GeM, linear layer, L2; which of the two it is no tensor tells."""
    backbone, rules = _sequence(shapes, "backbone.")
    dim = shapes.of("aggregation.3.weight", 2)[0]
    config = _model("CosPlace", backbone, cosplace=CosPlaceConfig(dim=dim))
    return Layout("cosplace", config, PHOTOS, (*rules, (r"^pooling\.fc\.", "aggregation.3.")))


def gem(shapes: Shapes) -> Layout:
    """The benchmark's GeM: with L2 over channels before it (`aggregation.1.p`) or without (`aggregation.0.p`)."""
    backbone, rules = _sequence(shapes, "backbone.")
    before = "aggregation.1.p" in shapes
    config = _model("GeM", backbone, normalise=before)
    return Layout("gem", config, BENCHMARK, (*rules, (r"^aggregation\.1\.p$", f"aggregation.{int(before)}.p")))


def gcl(shapes: Shapes, average: bool) -> Layout:
    """GCL: GeM (`pool.p`) or the average of the last map, then L2. VGG-16 goes to its last pooling."""
    backbone, rules = _sequence(shapes, "backbone.", pool_last=True)
    # the average is what residual networks and VGG have in the class token's place
    config = _model("GeM", backbone, kind="cls" if average else "gem")
    return Layout("gcl_avg" if average else "gcl", config, BENCHMARK, (*rules, (r"^aggregation\.1\.p$", "pool.p")))


def _vlad(shapes: Shapes, pool: str, projection: str) -> tuple[NetVLADConfig, tuple[Rule, ...]]:
    clusters = shapes.of(f"{pool}centroids", 2)[0]
    name = f"{projection}weight"
    projected = shapes.shapes[name][0] if name in shapes else 0
    config = NetVLADConfig(clusters=clusters, bias=f"{pool}conv.bias" in shapes, projection=projected)
    return config, ((r"^pooling\.projection\.", projection), (r"^pooling\.", pool))


def netvlad(shapes: Shapes) -> Layout:
    """NetVLAD: `encoder.*, pool.*` (pytorch-NetVlad; `WPCA.*` of Patch-NetVLAD) or `backbone.*, aggregation.*`."""
    theirs = "pool.centroids" in shapes
    backbone, rules = _sequence(shapes, "encoder." if theirs else "backbone.")
    vlad, names = _vlad(shapes, "pool." if theirs else "aggregation.", "WPCA.0.")
    return Layout("netvlad", _model("NetVLAD", backbone, netvlad=vlad), BENCHMARK, (*rules, *names))


def sfrs(shapes: Shapes) -> Layout:
    """SFRS: VGG-16 for RGB 0..255 less means, NetVLAD, and in the hub's file PCA with whitening as a convolution."""
    backbone, rules = _sequence(shapes, "base_model.base.", matconvnet=True)
    vlad, names = _vlad(shapes, "net_vlad.", "pca_layer.")
    return Layout("sfrs", _model("NetVLAD", backbone, netvlad=vlad), BENCHMARK, (*rules, *names))


def mixvpr(shapes: Shapes) -> Layout:
    """MixVPR on a ResNet with torchvision's names; its weights are for one number of positions, so for one size."""
    backbone, rules = _resnet(shapes, [f"backbone.model.{part}." for part in _RESNET_PARTS])
    positions = shapes.of("aggregator.row_proj.weight", 2)[1]
    grid, depth = round(positions**0.5), shapes.count(r"aggregator\.mix\.(\d+)\.")
    if grid * grid != positions:
        raise shapes.refuse(f"'aggregator.row_proj.weight' is for {positions} positions, which are no square")
    hidden = shapes.of("aggregator.mix.0.mix.1.weight", 2)[0]
    settings = MixVPRConfig(
        channels=shapes.of("aggregator.channel_proj.weight", 2)[0],
        rows=shapes.of("aggregator.row_proj.weight", 2)[0],
        depth=depth,
        mlp_ratio=hidden / positions,
    )
    stride = 2 ** (int(backbone.resnet.cut[-1]) + 1)
    config = _model("MixVPR", backbone, mixvpr=settings)
    # the repository's own class has no bias in the row projection, the released files do
    optional = rf"{COUNTERS}|^aggregator\.row_proj\.bias$"
    return Layout("mixvpr", config, grid * stride, (*rules, AGGREGATOR), fixed=True, optional=optional)


def salad(shapes: Shapes) -> Layout:
    """SALAD on DINOv2 with its final norm."""
    backbone, rules = _dinov2(shapes, "backbone.model.", final_norm=True)
    settings = SALADConfig(
        clusters=shapes.of("aggregator.score.3.weight", 4)[0],
        channels=shapes.of("aggregator.cluster_features.3.weight", 4)[0],
        token=shapes.of("aggregator.token_features.2.weight", 2)[0],
        hidden=shapes.of("aggregator.score.0.weight", 4)[0],
    )
    config = _model("SALAD", backbone, salad=settings)
    return Layout("salad", config, 322, (*rules, AGGREGATOR), optional=r"mask_token$")


def boq(shapes: Shapes) -> Layout:
    """BoQ on DINOv2 without its final norm, or on a ResNet cut open: in one list, or in a frozen and a trained one."""
    optional = COUNTERS
    if any(name.startswith("backbone.dino.") for name in shapes.shapes):
        backbone, rules = _dinov2(shapes, "backbone.dino.", final_norm=False)
        base, size, optional = "BoQ", 322, r"mask_token$"
    elif any(name.startswith("backbone.net.") for name in shapes.shapes):
        backbone, rules = _sequence(shapes, "backbone.net.")
        base, size = "ResNet50-BoQ", 384
    else:
        frozen = shapes.count(r"backbone\.frozen_layers\.(\d+)\.")
        names = [f"backbone.frozen_layers.{i}." for i in range(frozen)]
        names += [f"backbone.unfrozen_layers.{i}." for i in range(5 - frozen)]
        backbone, rules = _resnet(shapes, [f"{names[0]}0.", f"{names[0]}1.", *names[1:]])
        base, size = "ResNet50-BoQ", 384
    settings = BoQConfig(
        channels=shapes.of("aggregator.proj_c.weight", 4)[0],
        queries=shapes.of("aggregator.boqs.0.queries", 3)[1],
        layers=shapes.count(r"aggregator\.boqs\.(\d+)\."),
        rows=shapes.of("aggregator.fc.weight", 2)[0],
    )
    config = _model(base, backbone, boq=settings)
    unused = r"^backbone\.dino\.norm\."
    return Layout("boq", config, size, (*rules, AGGREGATOR), unused=unused, optional=optional)


def transvpr(shapes: Shapes) -> Layout:
    """TransVPR: heads are 64 wide and the levels evenly spread over the blocks, as in its only published size."""
    dim, depth = shapes.of("transformer.class_emb", 3)[2], shapes.count(r"transformer\.blocks\.(\d+)\.")
    levels = shapes.of("pool.attention_pool.weight", 2)[0]
    if dim % 64 or depth % levels:
        raise shapes.refuse(f"a transformer of {depth} blocks of width {dim} with {levels} levels, not known here")
    settings = TransVPRConfig(
        dim=dim,
        depth=depth,
        heads=dim // 64,
        mlp_ratio=shapes.of("transformer.blocks.0.linear1.weight", 2)[0] // dim,
        width=shapes.of("conv1.0.weight", 4)[0],
        levels=tuple(depth // levels * i for i in range(1, levels + 1)),
    )
    backbone = BackboneConfig(name="transvpr", transvpr=settings)
    config = _model("TransVPR", backbone, transvpr=AttentionMapsConfig(levels=levels))
    rules: tuple[Rule, ...] = (
        (r"^backbone\.", ""), (r"^pooling\.fc\.", "pool.fc.1."), (r"^pooling\.", "pool."),
    )  # fmt: skip
    return Layout("transvpr", config, BENCHMARK, rules)


AGGREGATOR: Rule = (r"^pooling\.", "aggregator.")
_RESNET_PARTS = ("conv1", "bn1", "layer1", "layer2", "layer3", "layer4")
