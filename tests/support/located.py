"""Photos with GPS positions in their EXIF."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from PIL import Image
from tiny import photo


def write(path: Path, tags: dict[int, Any] | None, place: int = 0) -> Path:
    """A JPEG or PNG of a place with the given GPS tags (1 to 4: reference and value of latitude, of longitude)."""
    exif = Image.Exif()
    exif[0x010F] = "a camera"
    if tags is not None:
        exif.get_ifd(0x8825).update(tags)
    path.parent.mkdir(parents=True, exist_ok=True)
    photo(place, 0).save(path, exif=exif, **({} if path.suffix == ".png" else {"quality": 95}))
    return path


def point(north: str, latitude: Any, east: str, longitude: Any) -> dict[int, Any]:
    return {1: north, 2: latitude, 3: east, 4: longitude}


def degrees(latitude: float, longitude: float) -> dict[int, Any]:
    """Tags of a point, split into degrees, minutes and seconds."""
    seconds = [round(abs(value) * 3600, 6) for value in (latitude, longitude)]
    parts = [(s // 3600, s % 3600 // 60, s % 60) for s in seconds]
    return point("S" if latitude < 0 else "N", parts[0], "W" if longitude < 0 else "E", parts[1])
