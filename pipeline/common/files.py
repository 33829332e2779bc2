"""Writing so that a kill or a power failure leaves a file whole or absent."""

from __future__ import annotations

import os
from pathlib import Path


def write_atomically(path: Path, data: bytes, temporary: Path | None = None) -> None:
    """Writes a small file so that it is either whole under its name or not there at all, even if the power fails."""
    temporary = temporary or path.with_name(path.name + ".tmp")
    with temporary.open("wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())
    temporary.rename(path)
    sync_path(path.parent)


def reserve(path: Path, size: int) -> None:
    """Makes a file of `size` zero bytes that the disk really has: writing into a mapped hole of a full disk kills."""
    with path.open("wb") as file:
        if hasattr(os, "posix_fallocate"):
            try:
                os.posix_fallocate(file.fileno(), 0, size)
            except OSError as error:
                raise OSError(error.errno, error.strerror, str(path)) from None
        else:
            file.truncate(size)


def usual_permissions(path: Path) -> None:
    """Those of a file that is simply opened: safetensors writes for the owner alone, and colleagues read these."""
    mask = os.umask(0)
    os.umask(mask)
    path.chmod(0o666 & ~mask)


def sync_path(path: Path) -> None:
    """Forces a file's bytes, or a folder's names, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
