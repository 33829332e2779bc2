"""Where was this photo taken: the places of an index of a user's own photos that look most like a new one.

Invariant: every descriptor is of one image alone (`single`), or beside the model's own bank (`bank`). Photos that ask
are described and searched one by one, so that an answer never depends on which other photos were asked about, to the
last bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from pipeline.common.errors import DataError, UsageError
from pipeline.common.progress import track
from pipeline.evaluation.describe.broken import broken_photos, problem_of
from pipeline.evaluation.describe.encode import describe_alone, evaluating
from pipeline.evaluation.protocol import Protocol
from pipeline.evaluation.search.approximate import search_index
from pipeline.evaluation.sets.utm import WIDEST, meridian_offset, metres_between, to_utm
from pipeline.locate.gps import gps_position
from pipeline.locate.photo_index import PhotoIndex
from pipeline.model.cross_image import Memory

NAMES = {"utm": ("utm_east", "utm_north"), "degrees": ("lat", "lon")}


@dataclass(frozen=True)
class Answer:
    """The photos of an index that look most like one photo, best first."""

    photo: Path
    rows: list[int]
    places: list[Path]
    distances: list[float]
    """L2 between descriptors of unit length: 0 the same, 1.41 nothing in common."""
    positions: list[tuple[float, float] | None]
    """In the index's coordinates."""
    degrees: list[tuple[float, float] | None]
    """Latitude and longitude, where UTM positions were made of them."""
    metres: list[float | None]
    """From where the photo itself says that it was taken; None where it, or the place, does not."""
    own: tuple[float, float] | None = None
    """Latitude and longitude of the photo's own GPS."""
    problem: str = ""
    """What is wrong with the photo's own GPS, where something is."""

    def to_dict(self, coordinates: str) -> dict[str, Any]:
        """Plain values, coordinates under their names."""
        found = []
        for row, place in enumerate(self.places):
            entry: dict[str, Any] = {"place": str(place), "distance": self.distances[row]}
            for kind, position in ((coordinates, self.positions[row]), ("degrees", self.degrees[row])):
                if position is not None:
                    entry |= dict(zip(NAMES[kind], position, strict=True))
            if self.metres[row] is not None:
                entry["metres"] = self.metres[row]
            found.append(entry)
        own = {} if self.own is None else dict(zip(NAMES["degrees"], self.own, strict=True))
        return {"photo": str(self.photo), **own, "answers": found}


def locate(
    model: nn.Module,
    index: PhotoIndex,
    photos: Sequence[Path],
    count: int,
    device: torch.device | str,
    progress: bool = True,
) -> list[Answer]:
    """The `count` most similar photos of an index (fewer where it holds fewer) for each of `photos`.

    Raises:
        DataError: photos that do not decode (all named, `broken_photos`), or whose descriptor is not finite.
        UsageError: the index was made beside another bank than the model has.
    """
    device, protocol = torch.device(device), index.protocol
    answers = []
    with evaluating(model):
        memory = memory_of(model, protocol)
        for photo in track(photos, "locating", unit="photos") if progress else photos:
            try:
                described = describe_alone(model, photo, protocol.resize, protocol.precision, device, memory)
            except DataError as error:
                broken = [at for at, other in enumerate(photos) if problem_of(other)]
                raise broken_photos(photos, broken, "photos to locate") from error
            if not np.isfinite(described).all():
                raise DataError(f"{photo}: its descriptor is not finite: the model has diverged; take another one")
            if index.projection is not None:
                described = index.projection(described)
            squared, rows = search_index(index.index, described, min(count, len(index.photos)))
            kept = rows[0] >= 0  # an approximate search may find fewer
            found = [int(row) for row in rows[0][kept]]
            distances = [float(d) for d in np.sqrt(np.maximum(squared[0][kept], 0))]
            own, problem = gps_position(photo)
            answers.append(
                Answer(
                    photo,
                    found,
                    [index.photos[row] for row in found],
                    distances,
                    [_point(index.positions, row) for row in found],
                    [_point(index.degrees, row) for row in found],
                    [_metres(index, row, own) for row in found],
                    own,
                    problem,
                )
            )
    return answers


def memory_of(model: Any, protocol: Protocol) -> Memory | None:
    """What an index's photos are described beside; None for `single`. For a model in `evaluating`.

    Raises:
        UsageError: the model has another bank, or none.
    """
    if protocol.groups != "bank":
        return None
    bank = None if model.bank is None else model.bank.first(protocol.group_size)
    if bank is None or bank.digest != protocol.bank_digest:
        has = "none" if bank is None else bank.digest
        raise UsageError(
            f"the index was made beside the bank {protocol.bank_digest}, and this checkpoint's is {has}: put the bank "
            "back beside the weights, or build the index again"
        )
    memory: Memory = model.remember(bank)
    return memory


def place_text(position: tuple[float, float] | None, coordinates: str) -> str:
    """A position for people; empty where it is not known."""
    if position is None:
        return ""
    if coordinates == "degrees":
        return f"{position[0]:.6f}, {position[1]:.6f}"  # as map services take it
    return f"{position[0]:.1f} E  {position[1]:.1f} N"


def _point(positions: np.ndarray | None, row: int) -> tuple[float, float] | None:
    if positions is None or np.isnan(positions[row]).any():
        return None
    return float(positions[row, 0]), float(positions[row, 1])


def _metres(index: PhotoIndex, row: int, own: tuple[float, float] | None) -> float | None:
    """Distance of a photo's own GPS to a place: in the index's UTM zone, or along the ellipsoid."""
    position = _point(index.positions, row)
    if own is None or position is None:
        return None
    if index.coordinates == "degrees":
        return float(metres_between(np.array(own), np.array(position)))
    if not index.zone:
        return None
    zone, (latitude, longitude) = int(index.zone[:-1]), np.array(own).reshape(2, 1)
    if np.abs(meridian_offset(longitude, zone)).max() > WIDEST:
        return None  # another part of the world, where this zone's metres mean nothing
    (here,) = to_utm(latitude, longitude, zone, index.zone.endswith("S"))
    return float(np.hypot(*(here - np.array(position))))
