"""A model from any file or folder that a person may name: ours, or a released one."""

from __future__ import annotations

from pathlib import Path

import torch

from pipeline.model.vpr import PlaceModel
from pipeline.model.weights.files import PUBLISHED_SIZE, at_size, checkpoint_file, from_published, load_model
from pipeline.model.weights.pretrained import read_tensors
from pipeline.model.weights.released import from_release, recognise


def load_published(path: str | Path, image_size: int | str | None = None) -> PlaceModel:
    """The model of a released file: CricaVPR's, or that of another method. `image_size`: none: of its own evaluation.

    Raises:
        UsageError: nothing there, another layout, missing or surplus names, other shapes; DataError: broken.
    """
    tensors = read_tensors(str(path))
    if recognise(tensors):
        return from_release(tensors, str(path), image_size=image_size)
    return from_published(tensors, str(path), image_size or PUBLISHED_SIZE)


def load_any(path: str | Path, device: torch.device | str = "cpu", image_size: int | str | None = None) -> PlaceModel:
    """What `--checkpoint` takes, in eval mode: `load_published` for a .pth or .pth.tar, which ours never are, else
    `load_model`. `image_size`: none: what the file says."""
    file = checkpoint_file(path)
    if file.suffix in (".pth", ".tar"):
        return load_published(file, image_size).to(device)
    model = load_model(file, device)
    return model if image_size is None else at_size(model, image_size)
