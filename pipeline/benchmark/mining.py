"""What planning mined batches costs: seconds of the neighbours and of the plan, and how the groups come out.

Descriptors are made. Places and positions are made too, or those of GSV-Cities: only its `Dataframes` are read.
Seconds are those of CPU, over all threads: what a machine that others use as well would need alone.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa

from pipeline.common.errors import DataError
from pipeline.data.cliques import CliqueRule, mine
from pipeline.data.plan import plan
from pipeline.data.positions import points
from pipeline.data.shard_sets import cities_of
from shards.index import ShardIndex
from shards.schema import FORMAT_VERSION, IMAGES_A_SAMPLE, SCHEMA

Places = tuple[list[str], np.ndarray]
"""City and position [P, 2] (degrees) of each place."""


def measure(
    frames: str | None, places: int, dim: int, batch: int, rule: CliqueRule, within: float, seed: int
) -> Iterator[str]:
    """Lines of figures.

    Args:
        frames: folder of GSV-Cities' `<City>.csv` or `.csv.gz`; none: made places in 23 cities.
        places: how many are made.
        dim: numbers of a descriptor.
        batch: places of a batch.
        within: metres below which two places of one batch are counted as near.

    Raises:
        DataError: no such tables in `frames`.
    """
    names, degrees = read_places(Path(frames)) if frames else made_places(places, seed)
    index = index_of(names, degrees)
    cities = cities_of(index)
    yield f"{index.places:,} places in {len(np.unique(cities))} cities, {dim}-dimensional made descriptors"
    descriptors = made_descriptors(cities, dim, seed)
    start = time.process_time()
    mined = mine(descriptors, cities, points(index.positions()), rule)
    yield f"neighbours: {rule.neighbours} of each place, exact: {time.process_time() - start:.1f} s of CPU"
    start = time.process_time()
    planned = plan(index, seed, 1, batch, "mined", mined=mined)
    seconds, share = time.process_time() - start, 100 * planned.in_cliques / planned.batches.size
    made = f"{len(planned.batches):,} batches, {share:.1f} % of the places in groups of {rule.clique}"
    yield f"plan: {made}: {seconds:.1f} s of CPU"
    start = time.process_time()
    plain = plan(index, seed, 1, batch, "city")
    yield f"order city, for comparison: {time.process_time() - start:.2f} s of CPU"
    for name, batches in (("mined", planned.batches), ("city", plain.batches)):
        # rows are places: there is one round
        alone = np.mean([len(np.unique(cities[rows])) == 1 for rows in batches])
        near, pairs, alike = 0, 0, 0.0
        upper = np.triu(np.ones((batch, batch), bool), 1)
        for rows in batches:
            at = mined.points[rows]
            near += int((np.linalg.norm(at[:, None] - at[None], axis=2)[upper] < within).sum())
            unit = descriptors[rows].astype(np.float32)
            alike += float((unit @ unit.T)[upper].sum())
            pairs += int(upper.sum())
        yield (
            f"{name}: {100 * alone:.1f} % of the batches in one city; {near:,} pairs closer than {within:g} m in a "
            f"batch; mean similarity of two places of a batch {alike / pairs:.3f}"
        )


def read_places(folder: Path) -> Places:
    """The places of GSV-Cities' tables that have four images, in the order of (city, place)."""
    import pyarrow.csv as csv

    files = sorted({*folder.glob("*.csv"), *folder.glob("*.csv.gz")})
    if not files:
        raise DataError(f"{folder}: no <City>.csv or .csv.gz there (GSV-Cities' Dataframes)")
    names: list[str] = []
    found: list[np.ndarray] = []
    for file in files:
        table = csv.read_csv(file)
        means = table.group_by("place_id").aggregate([("lat", "mean"), ("lon", "mean"), ("place_id", "count")])
        rows = means.sort_by("place_id").to_pydict()
        kept = np.array(rows["place_id_count"]) >= IMAGES_A_SAMPLE
        names += [file.name.partition(".")[0]] * int(kept.sum())
        found.append(np.stack([rows["lat_mean"], rows["lon_mean"]], axis=1)[kept])
    return names, np.concatenate(found)


def made_places(count: int, seed: int, cities: int = 23) -> Places:
    """Places scattered over squares of about 10 km, a city each."""
    rng = np.random.default_rng(seed)
    names = [f"City{i * cities // count:02d}" for i in range(count)]
    centres = np.array([[40.0, 3.0 * int(name[4:])] for name in names])
    return names, centres + rng.uniform(-0.05, 0.05, (count, 2))


def made_descriptors(cities: np.ndarray, dim: int, seed: int) -> np.ndarray:
    """fp16 [P, dim] of unit length: each city has a hundred looks, and each place is near to one of them."""
    rng = np.random.default_rng(seed)
    looks = rng.normal(size=(int(cities.max()) + 1, 100, dim)).astype(np.float32)
    values = looks[cities, rng.integers(0, 100, len(cities))]
    values = values + 1.0 * rng.normal(size=values.shape).astype(np.float32)
    return (values / np.linalg.norm(values, axis=1, keepdims=True)).astype(np.float16)


def index_of(names: list[str], degrees: np.ndarray) -> ShardIndex:
    """An index of one round over places without images."""
    count = len(names)
    none = pa.array([[0] * IMAGES_A_SAMPLE] * count, pa.list_(pa.int64(), IMAGES_A_SAMPLE))
    table = pa.table(
        {
            "sample": [f"{i:06d}" for i in range(count)], "round": np.zeros(count, np.int32), "city": names,
            "place_id": [str(i) for i in range(count)], "place": np.arange(count, dtype=np.int32),
            "shard": ["none.tar"] * count, "offsets": none, "sizes": none, "json_offset": np.zeros(count, np.int64),
            "json_size": np.zeros(count, np.int64), "lat": degrees[:, 0], "lon": degrees[:, 1],
        }, schema=SCHEMA,
    )  # fmt: skip
    manifest = {"format_version": FORMAT_VERSION, "shards": [], "counts": {"places": count, "rounds": 1}}
    return ShardIndex("made", table, manifest, "0" * 64)
