"""Scenes seen from several places: what only a match in space can order."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image

from pipeline.evaluation.sets.evaluation_set import EvaluationSet


def views(place: int, count: int, tokens: int) -> torch.Tensor:
    """[count, 3, S, S]: one scene, each view moved by a token to the right and half a token down, with noise."""
    generator = torch.Generator().manual_seed(place)
    scene = torch.randn(1, 3, 16, 16, generator=generator).repeat_interleave(16, 2).repeat_interleave(16, 3)
    side = 16 * tokens
    cut = torch.cat([scene[..., 8 * i : 8 * i + side, 16 * i : 16 * i + side] for i in range(count)])
    return cut + 0.1 * torch.randn(cut.shape, generator=generator)


def turned(folder: Path, by: int = 8) -> EvaluationSet:
    """Two places; of each the database holds a moved view, behind its mirror image, which is as like in its colours."""
    database, queries, positives = [], [], []
    for place in range(2):
        scene = np.random.default_rng(place).integers(0, 256, (14, 14, 3)).repeat(8, 0).repeat(8, 1).astype(np.uint8)
        query, moved = scene[:96, :96], scene[by : 96 + by, by : 96 + by]
        for pixels, name, kept in (
            (query, f"q{place}", queries), (moved[:, ::-1], f"{place}-a", database), (moved, f"{place}-b", database)
        ):  # fmt: skip
            kept.append(folder / f"{name}.png")
            Image.fromarray(pixels).save(kept[-1])
        positives.append(np.array([2 * place + 1]))
    return EvaluationSet("turned", database, queries, positives, "pairs")
