"""The files of a source folder, without the debris that systems leave, and what could not be looked at.

Invariant: a folder or file that cannot be read is told, never passed over; links are followed, each folder once.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from pipeline.common.errors import DataError
from pipeline.common.text import shown

MISSING, UNREADABLE = -1, -2  # in place of a file's size
_DEBRIS = ("thumbs.db", "desktop.ini", "__macosx", "@eadir", "$recycle.bin", "system volume information")


def is_debris(name: str) -> bool:
    """Hidden files, those of macOS (`._x`, `.DS_Store`, `__MACOSX`) and the like: not the user's own."""
    return name.startswith(".") or name.lower() in _DEBRIS


def names_in(folder: Path) -> list[str]:
    """Sorted names in a folder, without debris.

    Raises:
        DataError: it cannot be read.
    """
    try:
        return sorted(path.name for path in folder.iterdir() if not is_debris(path.name))
    except OSError as error:
        raise DataError(f"{shown(folder)}: cannot be read ({error.strerror})") from None


def walk(root: Path, told: Callable[[OSError], object]) -> Iterator[tuple[str, list[str]]]:
    """(folder, sorted names of the files in it without debris) of `root` and all below, in sorted order.

    Linked folders are followed, each folder once; `told` is called with the error of each that cannot be read.
    """
    visited: set[tuple[int, int]] = set()
    for folder, below, names in os.walk(root, followlinks=True, onerror=told):
        at = os.stat(folder)  # noqa: PTH116
        if (at.st_dev, at.st_ino) in visited:  # a link back up, or a second way to the same photos
            below.clear()
            continue
        visited.add((at.st_dev, at.st_ino))
        below[:] = sorted(name for name in below if not is_debris(name))
        yield folder, sorted(name for name in names if not is_debris(name))


def files_below(
    root: Path, endings: Sequence[str], refused: Callable[[str, str], None] = lambda folder, why: None
) -> Iterator[tuple[str, int]]:
    """(path from the root with /, bytes or MISSING or UNREADABLE) of the files below with one of the endings.

    Folder by folder in sorted order; `refused` is called with (folder from the root, reason) for each that cannot be
    read.
    """

    def told(error: OSError) -> None:
        where = Path(os.fsdecode(error.filename))
        refused(where.relative_to(root).as_posix(), error.strerror or type(error).__name__)

    for folder, names in walk(root, told):
        inside = Path(folder).relative_to(root).as_posix()
        for name in names:
            if name.lower().endswith(tuple(endings)):
                yield (name if inside == "." else f"{inside}/{name}"), size_of(os.path.join(folder, name))  # noqa: PTH118


def size_of(path: str) -> int:
    """Bytes of a file; MISSING where a link leads nowhere, UNREADABLE where it may not be looked at."""
    try:
        return os.stat(path).st_size  # noqa: PTH116
    except OSError as error:
        return MISSING if error.errno in (errno.ENOENT, errno.ENOTDIR) else UNREADABLE
