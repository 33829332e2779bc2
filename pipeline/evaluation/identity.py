"""What a result is a result of: weights and model config, the files' digest, the protocol. One value names them all.

Invariant: equal identities, equal results. An `Identity`'s digest is the only key under which anything computed from
images is kept and found again: stored descriptors, unfinished encodings, fitted PCA, photo indexes. A setting of the
model counts unless its field says that a resumed run may change it, which means that no number follows from it (or
that it only says where the weights came from, and the weights themselves are in the digest).
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from pipeline.common.errors import DataError
from pipeline.config import flatten
from pipeline.config.setting import on_resume
from pipeline.evaluation.protocol import Protocol


@dataclass(frozen=True)
class Identity:
    """Names one result."""

    of: str
    """What it is: "database", "queries" (descriptors of a side), "regions", "pca", "photos" (an index), "photo" (one
    photo)."""
    model: str
    """`model_digest`."""
    files: str
    """`files_digest` of the images, in the order of the result's rows."""
    protocol: Protocol
    """The part of the protocol that the result depends on; descriptors on its `grouping` alone."""
    more: str = ""
    """Whatever else it depends on."""

    @property
    def digest(self) -> str:
        """Sixteen hex digits of all of it."""
        plain = {**self.__dict__, "protocol": self.protocol.to_dict()}
        return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]


def model_digest(model: nn.Module) -> str:
    """Sixteen hex digits of a model: its weights and buffers, whatever file they came from, and its config.

    The config belongs to it because the same tensors give other descriptors under, for example, another
    `adapter.scale`, `cross_image.heads` or pyramid.
    """
    config = getattr(model, "config", None)
    seen = hashlib.sha256(json.dumps([type(model).__name__, counted(config)], sort_keys=True).encode())
    for name, tensor in sorted(model.state_dict().items()):
        seen.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        seen.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy())
    return seen.hexdigest()[:16]


def counted(config: Any) -> dict[str, Any]:
    """The settings of a model that its descriptors may depend on, by dotted name; {} for a model without config."""
    if not dataclasses.is_dataclass(config) or isinstance(config, type):
        return {}
    rules = on_resume(type(config))
    return {name: value for name, value in flatten(config).items() if rules[name] == "refused"}


def files_digest(paths: Sequence[Path]) -> str:
    """Sixteen hex digits that change when a file is added, removed, renamed, resized or rewritten.

    Raises:
        DataError: naming a file that cannot be read.
    """
    seen = hashlib.sha256()
    for path in paths:
        try:
            state = path.stat()
        except OSError as error:
            raise DataError(f"{path}: cannot be read ({error.strerror or error})") from None
        seen.update(f"{path}|{state.st_size}|{state.st_mtime_ns}\n".encode("utf-8", "surrogateescape"))
    return seen.hexdigest()[:16]
