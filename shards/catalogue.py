"""What a source folder holds: every photo with its place, in an order that no directory listing can change.

Invariant: a photo that the source names is either in `table` or in `left_out` with a reason, once; a place's number of
named photos is known even when none of them is there.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.common.errors import DataError
from pipeline.common.pictures import MAX_BYTES

SCHEMA = pa.schema(
    [
        ("city", pa.string()),
        ("place_id", pa.string()),  # unique within its city
        ("path", pa.string()),  # from the source's root, with /
        ("size", pa.int64()),  # bytes; -1: no such file, -2: it may not be read
        ("lat", pa.float64()),  # degrees; null where unknown, as the rest
        ("lon", pa.float64()),
        ("year", pa.int32()),
        ("month", pa.int32()),
        ("bearing", pa.float64()),  # degrees clockwise from north, 0 <= bearing < 360
    ]
)


class LeftOut(NamedTuple):
    """A line of the report: a photo (or, with an empty file, a place) that is not in the shards, and why."""

    file: str
    city: str
    place: str
    reason: str


@dataclass(frozen=True)
class Catalogue:
    """The photos of a source.

    `table` (columns of `SCHEMA`) is sorted by (city, place_id, path) and holds the photos whose files are there;
    `listed` has (city, place_id, photos named), one row a place, sorted alike.
    """

    kind: str
    root: Path
    table: pa.Table
    listed: pa.Table
    left_out: tuple[LeftOut, ...]
    duplicates: int  # rows that name a photo already named
    unlisted: int  # image files that no row or place names
    digest: str  # sha256 of all that is said above, without the root
    remarks: tuple[str, ...] = ()  # what a person should know of how it was read

    @property
    def images(self) -> int:
        """Photos that the source names, present or not."""
        return self.table.num_rows + len(self.left_out)


def build(
    kind: str,
    root: Path,
    table: pa.Table,
    left_out: Sequence[LeftOut] = (),
    unlisted: int = 0,
    remarks: Sequence[str] = (),
) -> Catalogue:
    """Sorts, removes duplicates, sets aside missing and empty files.

    Args:
        kind: name of the layout.
        root: folder that `path` starts from.
        table: columns of `SCHEMA`, any order of rows.
        left_out: photos already refused by the reader (no place can be told).
        unlisted: image files that nothing names.
        remarks: what a person should know of how it was read.

    Raises:
        DataError: there is no photo at all.
    """
    if table.num_rows + len(left_out) == 0:
        raise DataError(f"{root}: no photos found (read as {kind}); check --source and --kind")
    table = table.cast(SCHEMA).sort_by([(name, "ascending") for name in ("city", "place_id", "path")])
    paths = table["path"].to_pylist()
    first = {path: row for row, path in zip(reversed(range(len(paths))), reversed(paths), strict=True)}
    unique = table.take(pa.array(sorted(first.values()), pa.int64()))
    starts, counts = runs(unique)
    listed = unique.select(["city", "place_id"]).take(pa.array(starts)).append_column("images", pa.array(counts))
    out = list(left_out)
    usable = pc.and_(pc.greater(unique["size"], 0), pc.less_equal(unique["size"], MAX_BYTES))
    for row in unique.filter(pc.invert(usable)).to_pylist():
        reason = {0: "empty file (0 bytes)", -1: "missing", -2: "cannot be read"}.get(row["size"])
        reason = reason or f"too large: {row['size']:,} bytes, the limit is {MAX_BYTES:,}"
        out.append(LeftOut(row["path"], row["city"], row["place_id"], reason))
    present = unique.filter(usable).combine_chunks()
    digest = _digest(kind, present, out)
    again = table.num_rows - unique.num_rows
    return Catalogue(kind, root, present, listed, tuple(sorted(out)), again, unlisted, digest, tuple(remarks))


def runs(table: pa.Table) -> tuple[np.ndarray, np.ndarray]:
    """First row and number of rows (both int64) of each place of a table sorted by (city, place_id).

    Not `Table.group_by`: its groups do not come in the order of their first rows.
    """
    change = np.zeros(table.num_rows, bool)
    change[:1] = True
    for name in ("city", "place_id"):
        column = table[name].combine_chunks()
        change[1:] |= pc.not_equal(column.slice(1), column.slice(0, max(len(column) - 1, 0))).to_numpy(False)
    starts = np.flatnonzero(change).astype(np.int64)
    return starts, np.diff(np.append(starts, table.num_rows)).astype(np.int64)


def _digest(kind: str, table: pa.Table, left_out: list[LeftOut]) -> str:
    digest = hashlib.sha256(f"{kind}\n{sorted(left_out)}\n{table.num_rows}\n".encode())
    for name in table.column_names:
        column = pc.fill_null(table[name].cast(pa.string()), "").combine_chunks()
        whole = pa.ListArray.from_arrays(pa.array([0, len(column)], pa.int32()), column)
        digest.update(name.encode() + b"\n")
        digest.update(pc.binary_join(whole, "\n")[0].as_buffer())
    return digest.hexdigest()
