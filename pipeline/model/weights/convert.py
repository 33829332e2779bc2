"""Weights from elsewhere made ours, and ours made portable: what a source is, and the files that leave the project.

Invariant: a file that leaves stands alone: a model's safetensors file holds every tensor and its config, and names no
other file; a backbone's file holds the release's names and is read back and compared before it replaces `path`.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from pipeline.common.errors import DataError, UsageError
from pipeline.common.files import replacing
from pipeline.config import BackboneConfig, ModelConfig
from pipeline.model.backbones.transformer import SIZES
from pipeline.model.bank import bank_beside, save_bank
from pipeline.model.vpr import PlaceModel, build_model
from pipeline.model.weights.files import (
    PUBLISHED_SIZE,
    at_size,
    checkpoint_file,
    from_published,
    load_model,
    read_metadata,
    save_model,
)
from pipeline.model.weights.names import to_published
from pipeline.model.weights.pretrained import backbone_tensors, dinov3_tensors, read_tensors
from pipeline.model.weights.released import RELEASES, from_release, recognise

KINDS: dict[str, str] = {
    "model": "a model of this project",
    "cricavpr": "a released CricaVPR",
    "backbone": "a backbone",
} | RELEASES


def kind_of(source: str) -> str:
    """What lies at a path or under a hub name, a key of KINDS; a file of ours is told by its metadata, all others by
    tensor names.

    Raises:
        UsageError: nothing there; DataError: a broken file, or a pickle that holds more than tensors.
    """
    if Path(source).expanduser().exists():
        with contextlib.suppress(UsageError, DataError):  # not ours: what it is instead, the tensors tell
            read_metadata(Path(source).expanduser())
            return "model"
    return _kind(read_tensors(source))


def _kind(tensors: Mapping[str, Tensor]) -> str:
    release = recognise(tensors)
    if release is not None:
        return release
    published = any(n.startswith(("encoder.layers.", "aggregation.1.p")) or ".adapter." in n for n in tensors)
    return "cricavpr" if published else "backbone"


def read_model(source: str, kind: str, config: ModelConfig, image_size: int | str | None) -> PlaceModel:
    """A whole model in eval mode: one of ours, a released CricaVPR, or a release of another method.

    Args:
        source: a run or checkpoint folder or file of ours; a .pth or safetensors file of published names.
        kind: "model", "cricavpr" or one of RELEASES.
        config: sizes of the published CricaVPR; all others say their own.
        image_size: of the input; none: what the file says, else that of the method's own evaluation (CricaVPR: 224).

    Raises:
        UsageError: nothing there, another kind, names or shapes that do not fit; DataError: broken.
    """
    if kind == "model":
        model = load_model(Path(source).expanduser())
        return model if image_size is None else at_size(model, image_size)
    tensors = read_tensors(source)
    if kind in RELEASES:
        return from_release(tensors, source, kind, image_size)
    if _kind(tensors) != "cricavpr":
        raise UsageError(f"{source}: no released CricaVPR, it has neither adapters nor a cross-image encoder")
    return from_published(tensors, source, image_size or PUBLISHED_SIZE, config)


def read_whole(path: str, image_size: int | str | None) -> PlaceModel:
    """`read_model` of whatever whole model lies at a path.

    Raises:
        UsageError: nothing there, a backbone alone, or weights that do not fit; DataError: broken.
    """
    kind = kind_of(path)
    if kind == "backbone":
        raise UsageError(f"{path}: a backbone alone; `jobs.weights --variant NAME --to FILE` makes it a whole model")
    return read_model(path, kind, ModelConfig(), image_size)


def around_backbone(source: str, config: ModelConfig, image_size: int | str | None) -> PlaceModel:
    """The model of `config` around released backbone weights; adapters, pooling and encoder are at their start.

    Raises:
        UsageError: nothing there, or weights that do not fit `config.backbone`; DataError: broken.
    """
    return build_model(_with_backbone(config, source), image_size or PUBLISHED_SIZE).eval()


def fitting_backbone(source: str, config: BackboneConfig) -> BackboneConfig:
    """`config` with the name that the weights' width, depth and parts tell, where it was left at its default.

    Raises:
        UsageError: no backbone weights there; DataError: broken.
    """
    if config.name != BackboneConfig.name:
        return config
    given = read_tensors(source)
    registers = any("register_tokens" in name or "storage_tokens" in name for name in given)
    rope = registers and not any("pos_embed" in name or "position_embeddings" in name for name in given)
    tensors = dinov3_tensors(given, source) if rope else backbone_tensors(given, source, registers)
    width = tensors["backbone.norm.weight"].shape[0] if "backbone.norm.weight" in tensors else 0
    depth = len({name.split(".")[2] for name in tensors if name.startswith("backbone.blocks.")})
    parts = (registers, rope, any(".mlp.w12." in name for name in tensors))
    for name, size in SIZES.items():
        if (size.dim, size.depth, (size.registers > 0, size.rope, size.swiglu)) == (width, depth, parts):
            return dataclasses.replace(config, name=name)  # type: ignore[arg-type]
    raise UsageError(
        f"{source}: {depth} blocks of width {width} are none of the named backbones; "
        "give --model.backbone.name custom and its sizes"
    )


def _with_backbone(config: ModelConfig, weights: str) -> ModelConfig:
    return dataclasses.replace(config, backbone=dataclasses.replace(config.backbone, weights=weights))


def write_model(model: PlaceModel, path: Path, source: str) -> None:
    """One safetensors file with every tensor and the config, to be loaded by `load_model`; its bank in another beside.

    Metadata kept of a training checkpoint (its run, its step) goes along.
    """
    extra = {"source": Path(source).name}
    with contextlib.suppress(UsageError, DataError):  # not one of our checkpoints: it has no such metadata
        extra = read_metadata(checkpoint_file(source))["extra"] | extra
    config = dataclasses.replace(model.config, backbone=dataclasses.replace(model.config.backbone, weights=None))
    save_model(model, path, config, model.image_size, everything=True, extra=extra)
    if model.bank is not None:
        save_bank(model.bank, bank_beside(path))
    else:
        bank_beside(path).unlink(missing_ok=True)  # of other weights, which this file has replaced


def write_published(model: PlaceModel, path: Path) -> None:
    """A .pth of published names, tensors alone: what the published code's `load_state_dict` takes."""
    # given a path, torch would wrap a full disk in an error of its own
    with replacing(path) as partial, partial.open("wb") as file:
        torch.save(to_published(model.state_dict()), file)


