"""CricaVPR, its loss and other methods' released networks, restated: names and shapes of their state dicts, and their
forward passes.

Written from the paper and from the public sources named in pipeline/model/weights/released_layouts.py, in plain
functional torch on a state dict; nothing of the project is used, so that its model, loss and conversions are compared
with something else than themselves.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor

State = dict[str, Tensor]
Shape = dict[str, tuple[int, ...]]

VGG_CHANNELS = [
    (0, 3, 64), (2, 64, 64), (5, 64, 128), (7, 128, 128), (10, 128, 256), (12, 256, 256), (14, 256, 256),
    (17, 256, 512), (19, 512, 512), (21, 512, 512), (24, 512, 512), (26, 512, 512), (28, 512, 512),
]  # fmt: skip
SEQUENTIAL = ("0", "1", "4", "5", "6", "7")  # torchvision's ResNet as a list of children; ReLU and pooling are 2 and 3
NAMED = ("conv1", "bn1", "layer1", "layer2", "layer3", "layer4")
BLOCKS = {"resnet18": (2, 2, 2, 2), "resnet50": (3, 4, 6, 3)}


def filled(shapes: Shape) -> State:
    """Values from names: convolutions keep the size of what goes through, statistics are off their start."""
    return {name: _value(name, shape) for name, shape in shapes.items()}


def _value(name: str, shape: tuple[int, ...]) -> Tensor:
    if name.endswith("num_batches_tracked"):
        return torch.tensor(7)
    generator = torch.Generator().manual_seed(zlib.crc32(name.encode()))
    z = torch.randn(shape, generator=generator)
    if name.endswith("running_var"):
        return 1 + 0.3 * z.abs()
    if name.endswith(".p"):
        return 2.5 + 0.3 * z
    if name.endswith(("centroids", "queries", "cls_token", "pos_embed")):
        return 0.3 * z
    if name.endswith("gamma"):
        return 0.5 + 0.1 * z
    if len(shape) <= 1:
        return (0 if name.endswith(("bias", "running_mean")) else 1) + 0.1 * z
    return z * (2 / z[0].numel()) ** 0.5


def vgg_shapes(prefix: str) -> Shape:
    """The thirteen convolutions of VGG-16 under their numbers in torchvision's `features`."""
    shapes: Shape = {}
    for i, channels, out in VGG_CHANNELS:
        shapes |= {f"{prefix}{i}.weight": (out, channels, 3, 3), f"{prefix}{i}.bias": (out,)}
    return shapes


def vgg(state: State, prefix: str, x: Tensor, last: int) -> Tensor:
    """Layers 0 to `last` of torchvision's `features`: 28 is the last convolution, 30 the last pooling."""
    for i in range(last + 1):
        if f"{prefix}{i}.weight" in state:
            x = F.conv2d(x, state[f"{prefix}{i}.weight"], state[f"{prefix}{i}.bias"], padding=1)
        else:
            x = F.max_pool2d(x, 2, 2) if i in (4, 9, 16, 23, 30) else x.relu()
    return x


