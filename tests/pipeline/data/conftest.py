"""A small shard set written here with tarfile alone, independent of the project's writer."""

from __future__ import annotations

import hashlib
import io
import tarfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from PIL import Image

from shards.index import ShardIndex
from shards.schema import FORMAT_VERSION, SCHEMA

Build = Callable[..., ShardIndex]


def table_of(cities: list[int], rounds: int = 1, samples_a_shard: int = 16) -> ShardIndex:
    """An index without shards: `cities[c]` places in city c, in each of `rounds` rounds."""
    rows: dict[str, list[object]] = {name: [] for name in SCHEMA.names}
    sizes = {}
    for r in range(rounds):
        place = 0
        for city, count in enumerate(cities):
            for number in range(count):
                sample = len(rows["sample"])
                shard = f"round{r}-{place // samples_a_shard:04d}.tar"
                sizes[shard] = sizes.get(shard, 0) + 1000
                values = (
                    f"{sample:06d}",
                    r,
                    f"City{city}",
                    str(number),
                    place,
                    shard,
                    [0] * 4,
                    [10] * 4,
                    0,
                    2,
                    40.0 + city,
                    number / 1e3,
                )
                for name, value in zip(SCHEMA.names, values, strict=True):
                    rows[name].append(value)
                place += 1
    manifest = {
        "format_version": FORMAT_VERSION,
        "shards": [
            {"name": name, "bytes": size, "sha256": "", "samples": size // 1000} for name, size in sizes.items()
        ],
        "counts": {"places": sum(cities), "rounds": rounds, "samples": len(rows["sample"])},
    }
    return ShardIndex("unwritten", pa.table(rows, schema=SCHEMA), manifest, "0" * 64)


def photo(seed: int, width: int = 96, height: int = 72) -> bytes:
    """A smooth colourful JPEG, another one for each seed."""
    coarse = np.random.default_rng(seed).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    target = io.BytesIO()
    Image.fromarray(coarse).resize((width, height), Image.Resampling.BICUBIC).save(target, "JPEG", quality=90)
    return target.getvalue()


def write_set(folder: Path, cities: list[int], samples_a_shard: int = 4, damage: str | None = None) -> ShardIndex:
    """Real tar shards of one round; `damage` names a member to be cut to half its bytes."""
    index = table_of(cities, samples_a_shard=samples_a_shard)
    folder.mkdir(parents=True, exist_ok=True)
    rows = index.table.to_pylist()
    shards = []
    for name in sorted({row["shard"] for row in rows}):
        with tarfile.open(folder / name, "w") as tar:
            for row in (row for row in rows if row["shard"] == name):
                for view in range(4):
                    member = f"{row['sample']}.{view}.jpg"
                    data = photo(int(row["sample"]) * 4 + view)
                    data = data[: len(data) // 2] if member == damage else data
                    info = tarfile.TarInfo(member)
                    info.size = len(data)
                    row["offsets"][view], row["sizes"][view] = tar.offset + 512, len(data)
                    tar.addfile(info, io.BytesIO(data))
        raw = (folder / name).read_bytes()
        shards.append({"name": name, "bytes": len(raw), "sha256": hashlib.sha256(raw).hexdigest(), "samples": 4})
    manifest = {**index.manifest, "shards": shards}
    digest = hashlib.sha256(str(folder).encode()).hexdigest()
    return ShardIndex(str(folder), pa.Table.from_pylist(rows, schema=SCHEMA), manifest, digest)


@pytest.fixture(scope="session")
def small_set(tmp_path_factory: pytest.TempPathFactory) -> ShardIndex:
    """26 places of three cities, 104 photos, in seven shards."""
    return write_set(tmp_path_factory.mktemp("shards"), [11, 8, 7])


@pytest.fixture(scope="session")
def make_table() -> Build:
    """`table_of`."""
    return table_of


@pytest.fixture(scope="session")
def make_set() -> Build:
    """`write_set`."""
    return write_set


@pytest.fixture(scope="session")
def make_photo() -> Callable[..., bytes]:
    """`photo`."""
    return photo