def write_backbone(source: str, config: BackboneConfig, path: Path) -> dict[str, Tensor]:
    """A released backbone, checked against `config`, as safetensors under the release's names; gives its tensors.

    Raises:
        UsageError: nothing there, or weights that do not fit; DataError: broken, or the copy differs.
    """
    from safetensors.torch import save_file

    tensors = _checked(source, config)
    with replacing(path) as partial:
        save_file(tensors, partial, {"format": "pt", "backbone": config.name})
        again = _checked(str(partial), config)
        if any(not torch.equal(again[name], tensor) for name, tensor in tensors.items()):
            raise DataError(f"{path}: differs when it is read back; check the disk")
    return tensors


def _checked(source: str, config: BackboneConfig) -> dict[str, Tensor]:
    """The backbone's tensors under release names, after they were loaded into the backbone of `config`."""
    size = 16 * 14  # any multiple of every patch: the stored tensors do not depend on it
    plain = ModelConfig(backbone=dataclasses.replace(config, weights=source), trainable="frozen")
    plain = dataclasses.replace(
        plain,
        adapter=dataclasses.replace(plain.adapter, kind="none"),
        pooling=dataclasses.replace(plain.pooling, kind="gem"),
        cross_image=dataclasses.replace(plain.cross_image, layers=0),
    )
    backbone = build_model(plain, size if config.name != "custom" else config.patch * 4).backbone
    own = to_published({f"backbone.{name}": tensor for name, tensor in backbone.state_dict().items()})
    return {name.removeprefix("backbone."): tensor for name, tensor in own.items()}
