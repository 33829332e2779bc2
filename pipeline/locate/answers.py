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
from pipeline.config.image_size import input_size
from pipeline.evaluation.describe.broken import broken_photos, problem_of
from pipeline.evaluation.describe.encode import describe_alone, evaluating
from pipeline.evaluation.protocol import Protocol
from pipeline.evaluation.search.approximate import search_index
from pipeline.evaluation.sets.utm import WIDEST, meridian_offset, metres_between, to_utm
from pipeline.locate.photo_index import PhotoIndex
from pipeline.locate.photos import Taken, taken
from pipeline.model.cross_image import Memory

NOWHERE = Taken()
RADIUS = 25.0  # metres within which an answer is right, as the field counts


@dataclass(frozen=True)
class Found:
    """One photo of an index that looks like the photo that asks."""

    row: int
    """Of the index."""
    place: Path
    distance: float
    """L2 between descriptors of unit length: 0 the same, 1.41 nothing in common."""
    confidence: float | None = None
    """Share of photos from elsewhere that would be farther away (`no_match`); None where the index cannot tell."""
    utm: tuple[float, float] | None = None
    """East and north in metres, in the index's zone."""
    degrees: tuple[float, float] | None = None
    """Latitude and longitude."""
    metres: float | None = None
    """From where the photo itself says that it was taken; None where it, or the place, does not."""
    right: bool | None = None
    """Whether that is within the radius; None where it is not known."""

    def to_dict(self) -> dict[str, Any]:
        """Plain values; what is not known is left out."""
        entry: dict[str, Any] = {"place": str(self.place), "distance": self.distance}
        if self.utm is not None:
            entry |= {"utm_east": self.utm[0], "utm_north": self.utm[1]}
        if self.degrees is not None:
            entry |= {"lat": self.degrees[0], "lon": self.degrees[1]}
        for name in ("confidence", "metres", "right"):
            if getattr(self, name) is not None:
                entry[name] = getattr(self, name)
        return entry


@dataclass(frozen=True)
class Answer:
    """The photos of an index that look most like one photo, best first."""

    photo: Path
    found: list[Found]
    matched: bool | None = None
    """False: probably not on this map; None where the index cannot tell."""
    own: Taken = NOWHERE
    """Where the photo itself says that it was taken."""

    def to_dict(self) -> dict[str, Any]:
        """Plain values; what is not known is left out."""
        own: dict[str, Any] = {}
        if self.own.degrees is not None:
            own = {"lat": self.own.degrees[0], "lon": self.own.degrees[1]}
        if self.matched is not None:
            own["matched"] = self.matched
        return {"photo": str(self.photo), **own, "answers": [found.to_dict() for found in self.found]}


class Locator:
    """A model and an index that are ready to answer."""

    def __init__(self, model: nn.Module, index: PhotoIndex, device: torch.device | str, radius: float = RADIUS) -> None:
        """`radius`: metres within which an answer is right. Raises `UsageError` for another bank or size of input than
        the index's."""
        if input_size(model).setting != index.protocol.image_size:
            raise UsageError(
                f"the index was made of photos at image_size {index.protocol.image_size}, this model takes "
                f"{input_size(model).setting}: load it with the index's, or build the index again"
            )
        self.model, self.index, self.device, self.radius = model, index, torch.device(device), radius
        with evaluating(model):
            self._memory = memory_of(model, index.protocol)

    def answer(self, photo: Path, count: int, data: bytes | None = None) -> Answer:
        """The `count` most similar photos of the index (fewer where it holds fewer).

        `data`: the photo's bytes; then `photo` is a name alone, and no file is read.

        Raises:
            DataError: the photo does not decode, or its descriptor is not finite.
        """
        index, protocol, source = self.index, self.index.protocol, photo if data is None else data
        with evaluating(self.model):
            described = describe_alone(
                self.model, source, protocol.resize, protocol.precision, self.device, self._memory
            )
        if not np.isfinite(described).all():
            raise DataError(f"{photo}: its descriptor is not finite: the model has diverged; take another one")
        if index.projection is not None:
            described = index.projection(described)
        squared, rows = search_index(index.index, described, min(count, len(index.photos)), protocol.refine)
        kept = rows[0] >= 0  # an approximate search may find fewer
        own = taken(photo.name, source, index.about.get("given_zone", ""))
        found = [
            self._found(int(row), float(np.sqrt(max(0.0, float(far)))), own)
            for row, far in zip(rows[0][kept], squared[0][kept], strict=True)
        ]
        return Answer(photo, found, index.calibration.matched(found[0].distance) if found else None, own)

    def _found(self, row: int, distance: float, own: Taken) -> Found:
        index = self.index
        position, degrees = _point(index.positions, row), _point(index.degrees, row)
        if index.coordinates == "degrees":
            degrees, position = position, None
        metres = _metres(index, position, degrees, own)
        right = None if metres is None else metres <= self.radius
        confidence = index.calibration.confidence(distance)
        return Found(row, index.photos[row], distance, confidence, position, degrees, metres, right)


def locate(
    model: nn.Module,
    index: PhotoIndex,
    photos: Sequence[Path],
    count: int,
    device: torch.device | str,
    progress: bool = True,
    radius: float = RADIUS,
) -> list[Answer]:
    """The `count` most similar photos of an index (fewer where it holds fewer) for each of `photos`.

    Raises:
        DataError: photos that do not decode (all named, `broken_photos`), or whose descriptor is not finite.
        UsageError: the index was made beside another bank than the model has.
    """
    locator, answers = Locator(model, index, device, radius), []
    for photo in track(photos, "locating", unit="photos") if progress else photos:
        try:
            answers.append(locator.answer(photo, count))
        except DataError as error:
            broken = [at for at, other in enumerate(photos) if problem_of(other)]
            if not broken:
                raise
            raise broken_photos(photos, broken, "photos to locate") from error
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


def _point(positions: np.ndarray | None, row: int) -> tuple[float, float] | None:
    if positions is None or np.isnan(positions[row]).any():
        return None
    return float(positions[row, 0]), float(positions[row, 1])


def _metres(
    index: PhotoIndex, utm: tuple[float, float] | None, degrees: tuple[float, float] | None, own: Taken
) -> float | None:
    """Distance of a photo's own position to a place: in the index's UTM zone, or along the ellipsoid."""
    if utm is not None and own.metres is not None and own.zone == index.zone:
        return float(np.hypot(own.metres[0] - utm[0], own.metres[1] - utm[1]))
    if own.degrees is None or degrees is None:
        return None
    if utm is None:
        return float(metres_between(np.array(own.degrees), np.array(degrees)))
    zone, (latitude, longitude) = int(index.zone[:-1]), np.array(own.degrees).reshape(2, 1)
    if np.abs(meridian_offset(longitude, zone)).max() > WIDEST:
        return None  # another part of the world, where this zone's metres mean nothing
    (here,) = to_utm(latitude, longitude, zone, index.zone.endswith("S"))
    return float(np.hypot(*(here - np.array(utm))))
