"""Features of the photos of some places, as the paper's supplement maps them: pre-trained, adapted, and complete.

Invariant: which places and photos are taken follows from the folder and the seed alone; the complete model's features
come from seeded shuffled groups, told beside the figure, since the cross-image encoder mixes what shares a group.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from pipeline.common.errors import UsageError
from pipeline.config import EvaluationConfig
from pipeline.evaluation.describe.encode import encode, evaluating
from pipeline.evaluation.protocol import protocols
from pipeline.model.adapters import AdaptedMLP


@dataclass(frozen=True)
class Photos:
    """Photos of places: `labels` [n] counts the places from 0."""

    paths: list[Path]
    labels: np.ndarray
    places: list[str]


@dataclass(frozen=True)
class Features:
    """Unit features [n, d] of one stage of a model."""

    title: str
    values: np.ndarray

    def same_place(self, labels: np.ndarray) -> np.ndarray:
        """Whether each photo's nearest other photo, in the space of the features, shows the same place: bool [n]."""
        similar = self.values @ self.values.T
        np.fill_diagonal(similar, -np.inf)
        same: np.ndarray = labels[similar.argmax(1)] == labels
        return same


def choose_places(folder: Path, places: int, images: int, seed: int) -> Photos:
    """`places` places of `images` photos each, drawn from a folder in any layout that `jobs.prepare` reads.

    Raises:
        UsageError: not that many places have that many photos; DataError: the folder is malformed.
    """
    from shards.sources.registry import read_source

    catalogue = read_source(folder)
    table = catalogue.table
    groups: dict[str, list[str]] = {}
    for city, place, path, size in zip(
        *(table[name].to_pylist() for name in ("city", "place_id", "path", "size")), strict=True
    ):
        if size >= 0:
            groups.setdefault(f"{city}/{place}", []).append(path)
    enough = sorted(name for name, paths in groups.items() if len(paths) >= images)
    if len(enough) < places:
        counts = sorted((len(paths) for paths in groups.values()), reverse=True)
        most = counts[places - 1] if len(counts) >= places else 0
        hint = f"--images {most} would do" if most > 1 else f"there are {len(counts)} places"
        raise UsageError(f"{folder}: {len(enough)} places have {images} photos, {places} are wanted; {hint}")
    rng = np.random.Generator(np.random.PCG64(seed))
    taken = sorted(rng.permutation(len(enough))[:places].tolist())
    names = [enough[i] for i in taken]
    paths = [
        catalogue.root / groups[name][i]
        for name in names
        for i in sorted(rng.permutation(len(groups[name]))[:images].tolist())
    ]
    return Photos(paths, np.repeat(np.arange(places), images), names)


@contextlib.contextmanager
def pretrained(model: torch.nn.Module) -> Iterator[None]:
    """The model with its adapters off, so with the backbone as it was released; as before afterwards.

    Raises:
        UsageError: the backbone itself was trained, so the released one is not in it.
    """
    config: Any = model.config
    if config.trainable not in ("adapters", "frozen"):
        raise UsageError(
            f"the model's backbone was trained (model.trainable {config.trainable}), so its "
            "pre-trained state is not in it; give it as --baseline: released weights or another run"
        )
    adapted = [module for module in model.modules() if isinstance(module, AdaptedMLP)]
    scales = [module.scale for module in adapted]
    try:
        for module in adapted:
            module.scale = 0.0
        yield
    finally:
        for module, scale in zip(adapted, scales, strict=True):
            module.scale = scale


def stages(
    model: Any,
    baselines: Sequence[tuple[str, Any]],
    photos: Sequence[Path],
    config: EvaluationConfig,
    device: torch.device,
) -> list[Features]:
    """What a map shows: the stages of one model, or other models beside it.

    Without baselines: the regions of the backbone as released, those of the adapted one, each region of unit length,
    and the complete model's descriptors. With baselines: their own descriptors, then the complete model's.

    Args:
        model: a `PlaceModel`, as the baselines.
        photos: n paths.
        config: batch, workers, and `groups[0]`, `group_size`, `group_seed` of all descriptors.

    Raises:
        UsageError: no baseline where one is needed; DataError: photos that cannot be read.
    """
    order = np.arange(len(photos))

    def regions(of: Any, label: str) -> torch.Tensor:
        return encode(of, photos, [[[order]]], config, device, label).take(order)

    def described(of: Any, values: torch.Tensor) -> np.ndarray:
        descriptors = torch.empty(len(photos), int(of.descriptor_dim))
        for group in protocols(config, of.image_size, "")[0].form(len(photos), "database"):
            descriptors[group] = of.correlate(values[group].to(device)).float().cpu()
        return descriptors.numpy()

    def of_regions(values: torch.Tensor) -> np.ndarray:
        return F.normalize(F.normalize(values.float(), dim=-1).flatten(1), dim=-1).numpy()

    found = []
    with contextlib.ExitStack() as stack:
        for name, baseline in baselines:
            stack.enter_context(evaluating(baseline))
            found.append(Features(name, described(baseline, regions(baseline, name))))
        stack.enter_context(evaluating(model))
        if not baselines:
            with pretrained(model):
                found.append(Features("pre-trained", of_regions(regions(model, "pre-trained"))))
        adapted = regions(model, "complete")
        if not baselines and model.config.cross_image.layers:
            found.append(Features("adapted, encoder left out", of_regions(adapted)))
        found.append(Features("complete", described(model, adapted)))
    return found
