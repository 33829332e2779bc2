"""Photos that cannot be read: all of a set are named in one run, not one in each.

Invariant: nothing is described once a photo is known to be broken; the others are only looked through.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline.common.errors import DataError, told
from pipeline.common.text import shown
from pipeline.data.images import ADVICE, load_image

NAMED = 10  # photos named in the line


def problem_of(photo: Path) -> str:
    """Why a photo cannot be read, in one line that names it; empty where it can. An error of the program is raised."""
    try:
        load_image(photo)
    except Exception as error:
        mended = told(error, shown(photo))
        if mended is None:
            raise
        return str(mended)
    return ""


def broken_photos(photos: Sequence[Path], positions: Sequence[int], label: str) -> DataError:
    """The error for the photos at `positions`, found by any rank: the first ten by name and reason, and how many."""
    at = sorted(set(positions))
    lines = []
    for photo in (photos[position] for position in at[:NAMED]):
        lines.append(problem_of(photo) or f"{shown(photo)}: cannot be read on another rank; share the folder")
    if len(at) == 1:
        return DataError(lines[0])
    more = f"; and {len(at) - NAMED:,} more" if len(at) > NAMED else ""
    named = "; ".join(line.removesuffix(ADVICE) for line in lines)
    return DataError(f"{label}: {len(at):,} broken photos: {named}{more}. Restore the files or leave them out")
