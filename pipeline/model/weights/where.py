"""Where a model or released weights lie, told by paths alone.

Invariant: nothing here imports torch or opens a model, so that a job can say at once that a file is missing.
"""

from __future__ import annotations

import re
from pathlib import Path

from pipeline.common.errors import UsageError
from pipeline.common.text import shown

FILE = "model.safetensors"
HUB = "hub:"
HUB_NAME = re.compile(r"[\w-][\w.-]*/[\w-][\w.-]*")


def checkpoint_file(path: str | Path) -> Path:
    """The model file behind a path: itself, a checkpoint folder's, or a run folder's best, else last checkpoint's.

    Raises:
        UsageError: there is none.
    """
    given = Path(path)
    if given.is_file():
        return given
    places = [given / "checkpoints" / "best", given / "best", given / "checkpoints" / "last", given / "last"]
    for folder in (given, *places):
        if folder.is_file():  # a pointer in a text file instead of a link
            folder = folder.parent / folder.read_text().strip()
        if (folder / FILE).is_file():
            return folder / FILE
    raise UsageError(f"{given}: no model there (a .safetensors file, a checkpoint folder, or a run folder is needed)")


def no_such_weights(source: str) -> str:
    """What is said of a path where nothing lies."""
    as_name = HUB_NAME.fullmatch(source) is not None and not Path(source).suffix
    hint = f"; if a model of the model hub is meant, write {HUB}{source}" if as_name else ""
    return f"{shown(source)}: there is no such weights file or folder{hint}"


def check_weights(source: str) -> None:
    """Raises `UsageError` where nothing lies under a path; names on the model hub are not asked."""
    if not source.startswith(HUB) and not Path(source).expanduser().exists():
        raise UsageError(no_such_weights(source))
