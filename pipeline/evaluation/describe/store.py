"""Descriptors on disk: a folder of Parquet parts that any Parquet reader opens, each with its protocol inside.

Invariant: a part exists whole or not at all, and belongs to exactly one `Identity`: weights, config, files, grouping,
side. Only one part is in memory at a time, writing and reading. A killed extraction continues behind its last part;
when nothing has changed there is nothing to do; when anything has, the stale parts are removed first.

Columns: `row` (position in the set), `key` (the image's path), `utm_east`, `utm_north` (metres or null), `descriptor`
(fixed_size_list of float or halffloat). Rows stand in the order of their groups, so shuffled parts are not sorted.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.common.errors import DataError
from pipeline.common.files import replacing
from pipeline.evaluation.identity import Identity
from pipeline.evaluation.protocol import Protocol, read_protocol

META = b"place_recognition"
KEYS = 4_096  # paths compared at a time
READ_BYTES = 2**24  # of descriptors read at a time: decoding needs a multiple of it


def store_folder(output: Path, set_name: str, protocol: Protocol, side: str) -> Path:
    """`<output>/descriptors/<set>/<grouping>/<side>`: where the descriptors of one side of a set are kept."""
    return output / "descriptors" / set_name / protocol.grouping.name / side


class StoreWriter:
    """Writes the parts of one identity; made on rank 0 alone."""

    def __init__(
        self,
        folder: Path,
        identity: Identity,
        paths: Sequence[Path],
        positions: np.ndarray | None,
        parts: int,
        model_config: dict[str, Any] | None = None,
    ) -> None:
        """`folder`: of `store_folder`; `positions`: [n, 2] UTM metres or None; `parts`: how many blocks will come."""
        self.folder, self.paths, self.positions, self.parts = folder, paths, positions, parts
        self.stored = identity.protocol.stored
        self._about = {
            "key": identity.digest,
            "side": identity.of,
            "model": identity.model,
            "model_config": model_config,
            "files": identity.files,
            "protocol": identity.protocol.to_dict(),
            "parts": parts,
            "rows": len(paths),
        }
        self.folder.mkdir(parents=True, exist_ok=True)
        self.done = frozenset(n for n in range(parts) if self._part_belongs(n))
        keep = {self._part(n).name for n in self.done}
        # stale parts of another key, and what a killed run left
        for file in [*self.folder.glob("part-*"), *self.folder.glob(".part-*")]:
            if file.name not in keep:
                file.unlink()

    @property
    def complete(self) -> bool:
        """Whether every part is there."""
        return len(self.done) == self.parts

    def put(self, number: int, positions: np.ndarray, descriptors: np.ndarray) -> None:
        """Writes part `number`: descriptors [n, dim] of the images at `positions` [n]."""
        kind = np.float16 if self.stored == "fp16" else np.float32
        flat = np.ascontiguousarray(descriptors, dtype=kind).reshape(-1)
        places = None if self.positions is None else np.asarray(self.positions, np.float64)[positions]
        east, north = (None, None) if places is None else (places[:, 0], places[:, 1])
        empty = pa.nulls(len(positions), pa.float64())
        table = pa.table(
            {
                "row": pa.array(positions, pa.int64()),
                "key": pa.array([str(self.paths[p]) for p in positions], pa.string()),
                "utm_east": empty if east is None else pa.array(east),
                "utm_north": empty if north is None else pa.array(north),
                "descriptor": pa.FixedSizeListArray.from_arrays(pa.array(flat), descriptors.shape[1]),
            }
        ).replace_schema_metadata({META: json.dumps(self._about)})
        with replacing(self._part(number)) as fresh:
            # descriptors neither compress nor repeat: plain pages are smaller in time and no larger on disk
            pq.write_table(table, fresh, compression="none", use_dictionary=False, write_statistics=["row"])
        self.done |= {number}

    def _part(self, number: int) -> Path:
        return self.folder / f"part-{number:05d}.parquet"

    def _part_belongs(self, number: int) -> bool:
        path = self._part(number)
        return path.is_file() and _about(path).get("key") == self._about["key"]


class DescriptorStore:
    """Reads a finished folder of parts, without the model that made them."""

    def __init__(self, folder: Path) -> None:
        """Raises `DataError` where parts are missing or foreign."""
        self.folder = folder
        self.files = sorted(folder.glob("part-*.parquet"))
        if not self.files:
            raise DataError(f"{folder}: no descriptors here; run jobs.evaluate with --store fp32 first")
        self.about = _about(self.files[0])
        if len(self.files) != self.about.get("parts"):
            raise DataError(
                f"{folder}: {len(self.files)} of {self.about.get('parts')} parts; run the evaluation again to finish it"
            )
        self.rows = int(self.about["rows"])
        self.dim = int(pq.read_schema(self.files[0]).field("descriptor").type.list_size)
        self.protocol = read_protocol(self.about["protocol"], str(folder))

    def __len__(self) -> int:
        return self.rows

    def blocks(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """(rows int64 [n], descriptors [n, dim] in the stored type), part by part, some `READ_BYTES` at a time."""
        rows = max(1, READ_BYTES // (self.dim * self._width()))
        for file in self.files:
            with pq.ParquetFile(file, pre_buffer=False) as part:
                for batch in part.iter_batches(rows, columns=["row", "descriptor"]):
                    flat = batch.column("descriptor").values
                    first = batch.column("descriptor").offset * self.dim  # `values` ignores the slice it belongs to
                    values = flat.slice(first, batch.num_rows * self.dim).to_numpy(zero_copy_only=False)
                    yield batch.column("row").to_numpy(), values.reshape(-1, self.dim)
                    pa.default_memory_pool().release_unused()  # or the peak creeps up with the number of parts

    def _width(self) -> int:
        return 2 if self.protocol.stored == "fp16" else 4

    def array(self) -> np.ndarray:
        """All descriptors [rows, dim] in row order, in memory."""
        whole: np.ndarray | None = None
        for rows, values in self.blocks():
            if whole is None:
                whole = np.empty((self.rows, self.dim), values.dtype)
            whole[rows] = values
        assert whole is not None  # a store has at least one part
        return whole

    def keys(self) -> list[str]:
        """The images' paths in row order, all in memory; `holds` compares them without."""
        table = pa.concat_tables(pq.read_table(f, columns=["row", "key"]) for f in self.files).sort_by("row")
        return [str(key) for key in table["key"].to_pylist()]

    def holds(self, paths: Sequence[Path]) -> bool:
        """Whether row i is of `paths[i]`, however written, for exactly these images; some thousand in memory a time."""
        if len(paths) != self.rows:
            return False
        for file in self.files:
            with pq.ParquetFile(file) as part:
                for batch in part.iter_batches(KEYS, columns=["row", "key"]):
                    rows, keys = batch.column("row").to_pylist(), batch.column("key").to_pylist()
                    if not all(_same(key, paths[row]) for row, key in zip(rows, keys, strict=True)):
                        return False
        return True

    def positions(self) -> np.ndarray | None:
        """UTM metres [rows, 2], or None where the set has no positions."""
        columns = ["row", "utm_east", "utm_north"]
        table = pa.concat_tables(pq.read_table(f, columns=columns) for f in self.files).sort_by("row")
        if table["utm_east"].null_count:
            return None
        return np.stack([table["utm_east"].to_numpy(), table["utm_north"].to_numpy()], axis=1)


def _same(key: str, path: Path) -> bool:
    return key == str(path) or Path(key).absolute() == path.absolute()


def _about(path: Path) -> dict[str, Any]:
    try:
        found = (pq.read_schema(path).metadata or {}).get(META)
    except (pa.ArrowInvalid, OSError):
        return {}
    return dict(json.loads(found)) if found else {}
