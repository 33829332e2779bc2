"""One shard: a tar file of samples, hashed as it is written, that appears under its name only when it is whole.

The bytes are those of `webdataset.TarWriter(mtime=0)` (a test compares them); it is not used itself because importing
webdataset imports torch, two seconds in every worker. Invariant: the same samples give the same bytes, by a fixed
owner, mode and time, and members in the order of their names.
"""

from __future__ import annotations

import hashlib
import os
import tarfile
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

_BLOCK = tarfile.BLOCKSIZE
_OWNER = "bigdata"  # webdataset's


class Member(NamedTuple):
    """Where a member's bytes lie in the tar file."""

    offset: int
    size: int


class ShardFile:
    """Writes `temporary`; `finish` syncs it and renames it to its place. Left without `finish`, it removes itself."""

    def __init__(self, temporary: Path) -> None:
        self.temporary = temporary
        self.size = 0
        self.samples = 0
        self._hash = hashlib.sha256()
        self._stream = temporary.open("wb", buffering=1 << 20)

    def __enter__(self) -> ShardFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._stream.close()
        self.temporary.unlink(missing_ok=True)

    @property
    def sha256(self) -> str:
        """Hex digest of what is written so far."""
        return self._hash.hexdigest()

    def add(self, key: str, members: Mapping[str, bytes]) -> dict[str, Member]:
        """Appends a sample: `{"0.jpg": ...}` becomes the member `<key>.0.jpg`."""
        places = {}
        for name in sorted(members):
            data = members[name]
            self._write(_header(f"{key}.{name}", len(data)))
            places[name] = Member(self.size, len(data))
            self._write(data)
            self._write(bytes(-len(data) % _BLOCK))
        self.samples += 1
        return places

    def finish(self, final: Path) -> None:
        """Ends the tar file, syncs it to the disk and renames it."""
        self._write(bytes(2 * _BLOCK))
        self._write(bytes(-self.size % tarfile.RECORDSIZE))
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._stream.close()
        self.temporary.rename(final)

    def _write(self, data: bytes) -> None:
        self._stream.write(data)
        self._hash.update(data)
        self.size += len(data)


def _header(name: str, size: int) -> bytes:
    member = tarfile.TarInfo(name)
    member.size, member.mtime, member.mode, member.uname, member.gname = size, 0, 0o444, _OWNER, _OWNER
    return member.tobuf(tarfile.USTAR_FORMAT)
