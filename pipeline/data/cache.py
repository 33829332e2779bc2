"""The shards of a set as local files: where they lie, or fetched whole from any fsspec URL into a bounded cache.

Invariant: a file under its own name in the cache is complete and has the manifest's SHA-256; the cache (files being
fetched included) never exceeds its bound; any number of ranks and workers of a host may share one. A shard is fetched
under its own file lock to `<name>.part`, checked and renamed; room is made, least recently used first, under the
cache's lock. A reader that holds an evicted shard open still reads it, and one that comes too late fetches it again.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.common.errors import DataError, UsageError
from pipeline.common.files import locked
from pipeline.common.text import shown
from shards.schema import is_shard_name

if TYPE_CHECKING:
    from shards.index import ShardIndex

BLOCK = 8 << 20  # bytes hashed and written at a time


def local_folder(root: str) -> Path | None:
    """The folder that `root` names on this machine, or None where it is a URL of another place."""
    if root.startswith("file://"):
        return Path(root.removeprefix("file://"))
    return None if "://" in root else Path(root)


class ShardCache:
    """Gives the shards of one set as local files.

    Args:
        index: the set; its manifest holds each shard's `name`, `bytes` and `sha256`.
        folder: the cache, shared by sets and processes; unused where the set is local.
        limit: its bound in bytes.
    """

    def __init__(self, index: ShardIndex, folder: Path, limit: int) -> None:
        self.root = index.root.rstrip("/")
        self.shards: dict[str, dict[str, Any]] = {shard["name"]: shard for shard in index.manifest["shards"]}
        self.local = local_folder(index.root)
        self.base, self.limit = folder, limit
        self.folder = folder / index.digest[:16]  # sets never mix, also under equal shard names
        if wrong := [name for name in self.shards if not is_shard_name(name)]:  # it becomes a path in the cache
            raise DataError(f"{self.root}: the manifest names a shard '{shown(wrong[0])}', not a plain file name")
        self.attempts = 3  # to fetch a shard
        self.wanted: frozenset[str] = frozenset()  # evicted only when nothing else is left

    @property
    def remote(self) -> bool:
        """Whether shards must be fetched."""
        return self.local is None

    def path(self, name: str) -> str:
        """Where a shard lies, for a person."""
        return f"{self.root}/{name}"

    def size(self, name: str) -> int:
        """Bytes of a shard by the manifest."""
        if name not in self.shards:
            raise DataError(f"{self.root}: the index names shard {name}, which the manifest does not; prepare it again")
        return int(self.shards[name]["bytes"])

    def open(self, name: str) -> int:
        """A file descriptor of a complete shard, fetched first where needed. Raises `DataError` naming the shard."""
        size = self.size(name)
        while True:
            path = self.local / name if self.local is not None else self.fetch(name)
            try:
                descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # a pipe would be waited for
            except FileNotFoundError:
                if self.remote:  # evicted between the two lines above
                    continue
                raise DataError(f"{path}: missing; restore it or prepare the shards again") from None
            except OSError as error:
                raise DataError(f"{path}: cannot be opened ({error.strerror})") from None
            found = os.fstat(descriptor).st_size
            if found != size:
                os.close(descriptor)
                raise DataError(f"{path}: {found} bytes, but the manifest says {size}; prepare the shards again")
            return descriptor

    def fetch(self, name: str) -> Path:
        """The shard's path in the cache, after fetching it where it is not there; marks it as just used."""
        path, size = self.folder / name, self.size(name)
        if size > self.limit:
            raise UsageError(f"data.cache_gb holds {self.limit:,} bytes, but {name} has {size:,}: raise it")
        if _touch(path):
            return path
        path.parent.mkdir(parents=True, exist_ok=True)
        with locked(_lock_of(path)):
            if _touch(path):  # another process was faster
                return path
            part = path.with_name(name + ".part")
            part.unlink(missing_ok=True)  # of a killed process: it must not take the room that is wanted for itself
            self._reserve(part, size)
            try:
                self._copy(name, part)
                part.rename(path)
            except BaseException:
                part.unlink(missing_ok=True)
                raise
        return path

    def _copy(self, name: str, part: Path) -> None:
        """Remote shard -> `part`, checked against the manifest; a failing connection is tried again."""
        from fsspec.core import url_to_fs

        url, problem = f"{self.root}/{name}", ""
        for attempt in range(self.attempts):
            time.sleep(attempt)
            try:
                system, remote = url_to_fs(url)
                digest = hashlib.sha256()
                with system.open(remote, "rb", block_size=4 * BLOCK) as source, part.open("r+b") as target:
                    while block := source.read(BLOCK):
                        digest.update(block)
                        if target.write(block) and target.tell() > self.size(name):
                            break  # longer than its manifest says: wrong, and not to exceed the room reserved
                    target.truncate()
                if digest.hexdigest() == self.shards[name]["sha256"]:
                    return
                problem = "its SHA-256 is not the manifest's"
            except FileNotFoundError:
                raise DataError(f"{url}: missing; restore it or prepare the shards again") from None
            except Exception as error:  # each file system has errors of its own, told below after the last attempt
                problem = f"{type(error).__name__}: {error}".splitlines()[0]
        raise DataError(f"{url}: cannot be fetched after {self.attempts} attempts ({problem})")

    def _reserve(self, part: Path, size: int) -> None:
        """Makes room for `size` bytes and takes it with a sparse `part` of that size."""
        while True:
            with locked(self.base / ".lock"):
                used = self._drop_stale_parts()
                if self._evict(used, size):
                    with part.open("wb") as file:
                        file.truncate(size)
                    return
            time.sleep(0.1)  # the rest is being fetched by others: it becomes evictable when they are done

    def _evict(self, used: int, size: int) -> bool:
        """Removes the least recently used shards until `size` fits beside the `used` bytes of parts."""
        ages: list[tuple[bool, int, int, Path]] = []
        for path in self.base.glob("*/*"):
            if path.suffix in (".part", ".lock"):
                continue
            with suppress(FileNotFoundError):
                status = path.stat()
                used += status.st_size
                keep = path.parent == self.folder and path.name in self.wanted
                ages.append((keep, status.st_mtime_ns, status.st_size, path))
        for _, _, freed, path in sorted(ages):
            if used + size <= self.limit:
                break
            path.unlink(missing_ok=True)
            used -= freed
        return used + size <= self.limit

    def _drop_stale_parts(self) -> int:
        """Removes what killed processes left; returns the bytes of the parts that are being fetched."""
        used = 0
        for part in self.base.glob("*/*.part"):
            with suppress(FileNotFoundError), _lock_of(part.with_suffix("")).open("a") as lock:
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    used += part.stat().st_size
                else:
                    part.unlink(missing_ok=True)
        return used


def _lock_of(path: Path) -> Path:
    return path.with_name(path.name + ".lock")


def _touch(path: Path) -> bool:
    """Marks a complete shard as just used; False where there is none."""
    try:
        os.utime(path)
    except FileNotFoundError:
        return False
    return True
