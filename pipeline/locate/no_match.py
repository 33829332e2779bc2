"""When is a photo probably not on the map at all? A threshold calibrated on the index itself.

A photo of a place that the index does not hold still has a nearest photo, at some distance. Which distances are usual
then is measured on the index: for some of its photos, the distance to the nearest photo of another place. A new photo's
confidence is the share of these distances that are larger than its own. Where it is below `LEAST`, the answer says
"probably not on this map": about 1 in 20 photos from elsewhere would still pass for a match.

Invariant: the distances come from the index's own search, so an approximate one is calibrated by its own answers. It
assumes that photos from elsewhere look as different from the map as its own places do from each other; photos of
another kind (night, another camera) are farther from their own place too, and pass less often.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.evaluation.search.approximate import search_index
from pipeline.evaluation.sets.utm import metres_between
from pipeline.locate.photos import Photos

LEAST = 0.95  # confidence of a match
SAMPLE = 500  # photos of an index that are asked, spread over it
FEWEST = 20  # fewer distances than this are no sample


@dataclass(frozen=True)
class Apart:
    """When two photos of an index are certainly of different places."""

    metres: float = 100.0
    """Farther apart than this, where positions are known."""
    frames: int | None = None
    """Where no position is known: more than so many photos between them in the order of one folder; None: unknown."""


@dataclass(frozen=True)
class Calibration:
    """Distances from photos of an index to the nearest photo of another place, ascending; empty where none is known."""

    elsewhere: np.ndarray
    how: str
    """How they were measured, or why they were not, for people."""

    @property
    def threshold(self) -> float | None:
        """Distance from which on a photo is probably not on the map; None without a calibration."""
        if len(self.elsewhere) == 0:
            return None
        return float(self.elsewhere[int((1 - LEAST) * len(self.elsewhere) + 1e-9)])

    def confidence(self, distance: float) -> float | None:
        """Share 0 ... 1 of the distances that are larger; None without a calibration."""
        if len(self.elsewhere) == 0:
            return None
        return float((self.elsewhere > distance).mean())

    def matched(self, distance: float) -> bool | None:
        """Whether a nearest photo at this distance is probably of the same place; None without a calibration."""
        return None if self.threshold is None else distance < self.threshold


def calibrate(index: Any, photos: Photos, rows: np.ndarray, descriptors: np.ndarray, apart: Apart) -> Calibration:
    """The calibration of a faiss `index` of `photos`.

    Args:
        rows: the photos that are asked, int64 [m].
        descriptors: of them, float32 [m, dim], as the index holds them.
    """
    other, how = _other_places(photos, apart)
    if other is None:
        return Calibration(np.zeros(0), how)
    distances = np.sort(nearest_elsewhere(index, rows, descriptors, other))
    if len(distances) < FEWEST:
        return Calibration(np.zeros(0), f"only {len(distances)} photos have a photo {how}, {FEWEST} are needed")
    return Calibration(distances, f"{len(distances):,} photos of the index and their nearest photo {how}")


def nearest_elsewhere(
    index: Any, rows: np.ndarray, descriptors: np.ndarray, other: Callable[[int], np.ndarray]
) -> np.ndarray:
    """L2 distance from each row to the nearest photo of another place, in the order of the rows.

    Rows whose search finds no such photo are left out. `other(row)`: bool [n], the photos of certainly another place.
    """
    total, k = int(index.ntotal), min(64, int(index.ntotal))
    found = np.full(len(rows), np.inf)
    left = np.array([at for at, row in enumerate(rows) if other(int(row)).any()], np.int64)
    while len(left):
        squared, near = search_index(index, descriptors[left], k)
        for at, far, answers in zip(left, squared, near, strict=True):
            right = (answers >= 0) & other(int(rows[at]))[answers]
            if right.any():
                found[at] = float(np.sqrt(max(0.0, float(far[right.argmax()]))))
        left = left[np.isinf(found[left])]
        if k == total:
            break
        k = min(4 * k, total)
    return found[np.isfinite(found)]


def _other_places(photos: Photos, apart: Apart) -> tuple[Callable[[int], np.ndarray] | None, str]:
    """(row -> bool [n]: certainly of another place; in words), or (None, why it cannot be known)."""
    positions = photos.positions
    if positions is not None:
        known = positions

        def by_metres(row: int) -> np.ndarray:
            if photos.coordinates == "degrees":
                there = ~np.isnan(known[:, 0])
                far = np.zeros(len(known), bool)
                if there[row]:
                    far[there] = metres_between(known[there], known[row]) > apart.metres
                return far
            return np.asarray(np.hypot(*(known - known[row]).T) > apart.metres)  # NaN is not greater

        return by_metres, f"more than {apart.metres:g} m away"
    if apart.frames is None:
        return None, "no position is known; give --apart_frames N if the photos of a folder are in the order of a drive"
    frames = apart.frames
    folders = [file.parent for file in photos.files]
    numbers = {folder: number for number, folder in enumerate(dict.fromkeys(folders))}
    folder, order = np.array([numbers[f] for f in folders]), np.arange(len(folders))

    def by_frames(row: int) -> np.ndarray:
        return np.asarray((folder == folder[row]) & (np.abs(order - row) > frames))

    return by_frames, f"more than {frames} photos away in the same folder"
