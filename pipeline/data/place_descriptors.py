"""The file that batches are mined from: one short descriptor for each place of a shard set.

Invariant: a file is whole or absent, and `sha256` covers every number in it and what it is about; so equal hashes mean
equal plans, and a changed file, or one of other shards, is refused.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.common.errors import DataError
from pipeline.common.files import write_atomically

FORMAT = 1


@dataclass(frozen=True)
class PlaceDescriptors:
    """Descriptors of P places.

    Raises:
        DataError: a place whose descriptor is not of unit length (a row of zeros would be like every other place).
    """

    values: NDArray[np.float16]
    """[P, d] of unit length, by place number."""
    index: str
    """Digest of the shard set's index; of several sets, joined with "+"."""
    kind: str
    """How an image was described: single, bank, permuted."""
    weights: str
    """Fingerprint of the model's weights."""
    round: int
    """The round of images that was described (of a set with R rounds: this number mod R)."""

    def __post_init__(self) -> None:
        lengths = np.linalg.norm(self.values.astype(np.float32), axis=1)
        wrong = np.flatnonzero(~(np.abs(lengths - 1) < 0.01))
        if len(wrong):
            raise DataError(
                f"{len(wrong):,} of {len(lengths):,} places have no usable descriptor (the first is place {wrong[0]}, "
                f"of length {lengths[wrong[0]]:g}): the model gives all images one descriptor, or not finite values"
            )

    @property
    def sha256(self) -> str:
        """Of the numbers and everything said about them."""
        return hashlib.sha256(self._about() + self.values.astype("<f2").tobytes()).hexdigest()

    def save(self, path: Path) -> None:
        """Writes a safetensors file: temporary name, sync, rename."""
        from safetensors.numpy import save

        told = json.dumps({"about": self._about().decode(), "sha256": self.sha256}, sort_keys=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        # one entry: safetensors writes several in any order, and equal descriptors should give equal bytes
        write_atomically(path, save({"descriptors": self.values}, metadata={"places": told}))

    def _about(self) -> bytes:
        rest = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "values"}
        return json.dumps({**rest, "format": FORMAT, "shape": self.values.shape}, sort_keys=True).encode()


def read_descriptors(path: Path, index: str, places: int, sha256: str = "") -> PlaceDescriptors:
    """Reads a file of `PlaceDescriptors.save`.

    Args:
        index: digest of the shards that it must be about.
        places: their number.
        sha256: what a run noted of it; "": not noted.

    Raises:
        DataError: missing, changed, of another format, or about other shards.
    """
    from safetensors import SafetensorError, safe_open

    again = "make it again with jobs.mine"
    try:
        with safe_open(str(path), "np") as file:
            values, told = file.get_tensor("descriptors"), json.loads(file.metadata()["places"])
        about = json.loads(told["about"])
        if about.pop("format") != FORMAT:
            raise DataError(f"{path}: another format of place descriptors: {again}")
        about.pop("shape")
        found = PlaceDescriptors(values, **about)
    except FileNotFoundError:
        raise DataError(f"{path}: the mined descriptors that batches are planned from are missing") from None
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: not a file of place descriptors ({error}): {again}") from None
    if found.sha256 != told["sha256"]:
        raise DataError(f"{path}: has changed: its sha256 is not the one inside it; {again}")
    if sha256 and found.sha256 != sha256:
        raise DataError(
            f"{path}: is not the file that this run was planned from (sha256 {found.sha256[:12]}, was {sha256[:12]}): "
            f"put that one back, or start another run"
        )
    if found.index != index or len(found.values) != places:
        raise DataError(
            f"{path}: was mined from other shards (index {found.index[:12]}, {len(found.values):,} places; these are "
            f"{index[:12]}, {places:,} places): {again}"
        )
    return found
