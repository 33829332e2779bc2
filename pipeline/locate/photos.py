"""A user's own photos: folders and manifests -> files in a fixed order, with what is known of where they were taken.

Invariant: a photo is its absolute path (symbolic links are not followed), its size and its time of change; named twice,
it counts once. Sources keep the order in which they are given, photos of a folder are sorted, rows of a manifest keep
theirs. Positions are of one kind in all of them: metres in one UTM zone, or degrees.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.common.errors import DataError, UsageError
from pipeline.evaluation.sets.evaluation_set import list_images
from pipeline.evaluation.sets.manifest import SUFFIXES, read_photos
from pipeline.evaluation.sets.utm import (
    WIDEST,
    file_positions,
    file_zone,
    meridian_offset,
    position_remarks,
    to_utm,
    utm_zone,
)  # fmt: skip
from pipeline.locate.gps import gps_positions


@dataclass(frozen=True)
class Photos:
    """n photos and their positions."""

    files: list[Path]
    """Absolute paths."""
    states: np.ndarray
    """int64 [n, 2]: bytes, and time of change in nanoseconds."""
    root: Path
    """The folder that all sources lie below."""
    coordinates: str = "none"
    """utm (east, north in metres), degrees (latitude, longitude), or none."""
    positions: np.ndarray | None = None
    """float64 [n, 2] in `coordinates`, NaN rows where a photo has none; None where none has."""
    degrees: np.ndarray | None = None
    """Latitude and longitude [n, 2] that UTM `positions` were made of; None where they were metres to begin with."""
    zone: str = ""
    """Zone and hemisphere of UTM positions, "31N"; empty where it is not known."""
    remarks: tuple[str, ...] = ()
    """Lines that a person should read."""


def find_photos(sources: Sequence[Path], progress: bool = True) -> Photos:
    """The photos below folders, or of manifests (.csv, .parquet).

    A folder has UTM positions where its names carry them (`@UTM_east@UTM_north@...`), in all or in none; otherwise
    each photo has that of its EXIF GPS, or none. A manifest has the column `image`, and `lat` and `lon`, or `utm_east`
    and `utm_north`, or no position; where it has `role`, its database rows count. GPS positions go into one UTM zone,
    that of the middle one; where they lie too far apart for one, they stay degrees, and a remark says so.

    Raises:
        DataError: nothing there, or positions that are none.
        UsageError: metres from some sources and degrees from others.
    """
    files: list[Path] = []
    kinds: list[str] = []
    found: list[np.ndarray] = []
    remarks: list[str] = []
    for source in sources:
        photos, positions, kind, remark = _of_source(source, progress)
        files += [_absolute(photo) for photo in photos]
        found.append(np.full((len(photos), 2), np.nan) if positions is None else positions)
        kinds.append(kind)
        remarks += [remark] if remark else []
    first_seen = {file: at for at, file in reversed(list(enumerate(files)))}
    rows = np.array(sorted(first_seen.values()), np.int64)
    if len(rows) < len(files):
        remarks.append(f"{len(files) - len(rows):,} photos are named twice and count once")
    positions, files = np.concatenate(found)[rows], [files[row] for row in rows]
    folders = [_absolute(s.parent if s.suffix.lower() in SUFFIXES else s) for s in sources]
    bare = Photos(files, _states(files), Path(os.path.commonpath(folders)), remarks=tuple(remarks))
    known = {kind for kind in kinds if kind != "none"}
    if not known:
        return bare
    if "utm" in known and len(known) > 1:
        names = {("metres" if kind == "utm" else "degrees"): str(s) for s, kind in zip(sources, kinds, strict=True)}
        raise UsageError(
            f"{names['metres']} has positions in UTM metres and {names['degrees']} in degrees; build an index of each"
        )
    if "utm" in known:
        zones = {file_zone(file) for file in files}
        zone = zones.pop() if len(zones) == 1 else ""
        return dataclasses.replace(bare, coordinates="utm", positions=positions, zone=zone)
    if known == {"gps"}:
        return _in_zone(dataclasses.replace(bare, degrees=positions))
    return dataclasses.replace(bare, coordinates="degrees", positions=positions)


def _in_zone(photos: Photos) -> Photos:
    """Photos that have `degrees` alone, with positions in the UTM zone of the middle one, where one holds them all."""
    assert photos.degrees is not None
    there = ~np.isnan(photos.degrees[:, 0])
    latitude, longitude = photos.degrees[there].T
    zone, south = utm_zone(float(np.median(latitude)), float(np.median(longitude))), bool(np.median(latitude) < 0)
    remarks = (*photos.remarks, f"{there.sum():,} of {len(there):,} photos have a GPS position")
    if np.abs(meridian_offset(longitude, zone)).max() > WIDEST:
        remarks += ("they lie too far apart for one UTM zone: positions are latitude and longitude",)
        return dataclasses.replace(
            photos, coordinates="degrees", positions=photos.degrees, degrees=None, remarks=remarks
        )
    metres = np.full_like(photos.degrees, np.nan)
    metres[there] = to_utm(latitude, longitude, zone, south)
    name = f"{zone}{'S' if south else 'N'}"
    return dataclasses.replace(photos, coordinates="utm", positions=metres, zone=name, remarks=remarks)


def _of_source(source: Path, progress: bool) -> tuple[list[Path], np.ndarray | None, str, str]:
    """(Photos, positions, kind: utm, degrees, gps or none, remark) of one source."""
    if source.suffix.lower() in SUFFIXES:
        return *read_photos(source), ""
    if not source.is_dir():
        raise DataError(f"{source}: no such folder of photos, and no .csv or .parquet manifest")
    photos = list_images(source)
    positions = file_positions(photos)
    if positions is not None:
        return photos, positions, "utm", "; ".join(position_remarks(photos, positions))
    positions, remark = gps_positions(photos, progress)
    return photos, positions, "none" if positions is None else "gps", remark


def _absolute(path: Path) -> Path:
    """Without `..`, and with symbolic links as they are: a photo is known by the name that its owner gave it."""
    return Path(os.path.abspath(path))  # noqa: PTH100


def _states(files: Sequence[Path]) -> np.ndarray:
    states = np.empty((len(files), 2), np.int64)
    for at, file in enumerate(files):
        try:
            state = file.stat()
        except OSError as error:
            raise DataError(f"{file}: cannot be read ({error.strerror or error})") from None
        states[at] = state.st_size, state.st_mtime_ns
    return states
