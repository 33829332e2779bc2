"""Descriptors of single photos, kept as they come, so that an index that grows describes only what is new.

Invariant: a part exists whole or not at all, is never changed, and belongs to one key (weights, input, precision); a
descriptor is found only for the very photo it is of: same path, same size, same time of change. Parts of other keys,
and of photos that are gone, are removed by `tidy` alone, after the index that needs them no more is in place.

A folder of Parquet files `part-*.parquet` with the columns `photo`, `bytes`, `modified` (nanoseconds) and `descriptor`
(fixed_size_list of float).
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.common.errors import DataError
from pipeline.common.files import replacing, sync_path, unnamed_file
from pipeline.evaluation.search.exact import Blocks, slices

META = b"place_recognition_photos"
PART_BYTES = 64 * 2**20  # of descriptors in a part
PART_SECONDS = 30.0  # and the most that a killed build describes again
IN_MEMORY = 2**30  # bytes of descriptors put in order in memory; more of them in a temporary file
POOR = 4  # times as many parts, or rows, as needed: then they are written anew
Address = tuple[int, int]
"""(Number of a part, row in it)."""


class KeptDescriptors:
    """The parts of one key in a folder, which may not exist yet."""

    def __init__(self, folder: Path, key: dict[str, Any]) -> None:
        """`key`: plain values, what a descriptor depends on beside the photo."""
        self.folder, self.key = folder, json.dumps(key, sort_keys=True)

    def find(self, photos: Sequence[Path], states: np.ndarray) -> dict[int, Address]:
        """Which of the photos have a descriptor here, and where. `states` int64 [n, 2]: bytes, time in nanoseconds."""
        wanted = {str(photo): at for at, photo in enumerate(photos)}
        found: dict[int, Address] = {}
        for number, file in self._parts().items():
            if not self._belongs(file):
                continue
            columns = pq.read_table(file, columns=["photo", "bytes", "modified"])
            sizes, times = columns["bytes"].to_numpy(), columns["modified"].to_numpy()
            for row, photo in enumerate(columns["photo"].to_pylist()):
                at = wanted.get(photo, -1)
                if at >= 0 and (sizes[row], times[row]) == (states[at, 0], states[at, 1]):
                    found[at] = (number, row)
        return found

    def keep(
        self, photos: Sequence[Path], states: np.ndarray, described: Iterable[tuple[np.ndarray, np.ndarray]]
    ) -> None:
        """Writes (positions in `photos` [n], descriptors [n, dim]) as they come, in parts; what was written stays.

        Raises:
            DataError: a descriptor that is not finite, naming the photo.
        """
        waiting: list[tuple[np.ndarray, np.ndarray]] = []
        began = time.monotonic()
        try:
            for positions, descriptors in described:
                bad = ~np.isfinite(descriptors).all(axis=1)
                if bad.any():
                    photo = photos[positions[int(bad.argmax())]]
                    raise DataError(f"{photo}: its descriptor is not finite: the model has diverged; take another one")
                waiting.append((positions, descriptors))
                if sum(d.nbytes for _, d in waiting) >= PART_BYTES or time.monotonic() - began >= PART_SECONDS:
                    self._write(photos, states, waiting)
                    waiting, began = [], time.monotonic()
        finally:  # also what came before a broken photo is kept
            if waiting:
                self._write(photos, states, waiting)

    def blocks(self, addresses: Sequence[Address]) -> Blocks:
        """The descriptors at `addresses` in their order, one part in memory at a time, the whole where it is small."""
        parts, rows = np.array(addresses, np.int64).reshape(-1, 2).T
        files = self._parts()
        array: np.ndarray | None = None
        for number in np.unique(parts):
            values = _descriptors(files[int(number)])
            if array is None:
                shape = (len(parts), values.shape[1])
                if shape[0] * shape[1] * 4 <= IN_MEMORY:
                    array = np.empty(shape, np.float32)
                else:
                    with unnamed_file(shape[0] * shape[1] * 4, self.folder) as file:
                        array = np.memmap(file, np.float32, mode="r+", shape=shape)
            here = np.flatnonzero(parts == number)
            array[here] = values[rows[here]]
        assert array is not None  # an index has at least one photo
        whole = array
        return lambda: slices(whole)

    def tidy(self, photos: Sequence[Path], states: np.ndarray, found: dict[int, Address]) -> None:
        """Removes what no photo of `found` needs; writes the parts anew where they have become many or mostly stale."""
        needed = {number for number, _ in found.values()}
        for number, file in self._parts().items():
            if number not in needed:
                file.unlink()
        for stale in self.folder.glob(".*.partial"):
            stale.unlink()
        files = self._parts()
        rows = sum(pq.read_metadata(file).num_rows for file in files.values())
        least = 1 + sum(file.stat().st_size for file in files.values()) // PART_BYTES
        if rows <= POOR * len(found) and len(files) <= POOR * least + 8:
            return
        at_part: dict[int, list[tuple[int, int]]] = {}
        for at, (number, row) in found.items():
            at_part.setdefault(number, []).append((at, row))
        waiting: list[tuple[np.ndarray, np.ndarray]] = []
        for number, places in at_part.items():
            positions, inside = np.array(places, np.int64).T
            waiting.append((positions, _descriptors(files[number])[inside]))
            if sum(d.nbytes for _, d in waiting) >= PART_BYTES:
                self._write(photos, states, waiting)
                waiting = []
        if waiting:
            self._write(photos, states, waiting)
        for file in files.values():  # a kill before this leaves photos twice, which harms nothing
            file.unlink()

    def _write(self, photos: Sequence[Path], states: np.ndarray, waiting: list[tuple[np.ndarray, np.ndarray]]) -> None:
        positions = np.concatenate([p for p, _ in waiting])
        descriptors = np.ascontiguousarray(np.concatenate([d for _, d in waiting]), np.float32)
        table = pa.table(
            {
                "photo": pa.array([str(photos[p]) for p in positions], pa.string()),
                "bytes": pa.array(states[positions, 0]),
                "modified": pa.array(states[positions, 1]),
                "descriptor": pa.FixedSizeListArray.from_arrays(pa.array(descriptors.ravel()), descriptors.shape[1]),
            }
        ).replace_schema_metadata({META: self.key})
        file = self.folder / f"part-{max(self._parts(), default=-1) + 1:06d}.parquet"
        with replacing(file) as fresh:
            pq.write_table(table, fresh, compression="none", use_dictionary=["photo"], write_statistics=False)
            sync_path(fresh)

    def _parts(self) -> dict[int, Path]:
        return {int(f.stem.removeprefix("part-")): f for f in sorted(self.folder.glob("part-*.parquet"))}

    def _belongs(self, file: Path) -> bool:
        try:
            return (pq.read_schema(file).metadata or {}).get(META) == self.key.encode()
        except (pa.ArrowInvalid, OSError):
            return False


def _descriptors(file: Path) -> np.ndarray:
    """Descriptors [n, dim] of a part."""
    column = pq.read_table(file, columns=["descriptor"])["descriptor"].combine_chunks()
    values: np.ndarray = column.values.to_numpy(zero_copy_only=False).reshape(len(column), -1)
    return values
