"""The paper's model variants, and the baselines it is compared with, by name.

Invariant: a variant is nothing but a few settings over the paper's model; every name of `PAPER` gives a model that
differs from `CricaVPR` in what the paper's table says and in nothing else. `BASELINES` are other methods over the same
parts, each with its published sizes (docs/baselines.md).
"""

from __future__ import annotations

import dataclasses
import difflib
from typing import Any

from pipeline.common.errors import UsageError
from pipeline.config import ModelConfig

NO_CRICA: dict[str, Any] = {"cross_image.layers": 0}
FROZEN: dict[str, Any] = {"adapter.kind": "none", "trainable": "frozen"}
GEM: dict[str, Any] = {"pooling.kind": "gem"}
SPMG: dict[str, Any] = {"pooling.kind": "spmg"}

PAPER: dict[str, dict[str, Any]] = {
    "CricaVPR": {},
    # ablation on cross-image awareness; +Crica adds the cross-image encoder
    "FrozenDINOv2-GeM": FROZEN | GEM | NO_CRICA,
    "FrozenDINOv2-GeM+Crica": FROZEN | GEM,
    "FrozenDINOv2-SPM": FROZEN | NO_CRICA,
    "FrozenDINOv2-SPM+Crica": FROZEN,
    "AdaptGeM": GEM | NO_CRICA,
    "AdaptGeM+Crica": GEM,
    "AdaptSPMG": SPMG | NO_CRICA,
    "AdaptSPMG+Crica": SPMG,
    "AdaptSPM": NO_CRICA,
    "AdaptSPM+Crica": {},
    # ablation on adaptation: SPM with the cross-image encoder unless the name says GeM
    "FrozenDINOv2": FROZEN,
    "FullTunedDINOv2": {"adapter.kind": "none", "trainable": "full"},
    "VanillaAdapter": {"adapter.kind": "vanilla"},
    "ConvAdapter": {"adapter.kind": "conv"},
    "MulConvAdapter": {},
    "MulConvAdapter-GeM": GEM | NO_CRICA,
    # adapters of a single kernel size
    "1x1": {"adapter.kind": "conv1x1"},
    "3x3": {"adapter.kind": "conv3x3"},
    "5x5": {"adapter.kind": "conv5x5"},
    # encoder layers; CricaVPR has two
    "CricaVPR-1layer": {"cross_image.layers": 1},
    "CricaVPR-3layers": {"cross_image.layers": 3},
}


def _resnet(cut: str, trained: int) -> dict[str, Any]:
    """ResNet-50 up to a stage, of which the last `trained` stages are trained; no cross-image encoder."""
    tuned: dict[str, Any] = {"adapter.kind": "none", "trainable": "last", "last_blocks": trained}
    return tuned | NO_CRICA | {"backbone.name": "resnet50", "backbone.resnet.cut": cut}


def _dinov2(trained: int) -> dict[str, Any]:
    """The paper's backbone, of which the last blocks are trained instead of adapters; no cross-image encoder."""
    return NO_CRICA | {"adapter.kind": "none", "trainable": "last", "last_blocks": trained}


def _pool(kind: str, **fields: Any) -> dict[str, Any]:
    return {"pooling.kind": kind} | {f"pooling.{kind}.{field}": value for field, value in fields.items()}


RESNET_GEM = _resnet("layer4", 2) | GEM | {"pooling.normalise": False}
BASELINES: dict[str, dict[str, Any]] = {
    # on ResNet-50, as the paper compares them on the same training data (stages 1 and 2 frozen)
    "NetVLAD": _resnet("layer3", 1) | _pool("netvlad"),
    "GeM": RESNET_GEM,
    "ResNet50-GeM": RESNET_GEM,
    "CosPlace": _resnet("layer4", 2) | _pool("cosplace", dim=512),
    "EigenPlaces": _resnet("layer4", 2) | _pool("cosplace", dim=2048),
    "MixVPR": _resnet("layer3", 1) | _pool("mixvpr"),
    "ResNet50-BoQ": _resnet("layer3", 1) | _pool("boq", channels=512),
    "ResNet50-SPM": _resnet("layer4", 2),
    "ResNet50-SPM+Crica": _resnet("layer4", 2) | {"cross_image.layers": 2},
    "TransVPR": NO_CRICA
    | _pool("transvpr")
    | {
        "adapter.kind": "none",
        "trainable": "full",
        "backbone.name": "transvpr",
        "backbone.weights": None,
    },  # its own backbone, which starts at random
    # on DINOv2, what one would pick today
    "SALAD": _dinov2(4) | _pool("salad"),
    "BoQ": _dinov2(2) | _pool("boq") | {"backbone.final_norm": False},
    # the older aggregators on the paper's backbone: what the backbone alone is worth
    "DINOv2-NetVLAD": _dinov2(4) | _pool("netvlad"),
    "DINOv2-GeM": _dinov2(4) | GEM,
    "DINOv2-CosPlace": _dinov2(4) | _pool("cosplace"),
    "DINOv2-MixVPR": _dinov2(4) | _pool("mixvpr"),
    # and the aggregators over the paper's adapters
    "AdaptNetVLAD": NO_CRICA | _pool("netvlad"),
    "AdaptSALAD": NO_CRICA | _pool("salad"),
    "AdaptBoQ": NO_CRICA | _pool("boq"),
}

VARIANTS = PAPER | BASELINES


def variant(name: str, base: ModelConfig | None = None) -> ModelConfig:
    """The config of a variant by the paper's name, over `base` (sizes, weights; the paper's model by default).

    Raises:
        UsageError: an unknown name, with the nearest known one.
    """
    if name not in VARIANTS:
        folded = {known.lower(): known for known in VARIANTS}
        near = difflib.get_close_matches(name.lower(), folded, n=1, cutoff=0.4)
        hint = f"did you mean '{folded[near[0]]}'?" if near else f"known: {', '.join(VARIANTS)}"
        raise UsageError(f"unknown model variant '{name}'; {hint}")
    config = base or ModelConfig()
    for key, value in VARIANTS[name].items():
        config = _changed(config, key.split("."), value)
    return config


def _changed(config: Any, path: list[str], value: Any) -> Any:
    inner = value if len(path) == 1 else _changed(getattr(config, path[0]), path[1:], value)
    return dataclasses.replace(config, **{path[0]: inner})
