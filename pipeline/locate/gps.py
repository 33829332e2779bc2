"""Where a photo says that it was taken: latitude and longitude from its EXIF (Exif 2.32, 4.6.6, GPS tags 1 to 4).

Invariant: a position is either plausible or it is none, with the reason; nothing here ever refuses a photo. Values
without a hemisphere, 0/0 fractions, NaN and the point (0, 0), which cameras write before they have a fix, are none.
"""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.common.pictures import FORMATS
from pipeline.common.progress import Progress

GPS = 0x8825  # the tag of the folder of GPS tags
AXES = (("GPSLatitude", 2, 1, "NS", 90.0), ("GPSLongitude", 4, 3, "EW", 180.0))
NAMED = 5  # photos named in a line about broken positions


def gps_position(source: Path | bytes) -> tuple[tuple[float, float] | None, str]:
    """((latitude, longitude) in degrees, "") of a photo; (None, "") without GPS; (None, reason) where it is broken."""
    from PIL import Image

    if isinstance(source, Path) and not source.is_file():
        return None, ""  # a pipe would be waited for; what is not there is named where its pixels are read
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # other damaged EXIF
        try:
            image = Image.open(source if isinstance(source, Path) else io.BytesIO(source), formats=FORMATS)
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
            return None, ""  # what does not open is named where its pixels are read
        with image:
            if image.format == "PNG" and "exif" not in image.info:
                return None, ""  # Pillow would decode all of it to look behind the pixels
            try:
                tags = dict(image.getexif().get_ifd(GPS))
            except Exception as error:  # damaged EXIF makes Pillow raise anything, struct.error for one
                return None, f"unreadable EXIF ({error})"
    if not any(value in tags for _, value, *_ in AXES):
        return None, ""
    found = []
    for name, value, reference, letters, limit in AXES:
        degrees, problem = _degrees(tags.get(value), tags.get(reference), letters)
        if not problem and abs(degrees) > limit:
            problem = f"{degrees:g} is out of range"
        if problem:
            return None, f"{name} {problem}"
        found.append(degrees)
    if found == [0.0, 0.0]:
        return None, "(0, 0), which cameras write without a fix"
    return (found[0], found[1]), ""


def gps_positions(paths: Sequence[Path], progress: bool = True) -> tuple[np.ndarray | None, str]:
    """Latitude and longitude of photos, float64 [n, 2] with NaN rows where there is none; None where none has any.

    Also one line that names the photos whose position is broken; "" where there is none such.
    """
    degrees = np.full((len(paths), 2), np.nan)
    broken = []
    with Progress("reading positions", len(paths), "photos", enabled=progress) as bar:
        for at, path in enumerate(paths):
            position, problem = gps_position(path)
            if position is not None:
                degrees[at] = position
            elif problem:
                broken.append(f"{path}: {problem}")
            bar.advance()
    line = ""
    if broken:
        more = f" and {len(broken) - NAMED:,} more" if len(broken) > NAMED else ""
        line = f"broken GPS, taken for none, in {len(broken):,}: {'; '.join(broken[:NAMED])}{more}"
    return (None if np.isnan(degrees).all() else degrees), line


def _degrees(value: Any, reference: Any, letters: str) -> tuple[float, str]:
    """(degrees, positive to the first of `letters`; what is wrong with them or "")."""
    try:
        parts = [float(part) for part in (value if isinstance(value, tuple | list) else (value,))]
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0, f"is {value!r}, no number"
    if not 1 <= len(parts) <= 3 or not all(map(math.isfinite, parts)):
        return 0.0, f"is {', '.join(f'{p:g}' for p in parts)}, no degrees, minutes and seconds"
    if any(part < 0 for part in parts) or any(part > 60 for part in parts[1:]):
        return 0.0, f"is {', '.join(f'{p:g}' for p in parts)}, out of range"
    text = reference.decode("ascii", "replace") if isinstance(reference, bytes) else str(reference or "")
    letter = text.strip("\0 ").upper()
    if len(letter) != 1 or letter not in letters:
        return 0.0, f"has the reference {text!r}, neither {' nor '.join(letters)}"
    degrees = sum(part / 60**power for power, part in enumerate(parts))
    return (degrees if letter == letters[0] else -degrees), ""
