"""A model from any file or folder that a person may name: ours, or a released one."""

from __future__ import annotations

from pathlib import Path

import torch

from pipeline.model.vpr import PlaceModel
from pipeline.model.weights.files import checkpoint_file, from_published, load_model
from pipeline.model.weights.pretrained import read_tensors
from pipeline.model.weights.released import from_release, recognise


def load_published(path: str | Path) -> PlaceModel:
    """The model of a released file, at its own input size: CricaVPR's, or that of another method.

    Raises:
        UsageError: nothing there, another layout, missing or surplus names, other shapes; DataError: broken.
    """
    tensors = read_tensors(str(path))
    return from_release(tensors, str(path)) if recognise(tensors) else from_published(tensors, str(path))


def load_any(path: str | Path, device: torch.device | str = "cpu") -> PlaceModel:
    """What `--checkpoint` takes, in eval mode: `load_published` for a .pth or .pth.tar, which ours never are, else
    `load_model`."""
    file = checkpoint_file(path)
    return load_published(file).to(device) if file.suffix in (".pth", ".tar") else load_model(file, device)
