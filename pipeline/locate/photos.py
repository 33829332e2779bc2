"""A user's own photos: folders and manifests -> files in a fixed order, with what is known of where they were taken.

Invariant: a photo is its absolute path (symbolic links are not followed), its size and its time of change; named twice,
it counts once. Sources keep the order in which they are given, photos of a folder are sorted, rows of a manifest keep
theirs. A photo has a position or none, whatever the others have; all positions are brought to one kind: metres in one
UTM zone, or degrees where they lie too far apart for one.
"""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.common.errors import DataError, UsageError
from pipeline.common.text import shown
from pipeline.evaluation.sets.evaluation_set import list_images
from pipeline.evaluation.sets.manifest import SUFFIXES, read_photos
from pipeline.evaluation.sets.utm import (
    WIDEST,
    degrees_for_metres,
    file_position,
    file_positions,
    file_zone,
    from_utm,
    meridian_offset,
    to_utm,
    utm_zone,
)  # fmt: skip
from pipeline.locate.gps import gps_position, gps_positions

ZONE = re.compile(r"([1-9]|[1-5]\d|60)[NS]")


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
    """Latitude and longitude [n, 2] beside UTM `positions`; None where their zone is not known."""
    zone: str = ""
    """Zone and hemisphere of UTM positions, "31N"; empty where it is not known."""
    remarks: tuple[str, ...] = ()
    """Lines that a person should read."""


@dataclass(frozen=True)
class Taken:
    """Where one photo says that it was taken: in its name, or else in its EXIF GPS."""

    degrees: tuple[float, float] | None = None
    """Latitude and longitude."""
    metres: tuple[float, float] | None = None
    """UTM east and north of its name."""
    zone: str = ""
    """Of `metres`; empty where it is not known."""
    problem: str = ""
    """What is wrong with its GPS, where something is."""


def find_photos(sources: Sequence[Path], progress: bool = True, zone: str = "") -> Photos:
    """The photos below folders, or of manifests (.csv, .parquet).

    A photo of a folder has the UTM position of its name (`@UTM_east@UTM_north@zone@band@...`), or else that of its EXIF
    GPS, or none. A manifest has the column `image`, and `lat` and `lon`, or `utm_east` and `utm_north`, or no position;
    where it has `role`, its database rows count. All go into one UTM zone: that of the names where they tell one, else
    that of the middle photo; where they lie too far apart for one, all are degrees, and a remark says so.

    Args:
        zone: "31N", the zone of metres that do not tell theirs.

    Raises:
        DataError: nothing there, or positions that are none.
        UsageError: metres of an unknown zone beside other positions.
    """
    found = [_of_source(source, progress, zone) for source in sources]
    files = [_absolute(photo) for source in found for photo in source.files]
    remarks = tuple(remark for source in found for remark in source.remarks)
    first_seen = {file: at for at, file in reversed(list(enumerate(files)))}
    rows = np.array(sorted(first_seen.values()), np.int64)
    if len(rows) < len(files):
        remarks += (f"{len(files) - len(rows):,} photos are named twice and count once",)
    metres = np.concatenate([source.metres for source in found])[rows]
    degrees = np.concatenate([source.degrees for source in found])[rows]
    zones = np.array([zone for source in found for zone in source.zones])[rows]
    files = [files[row] for row in rows]
    folders = [_absolute(s.parent if s.suffix.lower() in SUFFIXES else s) for s in sources]
    bare = Photos(files, _states(files), Path(os.path.commonpath(folders)), remarks=remarks)
    in_metres, in_degrees = ~np.isnan(metres[:, 0]), ~np.isnan(degrees[:, 0])
    zoneless = in_metres & (zones == "")
    if not (in_metres | in_degrees).any():
        return bare
    if zoneless.any():
        others = (in_metres & ~zoneless) | in_degrees
        if others.any():
            one, other = files[int(zoneless.argmax())], files[int(others.argmax())]
            raise UsageError(
                f"{shown(one)} has a position in metres of an unknown UTM zone, and {shown(other)} one whose place on "
                "Earth is known; give the zone of the metres, for example --zone 31N, or build an index of each"
            )
        return _counted(dataclasses.replace(bare, coordinates="utm", positions=metres))
    told = sorted({str(zone) for zone in zones[in_metres]})
    for name in told:
        own = in_metres & (zones == name)
        degrees[own] = from_utm(metres[own], *_split(name))
    return _in_zone(_counted(dataclasses.replace(bare, degrees=degrees)), metres, zones, told)


