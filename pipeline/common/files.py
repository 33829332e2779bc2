"""Writing so that a kill or a power failure leaves a file whole or absent."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, BinaryIO

from pipeline.common.errors import UsageError, UserError, told
from pipeline.common.text import shown

_NO_LOCKS = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK)


@contextmanager
def locked(path: Path, refusal: str = "", patience: float = 0.0) -> Iterator[None]:
    """Holds a file's lock; the system drops it when its holder dies, however it dies.

    Args:
        path: the file, made where it is missing and left behind (removing it would let two holders in).
        refusal: what to tell where another process holds the lock; "": wait for it.
        patience: seconds to wait before refusing, for a holder that is just ending.

    Raises:
        UsageError: another process holds it. A file system without locks does not refuse.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    deadline = time.monotonic() + patience
    with path.open("a") as file:
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | (fcntl.LOCK_NB if refusal else 0))
            except BlockingIOError:
                if time.monotonic() >= deadline:
                    raise UsageError(refusal) from None
                time.sleep(0.2)
                continue
            except OSError as error:
                if not refusal or error.errno not in _NO_LOCKS:
                    raise
            break
        yield


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Errors of writing inside are `OSError` and name the file: the system's (a full disk is told when bytes are
    written, and then names none), and those that libraries made of it."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)
        raise
    except Exception as error:
        if isinstance(error, UserError) or (mended := told(error)) is None:
            raise
        raise OSError(errno.EIO, str(mended), str(path)) from error


def write_atomically(path: Path, data: bytes | str, temporary: Path | None = None) -> None:
    """Writes a small file so that it is either whole under its name or not there at all, even if the power fails. Its
    folder is made where it is missing; text is written as UTF-8."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = data.encode(errors="surrogateescape") if isinstance(data, str) else data
    temporary = temporary or path.with_name(path.name + ".tmp")
    try:
        with naming(path), temporary.open("wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.rename(path)
    except OSError:
        temporary.unlink(missing_ok=True)  # a full disk needs the room
        raise
    sync_path(path.parent)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Gives a name beside `path` to write a file under, which then takes the place of `path` in one step.

    Its folder is made where it is missing. Where writing fails nothing is left behind, and `path` stays as it was.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    try:
        with naming(path):
            yield partial
        usual_permissions(partial)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def sha256_of(path: Path) -> str:
    """Hex digest of a file's bytes."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def check_writable(folder: Path, option: str) -> None:
    """Makes `folder` where it is not there and writes a file into it, before any work is done for it.

    Raises:
        UsageError: it cannot be made or written; names the folder, the reason, and the `option` that gives another.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"x")
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise UsageError(f"{shown(folder)}: cannot be written ({reason}); give another folder with {option}") from None


def reserve(path: Path, size: int) -> None:
    """Makes a file of `size` zero bytes that the disk really has: writing into a mapped hole of a full disk kills."""
    with path.open("wb") as file:
        _take_room(file, size, path)


def unnamed_file(size: int, folder: Path | None = None) -> IO[bytes]:
    """As `reserve`, a file without a name: its room is free again when its last user ends, however that ends. A mapping
    of it is a user. `folder`: on whose disk; None: the system's for temporary files."""
    file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  the caller closes it
    try:
        _take_room(file, size, folder or Path(tempfile.gettempdir()))
    except BaseException:
        file.close()
        raise
    return file


def _take_room(file: IO[bytes], size: int, path: Path) -> None:
    with naming(path):
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, size)
        else:
            file.truncate(size)


def open_ordinary(path: Path) -> BinaryIO:
    """Opens a file from outside for reading.

    Raises:
        OSError: it cannot be opened, or is a pipe, a device or a folder: reading a pipe never ends.
    """

    def opened(name: str, flags: int) -> int:
        return os.open(name, flags | os.O_NONBLOCK)

    # the caller closes it; Path.open has no opener
    stream = open(path, "rb", opener=opened)  # noqa: SIM115
    if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
        stream.close()
        raise OSError(errno.EINVAL, "not an ordinary file", str(path))
    return stream


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
