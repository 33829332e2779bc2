"""Released weights of other methods: which method a state dict belongs to, and our model that computes the same.

Invariant: what a file is follows from its tensors' names and shapes alone, by the layouts of the public sources named
in `layouts.py`; every tensor of the file is used or known to take no part, every tensor of our model comes from the
file, and anything else is refused in the file's own names. No tensor is changed but in dtype, to float32.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping

import torch
from torch import Tensor

from pipeline.common.errors import UsageError
from pipeline.model.vpr import PlaceModel
from pipeline.model.weights.files import without_weights
from pipeline.model.weights.names import fit, layout
from pipeline.model.weights.released_layouts import (
    Layout,
    Shapes,
    boq,
    cosplace,
    gcl,
    gem,
    mixvpr,
    netvlad,
    salad,
    sfrs,
    shape_text,
    transvpr,
)

RELEASES: dict[str, str] = {
    "cosplace": "a released CosPlace or EigenPlaces",
    "mixvpr": "a released MixVPR",
    "salad": "a released SALAD",
    "boq": "a released BoQ",
    "netvlad": "a released NetVLAD",
    "sfrs": "a released SFRS",
    "gcl": "a released GCL with GeM",
    "gcl_avg": "a released GCL with average pooling",
    "transvpr": "a released TransVPR",
    "gem": "a released GeM (the visual geo-localisation benchmark's)",
    "unpooled": "a backbone whose pooling left no tensors, as in GCL's releases with average pooling",
}
# tensors that only such a release has, asked for in this order
MARKS: list[tuple[str, str]] = [
    ("sfrs", r"net_vlad\.centroids"),
    ("netvlad", r"(pool|aggregation)\.centroids"),
    ("mixvpr", r"aggregator\.mix\.0\.mix\.0\.weight"),
    ("salad", r"aggregator\.dust_bin"),
    ("boq", r"aggregator\.boqs\.0\.queries"),
    ("transvpr", r"transformer\.class_emb"),
    ("cosplace", r"aggregation\.3\.weight"),
    ("gem", r"aggregation\.[01]\.p"),
    ("gcl", r"pool\.p"),
]
LAYOUTS: dict[str, Callable[[Shapes], Layout]] = {
    "cosplace": cosplace,
    "mixvpr": mixvpr,
    "salad": salad,
    "boq": boq,
    "netvlad": netvlad,
    "sfrs": sfrs,
    "gcl": lambda shapes: gcl(shapes, average=False),
    "gcl_avg": lambda shapes: gcl(shapes, average=True),
    "transvpr": transvpr,
    "gem": gem,
}


def plain(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The same tensors without `module.` anywhere in their names: pytorch-NetVlad wraps each part by itself."""
    return {name.replace("module.", ""): tensor for name, tensor in tensors.items()}


def recognise(tensors: Mapping[str, Tensor]) -> str | None:
    """Which of `RELEASES` a state dict is, by its names; None: none of them."""
    names = plain(tensors)
    if "backbone.0.weight" in names and all(name.startswith("backbone.") for name in names):
        return "unpooled"
    kind = next((kind for kind, mark in MARKS if any(re.fullmatch(mark, name) for name in names)), None)
    if kind == "gem" and not any(re.match(r"backbone\.\d", name) for name in names):
        return None  # CricaVPR's layout has `aggregation.1.p` too
    return kind


def from_release(
    tensors: Mapping[str, Tensor], source: str, kind: str | None = None, image_size: int | str | None = None
) -> PlaceModel:
    """Our model with a release's weights, in eval mode: its forward gives the release's descriptors.

    Args:
        tensors: a state dict under the release's names.
        source: what an error message calls it, a file name.
        kind: one of `RELEASES`; none: what the names say. "gcl_avg" can only be said, its pooling leaves no trace.
        image_size: of the input; none: that of the method's own evaluation.

    Raises:
        UsageError: no such release, a variant of it that is not known here, missing, surplus or misshapen tensors.
    """
    given = plain(tensors)
    found = recognise(given)
    if found == "unpooled":
        if kind != "gcl_avg":
            raise UsageError(
                f"{source}: {RELEASES[found]}; if it is one of them, say so with --kind gcl_avg (with maximum pooling "
                "it cannot be used here)"
            )
        found = kind
    if found is None or kind not in (None, found):
        what = RELEASES[found] if found else "something that is not known here"
        raise UsageError(f"{source}: not {RELEASES[kind] if kind else 'a known release'} but {what}")
    rules = LAYOUTS[found](Shapes(given, source))
    model = without_weights(rules.config, rules.size(image_size, source))
    fit(model, _renamed(model, given, rules, source), source, assign=True)
    return model.eval()


def _renamed(model: PlaceModel, given: Mapping[str, Tensor], rules: Layout, source: str) -> dict[str, Tensor]:
    """The file's tensors under our published names, checked in the file's names."""
    own = model.state_dict()
    wanted = {name: rules.release_name(name) for name in layout(own)}
    tensors: dict[str, Tensor] = {}
    missing: list[str] = []
    for name, owners in layout(own).items():
        parts = [own[owner] for owner in owners]
        shape = (sum(len(part) for part in parts), *parts[0].shape[1:]) if parts[0].ndim else ()
        if wanted[name] in given:
            tensors[name] = _shaped(given[wanted[name]], shape, wanted[name], source)
        elif re.search(rules.optional, wanted[name]):  # zero is what leaving it out means
            tensors[name] = torch.zeros(shape, dtype=parts[0].dtype)
        else:
            missing.append(wanted[name])
    used = set(wanted.values())
    surplus = [name for name in given if name not in used and not re.search(rules.unused, name)]
    if missing or surplus:
        raise UsageError(
            f"{source} looks like {RELEASES[rules.kind]} but {_differs(missing, surplus)}; give the file as it was "
            "released"
        )
    return tensors


def _differs(missing: list[str], surplus: list[str]) -> str:
    parts = [f"lacks {len(missing)} tensors, first '{missing[0]}'"] if missing else []
    parts += [f"has {len(surplus)} unknown tensors, first '{surplus[0]}'"] if surplus else []
    return " and ".join(parts)


def _shaped(tensor: Tensor, shape: Iterable[int], name: str, source: str) -> Tensor:
    """Float32 of the wanted shape; a 1x1 convolution over one position is the Linear that ours is, and a single number
    a vector of one."""
    wanted, got = tuple(shape), tuple(tensor.shape)
    if got not in (wanted, (*wanted, 1, 1)) and (got, wanted) != ((), (1,)):
        raise UsageError(
            f"{source}: '{name}' is {shape_text(got)}, but its other tensors need {shape_text(wanted)}; the file is "
            "of a variant that is not known here, or damaged"
        )
    return (tensor.float() if tensor.is_floating_point() else tensor).reshape(wanted)
