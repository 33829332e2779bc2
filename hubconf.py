"""Models in two lines, for programs that know nothing of this project (torch.hub reads this file):

    import torch
    model = torch.hub.load("FOLDER", "place_model", source="local", path="outputs/cricavpr")

Entries: `place_model` (any model of this project, or a release of CricaVPR or another method), `place_input` (photo ->
input), and every variant by the paper's name, as in `torch.hub.load("FOLDER", "AdaptSPM+Crica", source="local")`.
Invariant: importing this file builds nothing, and what an entry returns is in eval mode.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from pipeline.config.image_size import ImageSize
    from pipeline.model.beside import BesideBank
    from pipeline.model.vpr import PlaceModel

dependencies = ["torch", "transformers", "safetensors", "numpy", "PIL"]


def place_model(
    path: str, device: str = "cpu", image_size: int | str | None = None, bank: bool = True
) -> PlaceModel | BesideBank:
    """The model of a run folder, a checkpoint folder, a file of ours, or a release of a whole model, in eval mode.

    `model(images [b, 3, H, W])` gives unit descriptors [b, R*D]. Where training saved a bank beside the weights, each
    image is described beside it and no image changes another's descriptor (`pipeline.model.beside`). Without a bank the
    b images are one group of the cross-image encoder, so pass them one at a time.

    Args:
        path: where the weights are.
        device: where the model goes.
        image_size: a side in pixels (224), "480x640" (height x width), or "native"; none: what the file says, for a
            release that of its authors' evaluation.
        bank: False leaves a bank out.

    Raises:
        UsageError: nothing there, or weights that do not fit; DataError: a broken file.
    """
    from pipeline.model.weights.convert import read_whole  # not pipeline.api: a hub user has no evaluation packages

    model = read_whole(path, image_size).to(device).eval()
    if not bank or model.bank is None:
        return model
    from pipeline.model.beside import BesideBank

    return BesideBank(model, model.bank)


def place_input(photo: str | Path | bytes, image_size: int | str | ImageSize = 224) -> Tensor:
    """A photo (path or encoded bytes) as a model's input: float32 [1, 3, H, W], upright, ImageNet-normalised.

    `image_size`: a size, or the model's own `input_size`.

    Raises:
        DataError: it cannot be read.
    """
    from pipeline.data.images import load_image, normalise, to_input

    return normalise(to_input(load_image(photo), image_size))[None]


def _entry(name: str) -> Callable[..., PlaceModel | BesideBank]:
    def build(
        path: str | None = None, backbone: str | None = None, image_size: int | str | None = None, device: str = "cpu"
    ) -> PlaceModel | BesideBank:
        from pipeline.common.errors import UsageError
        from pipeline.model.variants import variant
        from pipeline.model.vpr import build_model
        from pipeline.model.weights.convert import around_backbone, fitting_backbone

        if path is not None:
            model = place_model(path, device, image_size)
            if variant(name, model.config) != model.config:
                raise UsageError(f"{path}: not a {name}; load it as 'place_model'")
            return model
        config = variant(name)
        if backbone is None:
            return build_model(config, image_size or 224).to(device).eval()
        config = dataclasses.replace(config, backbone=fitting_backbone(backbone, config.backbone))
        return around_backbone(backbone, config, image_size).to(device)

    build.__name__ = build.__qualname__ = name
    build.__doc__ = f"""{name} of the paper, in eval mode.

    Args:
        path: a trained model of this variant, as for `place_model`; none: an untrained one.
        backbone: released backbone weights for an untrained one; none: random weights.
        image_size: of the input, as for `place_model`; none: what the file says, else 224.
        device: where the model goes.
    """
    return build


def _variants() -> dict[str, Callable[..., PlaceModel | BesideBank]]:
    from pipeline.model.variants import VARIANTS

    return {name: _entry(name) for name in VARIANTS}


globals().update(_variants())  # the paper's names are no identifiers; torch.hub looks them up as text