def resnet_shapes(
    parts: Sequence[str], blocks: Sequence[int], width: int = 64, basic: bool = False, groups: int = 1
) -> Shape:
    """A residual network whose first convolution, its norm and its stages are called `parts`."""
    shapes: Shape = {}

    def conv(name: str, out: int, channels: int, kernel: int) -> None:
        shapes[f"{name}.weight"] = (out, channels, kernel, kernel)

    def norm(name: str, channels: int) -> None:
        for part in ("weight", "bias", "running_mean", "running_var"):
            shapes[f"{name}.{part}"] = (channels,)
        shapes[f"{name}.num_batches_tracked"] = ()

    conv(parts[0], width, 3, 7)
    norm(parts[1], width)
    channels = width
    for stage, count in enumerate(blocks):
        narrow = width * 2**stage
        out = narrow if basic else 4 * narrow
        middle = narrow if groups == 1 else 4 * narrow
        for j in range(count):
            name = f"{parts[2 + stage]}.{j}"
            if basic:
                layers = [(narrow, channels, 3), (narrow, narrow, 3)]
            else:
                layers = [(middle, channels, 1), (middle, middle // groups, 3), (out, middle, 1)]
            for k, (to, of, kernel) in enumerate(layers, 1):
                conv(f"{name}.conv{k}", to, of, kernel)
                norm(f"{name}.bn{k}", to)
            if j == 0 and (stage > 0 or channels != out):
                conv(f"{name}.downsample.0", out, channels, 1)
                norm(f"{name}.downsample.1", out)
            channels = out
    return shapes


def resnet(state: State, parts: Sequence[str], x: Tensor, groups: int = 1) -> Tensor:
    """To the last stage there is: [b, 3, H, W] -> [b, D, h, w]."""

    def norm(x: Tensor, name: str) -> Tensor:
        mean, var, weight, bias = (state[f"{name}.{p}"] for p in ("running_mean", "running_var", "weight", "bias"))
        return F.batch_norm(x, mean, var, weight, bias, False, 0.0, 1e-5)

    x = norm(F.conv2d(x, state[f"{parts[0]}.weight"], stride=2, padding=3), parts[1]).relu()
    x = F.max_pool2d(x, 3, 2, 1)
    for stage, part in enumerate(parts[2:]):
        j = 0
        while f"{part}.{j}.conv1.weight" in state:
            name, stride = f"{part}.{j}", 2 if stage > 0 and j == 0 else 1
            basic = f"{name}.conv3.weight" not in state
            first, second = (stride, 1) if basic else (1, stride)
            y = norm(F.conv2d(x, state[f"{name}.conv1.weight"], stride=first, padding=int(basic)), f"{name}.bn1").relu()
            y = norm(F.conv2d(y, state[f"{name}.conv2.weight"], stride=second, padding=1, groups=groups), f"{name}.bn2")
            if not basic:
                y = norm(F.conv2d(y.relu(), state[f"{name}.conv3.weight"]), f"{name}.bn3")
            if f"{name}.downsample.0.weight" in state:
                x = norm(F.conv2d(x, state[f"{name}.downsample.0.weight"], stride=stride), f"{name}.downsample.1")
            x, j = (x + y).relu(), j + 1
    return x


def linear_shapes(name: str, out: int, channels: int) -> Shape:
    """Weight and bias."""
    return {f"{name}.weight": (out, channels), f"{name}.bias": (out,)}


def dinov2_shapes(prefix: str, dim: int, depth: int, grid: int, patch: int = 14) -> Shape:
    """A released DINOv2."""
    shapes: Shape = {
        "cls_token": (1, 1, dim), "pos_embed": (1, 1 + grid * grid, dim), "mask_token": (1, dim),
        "patch_embed.proj.weight": (dim, 3, patch, patch), "patch_embed.proj.bias": (dim,),
        "norm.weight": (dim,), "norm.bias": (dim,),
    }  # fmt: skip
    for i in range(depth):
        block = f"blocks.{i}."
        for name in ("norm1", "norm2"):
            shapes |= {f"{block}{name}.weight": (dim,), f"{block}{name}.bias": (dim,)}
        shapes |= linear_shapes(f"{block}attn.qkv", 3 * dim, dim) | linear_shapes(f"{block}attn.proj", dim, dim)
        shapes |= linear_shapes(f"{block}mlp.fc1", 4 * dim, dim) | linear_shapes(f"{block}mlp.fc2", dim, 4 * dim)
        shapes |= {f"{block}ls1.gamma": (dim,), f"{block}ls2.gamma": (dim,)}
    return {prefix + name: shape for name, shape in shapes.items()}


def dinov2(
    state: State, prefix: str, x: Tensor, final_norm: bool, adapter: Callable[[str, Tensor], Tensor] | None = None
) -> tuple[Tensor, Tensor]:
    """[b, 3, S, S] -> (patch map [b, D, S / 14, S / 14], class token [b, D]); heads of 64, patches of 14.

    `adapter(name of the block, normed tokens)` is added to each block's MLP.
    """

    def get(name: str) -> Tensor:
        return state[prefix + name]

    def norm(x: Tensor, name: str) -> Tensor:
        return F.layer_norm(x, x.shape[-1:], get(f"{name}.weight"), get(f"{name}.bias"), 1e-6)

    def linear(x: Tensor, name: str) -> Tensor:
        return x @ get(f"{name}.weight").T + get(f"{name}.bias")

    x = F.conv2d(x, get("patch_embed.proj.weight"), get("patch_embed.proj.bias"), stride=14)
    side = x.shape[-1]
    x = x.flatten(2).transpose(1, 2)
    b, n, dim = x.shape
    stored = get("pos_embed")
    grid = round((stored.shape[1] - 1) ** 0.5)
    positions = stored[:, 1:].reshape(1, grid, grid, dim).permute(0, 3, 1, 2)
    if grid != side:
        scale = (side + 0.1) / grid
        positions = F.interpolate(positions.float(), scale_factor=(scale, scale), mode="bicubic").to(x.dtype)
    x = torch.cat((get("cls_token").expand(b, 1, dim) + stored[:, :1], x + positions.flatten(2).transpose(1, 2)), 1)
    i = 0
    while f"{prefix}blocks.{i}.norm1.weight" in state:
        block = f"blocks.{i}."
        q, k, v = linear(norm(x, f"{block}norm1"), f"{block}attn.qkv").view(b, n + 1, 3, -1, 64).unbind(2)
        scores = torch.einsum("bqhd,bkhd->bhqk", q, k) / 8
        mixed = torch.einsum("bhqk,bkhd->bqhd", scores.softmax(-1), v).flatten(2)
        x = x + get(f"{block}ls1.gamma") * linear(mixed, f"{block}attn.proj")
        normed = norm(x, f"{block}norm2")
        added = linear(F.gelu(linear(normed, f"{block}mlp.fc1")), f"{block}mlp.fc2")
        if adapter is not None:
            added = added + adapter(prefix + block, normed)
        x = x + get(f"{block}ls2.gamma") * added
        i += 1
    if final_norm:
        x = norm(x, "norm")
    return x[:, 1:].transpose(1, 2).reshape(b, dim, side, side), x[:, 0]


def cricavpr_shapes(dim: int, depth: int, grid: int, reduced: int, layers: int, feedforward: int) -> Shape:
    """CricaVPR: DINOv2 with an adapter in every block, GeM's exponent, the cross-image encoder."""
    shapes = dinov2_shapes("backbone.", dim, depth, grid)
    width = dim // 2
    for i in range(depth):
        adapter = f"backbone.blocks.{i}.adapter"
        shapes |= linear_shapes(f"{adapter}.D_fc1", width, dim) | linear_shapes(f"{adapter}.D_fc2", dim, width)
        for name, conv in {
            "branch1": (width // 2, width, 1, 1),
            "branch2.0": (reduced, width, 1, 1), "branch2.1": (width // 4, reduced, 3, 3),
            "branch3.0": (reduced, width, 1, 1), "branch3.1": (width // 4, reduced, 5, 5),
        }.items():  # fmt: skip
            shapes |= {f"{adapter}.{name}.conv.weight": conv, f"{adapter}.{name}.conv.bias": conv[:1]}
            for part in ("weight", "bias", "running_mean", "running_var"):
                shapes[f"{adapter}.{name}.bn.{part}"] = conv[:1]
            shapes[f"{adapter}.{name}.bn.num_batches_tracked"] = ()
    shapes["aggregation.1.p"] = (1,)
    for i in range(layers):
        layer = f"encoder.layers.{i}"
        shapes |= {f"{layer}.self_attn.in_proj_weight": (3 * dim, dim), f"{layer}.self_attn.in_proj_bias": (3 * dim,)}
        shapes |= linear_shapes(f"{layer}.self_attn.out_proj", dim, dim)
        shapes |= linear_shapes(f"{layer}.linear1", feedforward, dim)
        shapes |= linear_shapes(f"{layer}.linear2", dim, feedforward)
        shapes |= {f"{layer}.{norm}.{part}": (dim,) for norm in ("norm1", "norm2") for part in ("weight", "bias")}
    return shapes


def mulconv(state: State, block: str, x: Tensor, train: bool) -> Tensor:
    """CricaVPR's adapter (section 3.3), its factor 0.2 included: tokens [b, 1 + N, D] -> the same. Moves the running
    statistics in `state` in training."""
    name = f"{block}adapter."

    def conv(x: Tensor, path: str) -> Tensor:
        weight = state[f"{name}{path}.conv.weight"]
        x = F.conv2d(x, weight, state[f"{name}{path}.conv.bias"], padding=weight.shape[-1] // 2)
        mean, var, gain, bias = (
            state[f"{name}{path}.bn.{p}"] for p in ("running_mean", "running_var", "weight", "bias")
        )
        if train:
            own, spread = x.mean((0, 2, 3)), x.var((0, 2, 3))
            mean.lerp_(own.detach(), 0.1)
            var.lerp_(spread.detach(), 0.1)
            mean, var = own, x.var((0, 2, 3), correction=0)
        x = (x - mean.view(1, -1, 1, 1)) / (var + 1e-3).sqrt().view(1, -1, 1, 1)
        return (x * gain.view(1, -1, 1, 1) + bias.view(1, -1, 1, 1)).relu()

    hidden = (x @ state[f"{name}D_fc1.weight"].T + state[f"{name}D_fc1.bias"]).relu()
    side = round((x.shape[1] - 1) ** 0.5)
    grid = hidden[:, 1:].transpose(1, 2).unflatten(2, (side, side))
    paths = [conv(grid, "branch1")] + [conv(conv(grid, f"branch{n}.0"), f"branch{n}.1") for n in (2, 3)]
    patches = torch.cat(paths, 1).flatten(2).transpose(1, 2) + hidden[:, 1:]
    mixed = torch.cat((2 * hidden[:, :1], patches), 1)
    return 0.2 * (mixed @ state[f"{name}D_fc2.weight"].T + state[f"{name}D_fc2.bias"])


def cricavpr(state: State, x: Tensor, heads: int, train: bool) -> Tensor:
    """[B, 3, S, S] -> [B, 14 D] of unit length; no dropout."""
    patches, token = dinov2(state, "backbone.", x, True, lambda block, tokens: mulconv(state, block, tokens, train))
    patches, side = F.normalize(patches, dim=1), patches.shape[-1]
    regions = [token]
    for n in (2, 3):
        edges = [int(i * side / n + 0.5) for i in range(n + 1)]
        for top, bottom in pairwise(edges):
            for left, right in pairwise(edges):
                regions.append(gem(patches[:, :, top:bottom, left:right], state["aggregation.1.p"]))
    related = [encoded(state, region, heads) for region in regions]
    return F.normalize(torch.cat(related, 1), dim=1)


def encoded(state: State, x: Tensor, heads: int) -> Tensor:
    """The cross-image encoder on one region of all images, [B, D]: the images are the sequence."""
    i = 0
    while (layer := f"encoder.layers.{i}.") + "norm1.weight" in state:

        def linear(x: Tensor, name: str, layer: str = layer) -> Tensor:
            return x @ state[f"{layer}{name}.weight"].T + state[f"{layer}{name}.bias"]

        def norm(x: Tensor, name: str, layer: str = layer) -> Tensor:
            return F.layer_norm(x, x.shape[-1:], state[f"{layer}{name}.weight"], state[f"{layer}{name}.bias"])

        qkv = x @ state[f"{layer}self_attn.in_proj_weight"].T + state[f"{layer}self_attn.in_proj_bias"]
        q, k, v = (part.unflatten(1, (heads, -1)) for part in qkv.chunk(3, 1))
        scores = torch.einsum("qhd,khd->hqk", q, k) / q.shape[-1] ** 0.5
        mixed = torch.einsum("hqk,khd->qhd", scores.softmax(-1), v).flatten(1)
        x = norm(x + linear(mixed, "self_attn.out_proj"), "norm1")
        x, i = norm(x + linear(F.gelu(linear(x, "linear1")), "linear2"), "norm2"), i + 1
    return x


def multi_similarity(
    x: Tensor, labels: list[int], ignored: Callable[[int, int], bool] = lambda place, other: False
) -> Tensor:
    """The Multi-Similarity loss with its mining, pair by pair: alpha 1, beta 50, lambda 0, margin 0.1, mean over all
    anchors. `ignored(place, other place)`: their images are no negatives of each other."""
    unit = F.normalize(x, dim=1)
    total = x.new_zeros(())
    for q, place in enumerate(labels):
        s = unit @ unit[q]
        same = [i for i, label in enumerate(labels) if label == place and i != q]
        other = [i for i, label in enumerate(labels) if label != place and not ignored(place, label)]
        hard, easy = max(s[i] for i in other), min(s[i] for i in same)
        push = [torch.exp(-s[i]) for i in same if s[i] - 0.1 < hard]
        pull = [torch.exp(50 * s[i]) for i in other if s[i] + 0.1 > easy]
        total = total + torch.log1p(sum(push, x.new_zeros(()))) + torch.log1p(sum(pull, x.new_zeros(()))) / 50
    return total / len(labels)


def gem(x: Tensor, p: Tensor) -> Tensor:
    """[b, D, h, w] -> [b, D]."""
    return x.clamp(min=1e-6).pow(p).mean((2, 3)).pow(1 / p)


def vlad_shapes(prefix: str, clusters: int, dim: int, bias: bool = False) -> Shape:
    """NetVLAD's assignment and centres."""
    shapes: Shape = {f"{prefix}conv.weight": (clusters, dim, 1, 1), f"{prefix}centroids": (clusters, dim)}
    return shapes | ({f"{prefix}conv.bias": (clusters,)} if bias else {})


def vlad(state: State, prefix: str, x: Tensor) -> Tensor:
    """[b, D, h, w] -> [b, K * D] of unit length, cluster by cluster."""
    x = F.normalize(x, dim=1)
    assigned = F.conv2d(x, state[f"{prefix}conv.weight"], state.get(f"{prefix}conv.bias")).softmax(1)
    centres = state[f"{prefix}centroids"]
    sums = [(assigned[:, k : k + 1] * (x - centres[k].view(1, -1, 1, 1))).sum((2, 3)) for k in range(len(centres))]
    return F.normalize(F.normalize(torch.stack(sums, 1), dim=2).flatten(1), dim=1)


def mixvpr_shapes(positions: int, dim: int, channels: int, rows: int, depth: int, bias: bool) -> Shape:
    """MixVPR's aggregator; with and without a bias in the row projection."""
    shapes: Shape = linear_shapes("aggregator.channel_proj", channels, dim)
    shapes |= linear_shapes("aggregator.row_proj", rows, positions)
    for i in range(depth):
        mix = f"aggregator.mix.{i}.mix"
        shapes |= {f"{mix}.0.weight": (positions,), f"{mix}.0.bias": (positions,)}
        shapes |= linear_shapes(f"{mix}.1", positions, positions) | linear_shapes(f"{mix}.3", positions, positions)
    if not bias:
        del shapes["aggregator.row_proj.bias"]
    return shapes


def mixvpr(state: State, x: Tensor) -> Tensor:
    """[b, D, h, w] -> [b, channels * rows]."""
    x, i = x.flatten(2), 0
    while (mix := f"aggregator.mix.{i}.mix") + ".0.weight" in state:
        y = F.layer_norm(x, x.shape[-1:], state[f"{mix}.0.weight"], state[f"{mix}.0.bias"])
        y = F.linear(y, state[f"{mix}.1.weight"], state[f"{mix}.1.bias"]).relu()
        x, i = x + F.linear(y, state[f"{mix}.3.weight"], state[f"{mix}.3.bias"]), i + 1
    x = torch.einsum("bdn,cd->bcn", x, state["aggregator.channel_proj.weight"])
    x = x + state["aggregator.channel_proj.bias"].view(1, -1, 1)
    x = F.linear(x, state["aggregator.row_proj.weight"], state.get("aggregator.row_proj.bias"))
    return F.normalize(x.flatten(1), dim=1)


def salad_shapes(dim: int, clusters: int, channels: int, token: int, hidden: int) -> Shape:
    """SALAD's aggregator."""
    a = "aggregator."
    shapes = linear_shapes(f"{a}token_features.0", hidden, dim) | linear_shapes(f"{a}token_features.2", token, hidden)
    for name, out in (("cluster_features", channels), ("score", clusters)):
        shapes |= {f"{a}{name}.0.weight": (hidden, dim, 1, 1), f"{a}{name}.0.bias": (hidden,)}
        shapes |= {f"{a}{name}.3.weight": (out, hidden, 1, 1), f"{a}{name}.3.bias": (out,)}
    return shapes | {f"{a}dust_bin": ()}


def salad(state: State, x: Tensor, token: Tensor) -> Tensor:
    """Patch map [b, D, h, w] and class token [b, D] -> [b, token + channels * clusters]."""

    def two(x: Tensor, name: str) -> Tensor:
        x = F.conv2d(x, state[f"aggregator.{name}.0.weight"], state[f"aggregator.{name}.0.bias"]).relu()
        return F.conv2d(x, state[f"aggregator.{name}.3.weight"], state[f"aggregator.{name}.3.bias"]).flatten(2)

    features, scores = two(x, "cluster_features"), two(x, "score")
    b, m, n = scores.shape
    scores = torch.cat((scores, state["aggregator.dust_bin"].expand(b, 1, n)), 1)
    # probabilities as published: masses 1 of m + n for a cluster and a patch, n - m for the dustbin
    rows = torch.cat((torch.ones(m), torch.tensor([n - m]))) / (m + n)
    plan = scores.exp()
    u, v = torch.ones(b, m + 1), torch.ones(b, n)
    for _ in range(3):
        u = rows / (plan * v[:, None]).sum(2)
        v = 1 / (m + n) / (plan * u[:, :, None]).sum(1)
    plan = (plan * u[:, :, None] * v[:, None])[:, :-1] * (m + n)
    gathered = F.normalize(torch.einsum("bln,bmn->blm", features, plan), dim=1)
    first = F.linear(token, state["aggregator.token_features.0.weight"], state["aggregator.token_features.0.bias"])
    last = F.linear(
        first.relu(), state["aggregator.token_features.2.weight"], state["aggregator.token_features.2.bias"]
    )
    return F.normalize(torch.cat((F.normalize(last, dim=1), gathered.flatten(1)), 1), dim=1)


def boq_shapes(dim: int, channels: int, queries: int, layers: int, rows: int) -> Shape:
    """BoQ's aggregator."""
    a = "aggregator."
    shapes: Shape = {f"{a}proj_c.weight": (channels, dim, 3, 3), f"{a}proj_c.bias": (channels,)}
    shapes |= linear_shapes(f"{a}fc", rows, layers * queries)
    norms = [f"{a}norm_input"]
    for i in range(layers):
        block = f"{a}boqs.{i}."
        shapes[f"{block}queries"] = (1, queries, channels)
        norms += [f"{block}{n}" for n in ("norm_q", "norm_out", "encoder.norm1", "encoder.norm2")]
        shapes |= linear_shapes(f"{block}encoder.linear1", 4 * channels, channels)
        shapes |= linear_shapes(f"{block}encoder.linear2", channels, 4 * channels)
        for name in ("encoder.self_attn", "self_attn", "cross_attn"):
            shapes |= {f"{block}{name}.in_proj_weight": (3 * channels, channels)}
            shapes |= {f"{block}{name}.in_proj_bias": (3 * channels,)}
            shapes |= linear_shapes(f"{block}{name}.out_proj", channels, channels)
    for name in norms:
        shapes |= {f"{name}.weight": (channels,), f"{name}.bias": (channels,)}
    return shapes


def boq(state: State, x: Tensor) -> Tensor:
    """[b, D, h, w] -> [b, channels * rows]; heads of 64."""

    def norm(x: Tensor, name: str) -> Tensor:
        return F.layer_norm(x, x.shape[-1:], state[f"{name}.weight"], state[f"{name}.bias"])

    def attend(q: Tensor, x: Tensor, name: str) -> Tensor:
        weights, biases = (state[f"{name}.in_proj_{part}"].chunk(3) for part in ("weight", "bias"))
        q, k, v = (
            F.linear(y, w, c).unflatten(-1, (-1, 64)) for y, w, c in zip((q, x, x), weights, biases, strict=True)
        )
        mixed = torch.einsum("bhqk,bkhd->bqhd", (torch.einsum("bqhd,bkhd->bhqk", q, k) / 8).softmax(-1), v)
        return F.linear(mixed.flatten(2), state[f"{name}.out_proj.weight"], state[f"{name}.out_proj.bias"])

    x = F.conv2d(x, state["aggregator.proj_c.weight"], state["aggregator.proj_c.bias"], padding=1)
    x = norm(x.flatten(2).transpose(1, 2), "aggregator.norm_input")
    answers, i = [], 0
    while (block := f"aggregator.boqs.{i}.") + "queries" in state:
        encoder = f"{block}encoder."
        x = norm(x + attend(x, x, f"{encoder}self_attn"), f"{encoder}norm1")
        hidden = F.linear(x, state[f"{encoder}linear1.weight"], state[f"{encoder}linear1.bias"]).relu()
        hidden = F.linear(hidden, state[f"{encoder}linear2.weight"], state[f"{encoder}linear2.bias"])
        x = norm(x + hidden, f"{encoder}norm2")
        q = state[f"{block}queries"].expand(len(x), -1, -1)
        q = norm(q + attend(q, q, f"{block}self_attn"), f"{block}norm_q")
        answers.append(norm(attend(q, x, f"{block}cross_attn"), f"{block}norm_out"))
        i += 1
    rows = F.linear(torch.cat(answers, 1).transpose(1, 2), state["aggregator.fc.weight"], state["aggregator.fc.bias"])
    return F.normalize(rows.flatten(1), dim=1)


def transvpr_shapes(dim: int, depth: int, width: int, levels: int = 3) -> Shape:
    """TransVPR: four stages, tokens of each, a transformer, attention pooling."""
    shapes: Shape = {"transformer.class_emb": (1, 1, dim)}
    channels = 3
    for i in range(4):
        out = width * 2**i
        shapes |= {f"conv{i + 1}.0.weight": (out, channels, 3, 3), f"conv{i + 1}.0.bias": (out,)}
        shapes |= {f"conv{i + 1}.1.{part}": (out,) for part in ("weight", "bias", "running_mean", "running_var")}
        shapes |= {f"conv{i + 1}.1.num_batches_tracked": ()}
        name, side = f"tokenizer{i + 1}.conv_layer", 8 // 2**i
        shapes |= {f"{name}.weight": (dim // 4, out, side, side), f"{name}.bias": (dim // 4,)}
        channels = out
    norms = ["transformer.norm"]
    for i in range(depth):
        block = f"transformer.blocks.{i}."
        norms += [f"{block}pre_norm", f"{block}norm1"]
        shapes |= {f"{block}self_attn.qkv.weight": (3 * dim, dim)} | linear_shapes(f"{block}self_attn.proj", dim, dim)
        shapes |= linear_shapes(f"{block}linear1", 2 * dim, dim) | linear_shapes(f"{block}linear2", dim, 2 * dim)
    for name in norms:
        shapes |= {f"{name}.weight": (dim,), f"{name}.bias": (dim,)}
    shapes |= linear_shapes("pool.fc.1", dim, levels * dim)
    return shapes | linear_shapes("pool.attention_pool", levels, levels * dim)


def transvpr_tokens(state: State, x: Tensor) -> list[Tensor]:
    """[b, 3, H, W] -> for each block [b, 1 + h*w, D] under the final norm; heads of 64."""

    def norm(x: Tensor, name: str) -> Tensor:
        return F.layer_norm(x, x.shape[-1:], state[f"{name}.weight"], state[f"{name}.bias"])

    def linear(x: Tensor, name: str) -> Tensor:
        return F.linear(x, state[f"{name}.weight"], state.get(f"{name}.bias"))

    parts = []
    for i in range(1, 5):
        mean, var, weight, bias = (state[f"conv{i}.1.{p}"] for p in ("running_mean", "running_var", "weight", "bias"))
        x = F.conv2d(x, state[f"conv{i}.0.weight"], state[f"conv{i}.0.bias"], padding=1)
        x = F.max_pool2d(F.batch_norm(x, mean, var, weight, bias, False, 0.0, 1e-5).relu(), 3, 2, 1)
        name = f"tokenizer{i}.conv_layer"
        parts.append(F.conv2d(x, state[f"{name}.weight"], state[f"{name}.bias"], stride=2 ** (4 - i)).flatten(2))
    x = torch.cat(parts, 1).transpose(1, 2)
    x = torch.cat((state["transformer.class_emb"].expand(len(x), -1, -1), x), 1)
    found: list[Tensor] = []
    while (block := f"transformer.blocks.{len(found)}.") + "norm1.weight" in state:
        q, k, v = linear(norm(x, f"{block}pre_norm"), f"{block}self_attn.qkv").unflatten(-1, (3, -1, 64)).unbind(2)
        scores = torch.einsum("bqhd,bkhd->bhqk", q, k) / 8
        mixed = torch.einsum("bhqk,bkhd->bqhd", scores.softmax(-1), v).flatten(2)
        x = norm(x + linear(mixed, f"{block}self_attn.proj"), f"{block}norm1")
        x = x + linear(F.gelu(linear(x, f"{block}linear1")), f"{block}linear2")
        found.append(norm(x, "transformer.norm"))
    return found


def transvpr_maps(state: State, every: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Tokens of the blocks -> patches of the second, fourth and sixth side by side [b, N, 3 D], maps [b, 3, N]."""
    x = torch.cat([every[i][:, 1:] for i in (1, 3, 5)], -1)
    scores = F.linear(x, state["pool.attention_pool.weight"], state["pool.attention_pool.bias"])
    return x, scores.softmax(1).transpose(1, 2)


def transvpr(state: State, x: Tensor) -> Tensor:
    """[b, 3, H, W] -> [b, D]."""
    x, maps = transvpr_maps(state, transvpr_tokens(state, x))
    sums = [maps[:, i : i + 1] @ part for i, part in enumerate(x.chunk(3, -1))]
    found = F.normalize(torch.cat(sums, -1).squeeze(1), dim=-1)
    return F.normalize(F.linear(found, state["pool.fc.1.weight"], state["pool.fc.1.bias"]), dim=-1)
