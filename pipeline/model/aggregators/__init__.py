"""Aggregators of the baselines by name; each maps tokens [b, 1 + h*w, D] and their grid to regions [b, R, D'].

Invariant: `PlaceModel.correlate` flattens and L2-normalises what comes out, which is each method's own last step; so
with `cross_image.layers: 0` the descriptor is the published one. Attributes of each: `regions` R, `dim` D', and
`least`, the tokens that each side of a grid needs (none: its weights are for the one grid that it was built for).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import nn

from pipeline.config.model import PoolingConfig
from pipeline.model.aggregators.boq import BoQ
from pipeline.model.aggregators.cosplace import CosPlace
from pipeline.model.aggregators.mixvpr import MixVPR
from pipeline.model.aggregators.netvlad import NetVLAD
from pipeline.model.aggregators.salad import SALAD
from pipeline.model.aggregators.transvpr import AttentionMaps
from pipeline.model.pooling import Grid, Pooling

AGGREGATORS: dict[str, Callable[[PoolingConfig, int, Grid], nn.Module]] = {
    "netvlad": lambda config, dim, grid: NetVLAD(config.netvlad, dim),
    "cosplace": lambda config, dim, grid: CosPlace(config.cosplace, dim, config.p),
    "mixvpr": lambda config, dim, grid: MixVPR(config.mixvpr, dim, grid),
    "salad": lambda config, dim, grid: SALAD(config.salad, dim, grid),
    "boq": lambda config, dim, grid: BoQ(config.boq, dim, grid),
    "transvpr": lambda config, dim, grid: AttentionMaps(config.transvpr, dim),
}


def build_pooling(config: PoolingConfig, dim: int, grid: Grid) -> Any:
    """The pooling or aggregator of a config for tokens of width `dim` on a grid of patches.

    Raises:
        UsageError: settings that do not fit the grid or each other.
    """
    if config.kind in AGGREGATORS:
        return AGGREGATORS[config.kind](config, dim, grid)
    return Pooling(config, grid, dim)