def taken(name: str, source: Path | bytes, zone: str = "") -> Taken:
    """Where a single photo says that it was taken. `zone`: of metres in its `name` that do not tell theirs."""
    try:
        metres = file_position(Path(name))
    except DataError:
        metres = None
    if metres is None:
        degrees, problem = gps_position(source)
        return Taken(degrees, problem=problem)
    zone = file_zone(Path(name)) or zone
    if not zone:
        return Taken(metres=metres)
    latitude, longitude = from_utm(np.array([metres]), *_split(zone))[0].tolist()
    return Taken(None if np.isnan(latitude) else (latitude, longitude), metres, zone)


def check_zone(zone: str) -> None:
    """Raises `UsageError` where a zone is neither empty nor like "31N"."""
    if zone and not ZONE.fullmatch(zone):
        raise UsageError(f"--zone is '{shown(zone)}'; it must be a UTM zone and N or S, such as 31N or 56S")


@dataclass(frozen=True)
class _Source:
    """Photos of one source: `metres` and `degrees` [n, 2] with NaN rows, and the zone of each one's metres or ""."""

    files: list[Path]
    metres: np.ndarray
    degrees: np.ndarray
    zones: list[str]
    remarks: tuple[str, ...] = ()


def _split(zone: str) -> tuple[int, bool]:
    """(Number, southern hemisphere) of "31N"."""
    return int(zone[:-1]), zone.endswith("S")


def _counted(photos: Photos) -> Photos:
    """The photos with a remark on how many have no position."""
    known = photos.degrees if photos.degrees is not None else photos.positions
    assert known is not None
    there = int((~np.isnan(known[:, 0])).sum())
    if there == len(known):
        return photos
    return dataclasses.replace(photos, remarks=(*photos.remarks, f"{there:,} of {len(known):,} photos have a position"))


def _in_zone(photos: Photos, metres: np.ndarray, zones: np.ndarray, told: Sequence[str]) -> Photos:
    """Photos that have `degrees` alone, with positions in one UTM zone where one holds them all.

    The zone is the one that names tell, or that of the middle photo. Metres [n, 2] that are of it stay as they are.
    """
    assert photos.degrees is not None
    there = ~np.isnan(photos.degrees[:, 0])
    latitude, longitude = photos.degrees[there].T
    if len(told) == 1:
        zone, south = _split(told[0])
    else:
        zone, south = utm_zone(float(np.median(latitude)), float(np.median(longitude))), bool(np.median(latitude) < 0)
    if np.abs(meridian_offset(longitude, zone)).max(initial=0) > WIDEST:
        remarks = (*photos.remarks, "they lie too far apart for one UTM zone: positions are latitude and longitude")
        return dataclasses.replace(
            photos, coordinates="degrees", positions=photos.degrees, degrees=None, remarks=remarks
        )
    positions = np.full_like(photos.degrees, np.nan)
    positions[there] = to_utm(latitude, longitude, zone, south)
    name = f"{zone}{'S' if south else 'N'}"
    positions[zones == name] = metres[zones == name]
    return dataclasses.replace(photos, coordinates="utm", positions=positions, zone=name)


def _of_source(source: Path, progress: bool, zone: str) -> _Source:
    """What one source holds."""
    if source.suffix.lower() in SUFFIXES:
        photos, positions, kind = read_photos(source)
        nothing = np.full((len(photos), 2), np.nan)
        metres, degrees = (positions if positions is not None and kind == k else nothing for k in ("utm", "degrees"))
        outside = (np.abs(degrees) > [90, 360]).any(axis=1)
        if outside.any():
            at = int(outside.argmax())
            told = f"latitude {degrees[at, 0]:g}, longitude {degrees[at, 1]:g}"
            raise DataError(f"{source}: {shown(photos[at])}: {told} is no place on Earth, in degrees")
        zones = [zone if not np.isnan(row[0]) else "" for row in metres]
        return _Source(photos, metres, degrees, zones)
    if not source.is_dir():
        raise DataError(f"{source}: no such folder of photos, and no .csv or .parquet manifest")
    photos = list_images(source)
    metres, degrees = np.full((len(photos), 2), np.nan), np.full((len(photos), 2), np.nan)
    named = [at for at, photo in enumerate(photos) if file_position(photo) is not None]
    others = [at for at, photo in enumerate(photos) if file_position(photo) is None]
    remarks: tuple[str, ...] = ()
    in_names = file_positions(photos[at] for at in named)
    if in_names is not None:
        metres[named] = in_names
        if degrees_for_metres(in_names, written=True) == "maybe":
            remarks += ("positions in the names are small enough to be degrees; they are taken as metres",)
    if others:
        in_exif, remark = gps_positions([photos[at] for at in others], progress)
        if in_exif is not None:
            degrees[others] = in_exif
        remarks += (remark,) if remark else ()
    zones = ["" if np.isnan(row[0]) else file_zone(photo) or zone for photo, row in zip(photos, metres, strict=True)]
    return _Source(photos, metres, degrees, zones, remarks)


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
