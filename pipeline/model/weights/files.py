"""Weights in and out: a released CricaVPR state dict, and our single safetensors file with the config inside.

Invariant: a file says by itself what model it belongs to; loading it gives that model or one clear line; nothing
foreign is unpickled. Trainable-only files carry a hash of the frozen weights they were trained beside and are
refused beside others.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pipeline.common.errors import DataError, UsageError
from pipeline.common.files import replacing, sha256_of
from pipeline.config import ModelConfig, from_dict, to_dict
from pipeline.config.image_size import ImageSize, parsed
from pipeline.model.bank import bank_beside, read_bank
from pipeline.model.vpr import PlaceModel, build_model
from pipeline.model.weights.foreign import check_file, message
from pipeline.model.weights.names import fit, layout, to_published
from pipeline.model.weights.pretrained import read_tensors, unwrap
from pipeline.model.weights.where import FILE as FILE
from pipeline.model.weights.where import checkpoint_file as checkpoint_file

FORMAT = "place-model 1"
PUBLISHED_SIZE = 224


def from_published(
    state_dict: Mapping[str, Any],
    source: str = "the state dict",
    image_size: int | str = PUBLISHED_SIZE,
    config: ModelConfig | None = None,
) -> PlaceModel:
    """The paper's model from a released CricaVPR state dict, in eval mode.

    Args:
        state_dict: its 668 tensors, with or without the `module.` prefix, also inside the published trainer's
            checkpoint (`model_state_dict`). float64 tensors stay float64, all others become float32.
        source: what an error message calls it.
        image_size: of the input; the position embedding is resized to it.
        config: a model of published names and other sizes; the paper's by default.

    Raises:
        UsageError: missing or surplus names, or other shapes.
    """
    given = {
        name: t if t.dtype == torch.float64 or not t.is_floating_point() else t.float()
        for name, t in unwrap(state_dict, source).items()
    }
    model = without_weights(config or ModelConfig(), image_size)
    fit(model, given, source, assign=True)
    return model.eval()


def without_weights(config: ModelConfig, image_size: int | str) -> PlaceModel:
    """The model with shapes but no memory, for tensors that are about to be assigned."""
    bare = dataclasses.replace(config, backbone=dataclasses.replace(config.backbone, weights=None))
    with torch.device("meta"):
        model = PlaceModel(bare, image_size)
    model.config = config
    return model


def frozen_hash(model: PlaceModel) -> str:
    """Sixteen hex digits of the weights that training leaves alone; computed once as long as they do.

    Stable over devices, precision of the copy (float32), transformers versions and adapters. Under engines that
    shard parameters, call it before wrapping and hand it to `save_model`.
    """
    frozen = {name: p for name, p in model.named_parameters() if not p.requires_grad}
    version = tuple((p.data_ptr(), p._version) for p in frozen.values())
    cached = model.__dict__.get("_frozen_hash")
    if cached is not None and cached[0] == version:
        return str(cached[1])
    digest = hashlib.sha256()
    for name, owners in sorted(layout(frozen).items()):
        digest.update(name.encode())
        for owner in owners:
            digest.update(frozen[owner].detach().float().cpu().contiguous().numpy().tobytes())
    model.__dict__["_frozen_hash"] = (version, digest.hexdigest()[:16])
    return digest.hexdigest()[:16]


def saved_names(model: PlaceModel, config: ModelConfig, everything: bool) -> list[str]:
    """Our names of the tensors a file holds: all, or what training moves (trained parameters and every buffer).

    A backbone that was drawn at random (`backbone.weights` none) can be had from nowhere else, so it goes along.
    """
    names = list(model.state_dict())
    if everything or config.backbone.weights is None:
        return names
    frozen = {name for name, p in model.named_parameters() if not p.requires_grad}
    return [name for name in names if name not in frozen]


def save_model(
    model: PlaceModel,
    path: str | Path,
    config: ModelConfig,
    image_size: int | str,
    everything: bool,
    extra: dict[str, Any] | None = None,
    *,
    state: Mapping[str, Tensor] | None = None,
    backbone_hash: str | None = None,
) -> None:
    """Writes one safetensors file of published names, config inside; replaces `path` in one step.

    Args:
        model: the bare model (not its data-parallel wrapper).
        path: the file, by convention `model.safetensors`.
        config, image_size: what `load_model` builds from.
        everything: also the frozen weights; without, the file needs `config.backbone.weights` to be read again.
        extra: JSON-able values kept in the metadata.
        state: full tensors by our names, where an engine has sharded the model's own.
        backbone_hash: `frozen_hash` taken before sharding.
    """
    from safetensors.torch import save_file

    tensors = model.state_dict() if state is None else state
    names = saved_names(model, config, everything)
    metadata = {
        "format": FORMAT,
        "config": json.dumps(to_dict(config)),
        "image_size": str(image_size),
        "everything": json.dumps(len(names) == len(model.state_dict())),
        "backbone_hash": backbone_hash or frozen_hash(model),
        "extra": json.dumps(extra or {}),
    }
    with replacing(Path(path)) as partial:
        save_file(to_published({name: tensors[name] for name in names}), partial, metadata)


def read_metadata(path: str | Path) -> dict[str, Any]:
    """What a file of ours says about itself: config (ModelConfig), image_size, everything, backbone_hash, extra.

    Raises:
        UsageError: no such file; DataError: not a safetensors file of ours.
    """
    from safetensors import SafetensorError, safe_open

    file = checkpoint_file(path)
    try:
        with safe_open(file, framework="pt") as opened:
            metadata = opened.metadata() or {}
    except (SafetensorError, OSError) as error:
        check_file(file)  # says what it is instead
        hint = "" if file.suffix == ".safetensors" else "; jobs.weights makes one of released weights"
        raise DataError(f"{file}: not a readable safetensors file ({message(error)}){hint}") from error
    if metadata.get("format") != FORMAT:
        raise DataError(f"{file}: not a model written by this project (its metadata has no format '{FORMAT}')")
    try:
        return {
            "config": from_dict(ModelConfig, json.loads(metadata["config"])),
            "image_size": parsed(metadata["image_size"]).setting,
            "everything": json.loads(metadata["everything"]),
            "backbone_hash": metadata["backbone_hash"],
            "extra": json.loads(metadata["extra"]),
        }
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise DataError(f"{file}: its metadata is damaged ({message(error)})") from error


def check_digest(file: Path) -> None:
    """Refuses a file that is not the one its checkpoint was written with, where `state.json` beside it tells.

    Raises:
        DataError: the file was changed or damaged since, or `state.json` is.
    """
    note = file.parent / "state.json"
    if not note.is_file():
        return
    try:
        told = json.loads(note.read_bytes()).get("files")  # checkpoints of before had none
        wanted = None if told is None else told[file.name]
        found = None if told is None else {"bytes": file.stat().st_size, "sha256": sha256_of(file)}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DataError(f"{note}: damaged ({message(error)}); take another checkpoint") from None
    if wanted != found:
        raise DataError(f"{file}: not the file that was written with this checkpoint; copy it again, or take another")


def load_model(path: str | Path, device: torch.device | str = "cpu") -> PlaceModel:
    """The model of a file, checkpoint folder or run folder (`outputs/<name>`), in eval mode.

    Raises:
        UsageError: nothing there, or its backbone weights are no longer where its config says; DataError: broken.
    """
    file = checkpoint_file(path)
    metadata = read_metadata(file)
    check_digest(file)
    config: ModelConfig = metadata["config"]
    if metadata["everything"]:
        model = without_weights(config, metadata["image_size"])
        fit(model, read_tensors(str(file)), str(file), assign=True)
    else:
        model = build_model(config, metadata["image_size"])
        load_trainable(model, file)
    model.bank = read_bank(bank_beside(file))
    return model.to(device).eval()


def at_size(model: PlaceModel, image_size: int | str) -> PlaceModel:
    """The same weights and bank for inputs of another size, in eval mode; the model itself where it has that size.

    Raises:
        UsageError: a size that the model cannot have.
    """
    size = ImageSize.of(image_size)
    if size.setting == model.image_size:
        return model
    if model.pooling.least is None:
        kind, own = model.config.pooling.kind, ImageSize.of(model.image_size)
        raise UsageError(f"the weights of pooling.kind {kind} are for {own.text} px alone, not for {size.text} px")
    other = without_weights(model.config, size.setting)
    fit(other, to_published(model.state_dict()), f"the model at {size.text} px", assign=True)
    other.bank = model.bank
    return other.to(next(model.parameters()).device).eval()


def load_trainable(model: PlaceModel, path: str | Path) -> dict[str, Any]:
    """Puts a file's trained weights (and all it holds) into a model built from the same config; gives its metadata.

    Raises:
        UsageError: another config, or frozen weights other than those it was trained beside; DataError: broken.
    """
    file = checkpoint_file(path)
    metadata = read_metadata(file)
    wanted = saved_names(model, model.config, metadata["everything"])
    if len(wanted) < len(model.state_dict()) and metadata["backbone_hash"] != frozen_hash(model):
        raise UsageError(
            f"{file}: trained with other frozen weights (hash {metadata['backbone_hash']}, here "
            f"{frozen_hash(model)}); give model.backbone.weights the file it was trained with"
        )
    fit(model, read_tensors(str(file)), str(file), wanted=wanted)
    return metadata
