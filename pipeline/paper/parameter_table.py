"""The parameter table of the paper's supplement (section 8), for every variant: counted, never typed in.

Invariant: models are built as shapes alone, so a table costs no memory; the paper's own figures stand beside ours
where it gives them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass

import torch

from pipeline.common.text import Table
from pipeline.config import ModelConfig
from pipeline.model.variants import variant
from pipeline.model.vpr import build_model, parameter_counts

COLUMNS = ("Total", "Backbone", "Adapter", "Others", "Tunable")
# millions; the paper's names are FullTuning, Ours, and CosPlace-R (2048 numbers, as EigenPlaces has here; the paper
# leaves its total out, and its classifiers' 582.8 M exist in CosPlace's own training alone)
PAPER: dict[str, tuple[float | None, ...]] = {
    "FullTunedDINOv2": (97.6, 86.6, 0.0, 11.0, 97.6),
    "CricaVPR": (106.8, 86.6, 9.2, 11.0, 20.2),
    "EigenPlaces": (None, 23.5, 0.0, 4.2, 26.3),
}


@dataclass(frozen=True)
class Row:
    """Numbers of parameters of one model; `others`: pooling or aggregator, and cross-image encoder."""

    name: str
    total: int
    backbone: int
    adapter: int
    others: int
    tunable: int

    def counts(self) -> tuple[int, ...]:
        """In the order of `COLUMNS`."""
        return self.total, self.backbone, self.adapter, self.others, self.tunable


def row(name: str, config: ModelConfig, image_size: int = 224) -> Row:
    """Counts the parameters of a config; its weights are not read.

    Raises:
        UsageError: settings that do not fit each other.
    """
    bare = dataclasses.replace(config, backbone=dataclasses.replace(config.backbone, weights=None))
    with torch.device("meta"):
        counts = parameter_counts(build_model(bare, image_size))
    others = counts["total"] - counts["backbone"] - counts["adapters"]
    return Row(name, counts["total"], counts["backbone"], counts["adapters"], others, counts["trainable"])


def table(names: Iterable[str], image_size: int = 224) -> list[Row]:
    """The rows of variants by the paper's names. Raises `UsageError` for an unknown one."""
    return [row(name, variant(name), image_size) for name in names]


def printed(rows: Iterable[Row]) -> Table:
    """Millions of parameters; the paper's figures in brackets where they are known."""
    lines = []
    for counted in rows:
        known = PAPER.get(counted.name, (None,) * len(COLUMNS))
        lines.append([counted.name, *map(_cell, counted.counts(), known)])
    return Table(["Method", *(f"{column} (paper)" for column in COLUMNS)], lines)


def _cell(count: int, paper: float | None) -> str:
    ours = "0" if count == 0 else f"{count / 1e6:.1f}" if count >= 50_000 else "<0.1"
    return ours if paper is None else f"{ours} ({paper:.1f})"
