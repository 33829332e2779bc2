"""The paper's model variants by the paper's names (tables on cross-image awareness, adaptation and kernels).

Invariant: a variant is nothing but a few settings over the paper's model; every name gives a model that differs
from `CricaVPR` in what the paper's table says and in nothing else.
"""

from __future__ import annotations

import dataclasses
import difflib
from typing import Any

from pipeline.config import ModelConfig
from shards.errors import UsageError

NO_CRICA: dict[str, Any] = {"cross_image.layers": 0}
FROZEN: dict[str, Any] = {"adapter.kind": "none", "train": "frozen"}
GEM: dict[str, Any] = {"pooling.kind": "gem"}
SPMG: dict[str, Any] = {"pooling.kind": "spmg"}

VARIANTS: dict[str, dict[str, Any]] = {
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
    "FullTunedDINOv2": {"adapter.kind": "none", "train": "full"},
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
        part, _, field = key.rpartition(".")
        if part:
            changed: Any = dataclasses.replace(getattr(config, part), **{field: value})
            config = dataclasses.replace(config, **{part: changed})
        else:
            config = dataclasses.replace(config, **{field: value})
    return config
