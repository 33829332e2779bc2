"""A bank: regional features of a fixed list of images, beside which every image is described.

Invariant: a bank is constant: its regions are rounded to float16 when it is made, so that a bank in memory and the same
bank read from its file give the same descriptors to the last bit; its digest names it in every protocol.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from pipeline.common.errors import DataError
from pipeline.common.files import replacing

FILE = "bank.safetensors"
FORMAT = "place-bank 1"


@dataclass(frozen=True)
class Bank:
    """The regions of M images.

    Attributes:
        regions: float16 [M, R, D], on the CPU.
        source: where the images are from: "train", "map" or the name of a folder.
    """

    regions: Tensor
    source: str

    @property
    def digest(self) -> str:
        """Sixteen hex digits of the regions."""
        values = self.regions.contiguous()
        seen = hashlib.sha256(str(tuple(values.shape)).encode())
        seen.update(values.reshape(-1).view(torch.uint8).numpy().tobytes())
        return seen.hexdigest()[:16]

    def first(self, images: int) -> Bank:
        """The bank of the first `images` of them: images are drawn in order, so it is the smaller draw."""
        return Bank(self.regions[:images].clone(), self.source)


def make_bank(regions: Tensor, source: str) -> Bank:
    """A bank of regions [M, R, D] in any type."""
    return Bank(regions.detach().to("cpu", torch.float16).clone(), source)


def save_bank(bank: Bank, path: Path) -> None:
    """Writes one safetensors file; replaces `path` in one step."""
    from safetensors.torch import save_file

    with replacing(path) as partial:
        save_file({"regions": bank.regions.contiguous()}, partial, {"format": FORMAT, "source": bank.source})


def bank_beside(weights: Path) -> Path:
    """The file of the bank that belongs to a file of weights: `bank.safetensors` beside a checkpoint's
    `model.safetensors`, `<name>.bank.safetensors` beside any other `<name>.safetensors`."""
    return weights.with_name(FILE if weights.name == "model.safetensors" else f"{weights.stem}.{FILE}")


def read_bank(path: Path) -> Bank | None:
    """The bank of a file; None where there is no file.

    Raises:
        DataError: it is not a bank.
    """
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="pt") as opened:
            metadata, regions = opened.metadata() or {}, opened.get_tensor("regions")
        if metadata["format"] != FORMAT or regions.ndim != 3 or regions.dtype != torch.float16 or not len(regions):
            raise DataError(f"{path}: not a bank of this version ({FORMAT}); remove it, or write it again")
        return Bank(regions, metadata["source"])
    except (SafetensorError, OSError, KeyError) as error:
        raise DataError(f"{path}: not a readable bank ({error}); remove it, or write it again") from error
