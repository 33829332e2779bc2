"""The published names of the model's tensors, and their fit to ours: the one naming used on disk.

Invariant: a file of ours at the paper's sizes has exactly the 668 keys of a released CricaVPR state dict, whatever
the installed transformers calls its layers (5.17 and 5.23 differ). Where the release fuses tensors (qkv; the gate
and value of SwiGLU) ours are its equal parts along the first axis, in order.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from pipeline.common.errors import UsageError

# VGG-16: torchvision's number of each stage's first convolution, in one list with ReLUs and poolings
VGG_FIRST = {1: 0, 2: 5, 3: 10, 4: 17, 5: 24}
# ours -> published, each applied where it matches; q, k, v and the SwiGLU parts are numbered by PARTS
RENAMES: list[tuple[re.Pattern[str], Any]] = [
    (re.compile(pattern), replacement)
    for pattern, replacement in [
        (r"^backbone\.vit\.encoder\.layer\.", "backbone.blocks."),
        (r"^backbone\.vit\.(model\.)?layer\.", "backbone.blocks."),  # DINOv3, in both of transformers' layouts
        (r"^backbone\.vit\.(layer)?norm\.", "backbone.norm."),
        (r"^backbone\.vit\.embeddings\.position_embeddings$", "backbone.pos_embed"),
        (r"^backbone\.vit\.embeddings\.patch_embeddings\.(projection\.)?", "backbone.patch_embed.proj."),
        (r"^backbone\.vit\.embeddings\.", "backbone."),
        (r"\.mlp\.(mlp|adapter)\.", lambda m: ".mlp." if m[1] == "mlp" else ".adapter."),
        (r"\.mlp\.(gate_proj|up_proj|weights_in)\.", ".mlp.w12."),
        (r"\.mlp\.(down_proj|weights_out)\.", ".mlp.w3."),
        (r"\.attention\.(attention\.)?([qkv]_proj|query|key|value)\.", ".attn.qkv."),
        (r"\.attention\.(o_proj|output\.dense)\.", ".attn.proj."),
        (r"\.layer_scale([12])\.lambda1$", r".ls\1.gamma"),
        (r"\.adapter\.down\.", ".adapter.D_fc1."),
        (r"\.adapter\.up\.", ".adapter.D_fc2."),
        (r"\.adapter\.paths\.(\d+)\.", lambda m: f".adapter.branch{int(m[1]) + 1}."),
        (r"(\.adapter\.branch.*)\.norm\.", r"\1.bn."),
        (r"^backbone\.stage(\d)\.(\d)\.", lambda m: f"backbone.features.{VGG_FIRST[int(m[1])] + 2 * int(m[2])}."),
        (r"^pooling\.p$", "aggregation.1.p"),
        (r"^cross_image\.", "encoder."),
    ]
]
PARTS = [("q_proj", "query", "gate_proj"), ("k_proj", "key", "up_proj"), ("v_proj", "value")]


def published_name(own: str) -> tuple[str, int]:
    """The published name of one of our tensors, and which part of that tensor ours is."""
    part = next((i for i, words in enumerate(PARTS) if any(f".{word}." in own for word in words)), 0)
    for pattern, replacement in RENAMES:
        own = pattern.sub(replacement, own)
    return own, part


def layout(own_names: Iterable[str]) -> dict[str, list[str]]:
    """Published name -> our names, in the order of the parts."""
    parts: dict[str, list[tuple[int, str]]] = {}
    for own in own_names:
        name, part = published_name(own)
        parts.setdefault(name, []).append((part, own))
    return {name: [own for _, own in sorted(owners)] for name, owners in parts.items()}


def to_published(own: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Our tensors under published names, fused where the release fuses them; contiguous, on the CPU, not shared."""
    return {
        name: torch.cat([own[n].detach().cpu() for n in names])
        if len(names) > 1
        else own[names[0]].detach().cpu().clone(memory_format=torch.contiguous_format)
        for name, names in layout(own).items()
    }


def fit(
    module: nn.Module,
    given: Mapping[str, Tensor],
    source: str,
    *,
    prefix: str = "",
    assign: bool = False,
    wanted: Iterable[str] | None = None,
) -> None:
    """Puts tensors of published names into a module, all or nothing.

    Args:
        module: what receives them.
        given: published name -> tensor.
        source: what an error message calls the origin, a file name.
        prefix: what the names of `module`'s tensors lack of the whole model's, "backbone." for a backbone alone.
        assign: replace the module's tensors (dtype and all, for a module on the meta device) instead of copying.
        wanted: our names to fill; the whole module by default.

    Raises:
        UsageError: missing or surplus names, or a shape that differs; names the first of them.
    """
    own = module.state_dict()
    names = layout(prefix + name for name in (own if wanted is None else wanted))
    missing, surplus = [n for n in names if n not in given], [n for n in given if n not in names]
    if missing or surplus:
        parts = [f"lacks {len(missing)} tensors, first '{missing[0]}'"] if missing else []
        parts += [f"has {len(surplus)} unknown tensors, first '{surplus[0]}'"] if surplus else []
        raise UsageError(f"{source} does not fit the configured model: it {' and '.join(parts)}")
    filled: dict[str, Tensor] = {}
    for name, owners in names.items():
        tensor, targets = given[name], [own[o.removeprefix(prefix)] for o in owners]
        shape = [sum(len(t) for t in targets), *targets[0].shape[1:]] if targets[0].ndim else []
        if tensor.ndim == 0 and shape == [1]:  # older files of ours hold SALAD's dustbin as a single number
            tensor = tensor[None]
        if list(tensor.shape) != shape:
            raise UsageError(
                f"{source} does not fit the configured model: '{name}' is {_shape(tensor.shape)} there, "
                f"the model wants {_shape(shape)}"
            )
        pieces = tensor.chunk(len(owners)) if len(owners) > 1 else [tensor]
        for owner, piece in zip(owners, pieces, strict=True):
            filled[owner.removeprefix(prefix)] = piece.clone(memory_format=torch.contiguous_format) if assign else piece
    module.load_state_dict(filled, strict=wanted is None, assign=assign)


def _shape(shape: Iterable[int]) -> str:
    return " x ".join(map(str, shape)) or "a single number"
