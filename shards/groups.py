"""Groups of places: the unit of parallel work, of resuming, and of a shard file.

A group's places become one shard in each of the R rounds, written side by side, so each photo is read and checked
once, whatever R. Invariant: the groups are a function of catalogue and settings alone, and a group's shards of its task
alone: neither the number of workers nor a kill changes a byte. A group is finished when its part file is there, which
is renamed into place after its shards.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from pipeline.common.errors import DataError
from pipeline.common.files import locked, sync_path, write_atomically
from pipeline.common.pictures import read_file
from shards import schema
from shards.catalogue import Catalogue, LeftOut, runs
from shards.images import ImageRule, Refused, admit
from shards.rounds import IMAGES_A_PLACE, draw, permutation, rank
from shards.shard_file import Member, ShardFile

PART_SCHEMA = pa.schema(
    [("number", pa.int64()), ("good", pa.int32()), *(f for f in schema.SCHEMA if f.name != "place")]
)  # number: what `sample` spells; good: the place's good images
_MEMBERS = tuple(f"{k}.jpg" for k in range(IMAGES_A_PLACE))
_TAR_OVERHEAD = 6 * 1024  # headers, padding and JSON of a sample, about


@dataclass(frozen=True)
class GroupTask:
    """What a worker needs for one group; small enough to be sent to it."""

    number: int
    source: Path
    out: Path
    seed: int
    rounds: int
    rule: ImageRule
    photos: pa.Table  # catalogue rows, place after place in writing order
    places: tuple[tuple[int, int], ...]  # (position in writing order, photos) of each place
    stride: int  # sample number = round * stride + position
    width: int  # digits of a sample's name


@dataclass(frozen=True)
class GroupPlan:
    """All groups of a shard set. `tasks` makes them one by one, so that only those in flight take memory."""

    catalogue: Catalogue
    order: np.ndarray  # [places] indices into `starts` and `counts`, as written
    starts: np.ndarray  # [places] first row of each place in the catalogue's table
    counts: np.ndarray  # [places] its photos
    bounds: tuple[int, ...]  # group g is order[bounds[g] : bounds[g + 1]]
    round_bytes: int  # about, of a round's shards
    source_bytes: int  # of the photos that will be opened

    def __len__(self) -> int:
        return len(self.bounds) - 1

    @property
    def images(self) -> int:
        """Photos that will be opened."""
        return int(self.counts[self.order].sum())

    def tasks(
        self, out: Path, seed: int, rounds: int, rule: ImageRule, part: int = 1, parts: int = 1
    ) -> Iterator[GroupTask]:
        """The groups' tasks in order; of `parts` equal shares the `part`-th, counted from 1."""
        stride = len(self.order)
        width = max(6, len(str(stride * rounds - 1)))
        for g in range(part - 1, len(self), parts):
            first, last = self.bounds[g], self.bounds[g + 1]
            places = self.order[first:last]
            rows = np.concatenate([np.arange(self.starts[p], self.starts[p] + self.counts[p]) for p in places])
            yield GroupTask(
                g, self.catalogue.root, out, seed, rounds, rule,
                self.catalogue.table.take(pa.array(rows)).combine_chunks(),
                tuple((first + i, int(self.counts[p])) for i, p in enumerate(places)), stride, width,
            )  # fmt: skip


def plan_groups(catalogue: Catalogue, seed: int, shard_mb: float) -> GroupPlan:
    """Groups the places that have four photos, city by city, shuffled by the seed within their city.

    A shard has about `shard_mb` MB (10^6 bytes) of the source's bytes, less where a round has under 16 such shards, so
    that small sets too are written in parallel and read in several windows, but at least about 1 MB.
    """
    starts, counts = runs(catalogue.table)
    place_bytes = np.add.reduceat(catalogue.table["size"].to_numpy(), starts) if len(starts) else starts
    sample_bytes = place_bytes / np.maximum(counts, 1) * IMAGES_A_PLACE + _TAR_OVERHEAD
    first = catalogue.table.select(["city", "place_id"]).take(pa.array(starts))
    cities, ids = first["city"].to_pylist(), first["place_id"].to_pylist()
    enough = [p for p in range(len(cities)) if counts[p] >= IMAGES_A_PLACE]
    enough.sort(key=lambda p: (cities[p], rank(seed, cities[p], ids[p]), ids[p]))
    order = np.array(enough, np.int64)
    cumulated = np.cumsum(sample_bytes[order])
    total = float(cumulated[-1]) if len(order) else 0.0
    opened = int(place_bytes[order].sum())
    number = max(1, round(total / min(shard_mb * 1e6, max(1e6, total / 16))))
    middles = cumulated - sample_bytes[order] / 2  # a place belongs where its middle falls: groups of equal bytes
    group = np.minimum(middles * number / max(total, 1.0), number - 1).astype(np.int64)
    bounds = [0, *(np.flatnonzero(np.diff(group)) + 1).tolist(), len(order)] if len(order) else [0]
    return GroupPlan(catalogue, order, starts, counts, tuple(bounds), int(total), opened)


def shard_name(round_: int, group: int) -> str:
    """File name of a group's shard in a round."""
    return f"round-{round_:02d}-{group:05d}.tar"


def part_path(out: Path, group: int) -> Path:
    """The file that says that a group is finished, and holds its rows of the index."""
    return out / schema.UNFINISHED / f"part-{group:05d}.parquet"


def write_group(task: GroupTask) -> int:
    """Writes a group's shards and its part file, unless they are there and whole; returns the photos it stands for.

    Raises:
        UsageError: another process writes this group.
    """
    folder = task.out / schema.UNFINISHED
    with locked(folder / f"group-{task.number:05d}.lock", f"--out {task.out}: another run is writing there"):
        return _write_group(task, folder)


def _write_group(task: GroupTask, folder: Path) -> int:
    if not _is_finished(task):
        with contextlib.ExitStack() as stack:
            names = [shard_name(r, task.number) for r in range(task.rounds)]
            shards = [stack.enter_context(ShardFile(folder / (name + ".tmp"))) for name in names]
            rows, facts = _write_samples(task, shards)
            for name, shard in zip(names, shards, strict=True):
                if shard.samples:  # a shard without samples is not written: readers stumble over an empty tar file
                    shard.finish(task.out / name)
                    told = {"name": name, "bytes": shard.size, "sha256": shard.sha256, "samples": shard.samples}
                    facts["shards"].append(told)
            sync_path(task.out)
        table = pa.Table.from_pylist(rows, PART_SCHEMA).replace_schema_metadata({"group": json.dumps(facts)})
        sink = pa.BufferOutputStream()
        pq.write_table(table, sink)
        write_atomically(part_path(task.out, task.number), sink.getvalue().to_pybytes())
    return int(task.photos.num_rows)


def read_part(out: Path, group: int) -> tuple[pa.Table, dict[str, Any]]:
    """The index rows (columns of `PART_SCHEMA`) and the facts of a finished group."""
    table = pq.read_table(part_path(out, group))
    return table.replace_schema_metadata(None), json.loads(table.schema.metadata[b"group"])


def _is_finished(task: GroupTask) -> bool:
    """Whether an earlier run finished this group and its shards are still what it wrote."""
    try:
        table, facts = read_part(task.out, task.number)
        if not table.schema.equals(PART_SCHEMA):  # of an earlier version of this program
            return False
        for shard in facts["shards"]:
            with (task.out / shard["name"]).open("rb") as stream:
                if hashlib.file_digest(stream, "sha256").hexdigest() != shard["sha256"]:
                    return False
    except (OSError, pa.ArrowException, ValueError, KeyError, TypeError):
        return False
    return True


def _write_samples(task: GroupTask, shards: list[ShardFile]) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    facts: dict[str, Any] = {"shards": [], "left_out": [], "fallen": [], "good": 0, "made_again": 0}
    photos = task.photos.to_pylist()
    start = 0
    for position, count in task.places:
        place = photos[start : start + count]
        start += count
        city, place_id = place[0]["city"], place[0]["place_id"]
        good: list[tuple[dict[str, Any], bytes]] = []
        for photo in place:
            stored = _read(task.source / photo["path"], task.rule, facts)
            if isinstance(stored, Refused):
                facts["left_out"].append(LeftOut(photo["path"], city, place_id, stored.reason))
            else:
                good.append((photo, stored))
        facts["good"] += len(good)
        if len(good) < IMAGES_A_PLACE:
            facts["fallen"].append((city, place_id, len(good), count))
            continue
        lat, lon = _mean_position([photo for photo, _ in good])
        shown = [good[i] for i in permutation(task.seed, city, place_id, [photo["path"] for photo, _ in good])]
        for round_, shard in enumerate(shards):
            number = round_ * task.stride + position
            key = f"{number:0{task.width}d}"
            chosen = [shown[i] for i in draw(len(shown), round_)]
            members = shard.add(key, _sample(city, place_id, round_, chosen))
            rows.append(
                {
                    "number": number, "good": len(good), "sample": key, "round": round_, "city": city,
                    "place_id": place_id, "shard": shard_name(round_, task.number), "lat": lat, "lon": lon,
                    **_where(members),
                }
            )  # fmt: skip
    return rows, facts


def _mean_position(photos: list[dict[str, Any]]) -> tuple[float | None, float | None]:
    """Mean latitude and longitude in degrees of the photos that have both; None where none has."""
    known = [(p["lat"], p["lon"]) for p in photos if p["lat"] is not None and p["lon"] is not None]
    if not known:
        return None, None
    lats, lons = [lat for lat, _ in known], [lon for _, lon in known]
    if max(lons) - min(lons) > 180:  # the place lies on both sides of the 180th meridian
        lons = [lon + 360 * (lon < 0) for lon in lons]
    lon = math.fsum(lons) / len(known)
    return math.fsum(lats) / len(known), lon - 360 * (lon > 180)


def _read(path: Path, rule: ImageRule, facts: dict[str, Any]) -> bytes | Refused:
    try:
        data = read_file(path)
    except FileNotFoundError:
        return Refused("missing")
    except OSError as error:
        return Refused(f"cannot be read: {error.strerror}")
    except DataError as error:
        return Refused(str(error))
    stored = admit(data, rule)
    facts["made_again"] += not isinstance(stored, Refused) and stored is not data
    return stored


def _sample(city: str, place_id: str, round_: int, chosen: list[tuple[dict[str, Any], bytes]]) -> dict[str, bytes]:
    images = [
        {"source": photo["path"], **{name: photo[name] for name in ("lat", "lon", "year", "month", "bearing")}}
        for photo, _ in chosen
    ]
    told = {"city": city, "place_id": place_id, "round": round_, "images": images}
    members = {name: data for name, (_, data) in zip(_MEMBERS, chosen, strict=True)}
    return {**members, "json": json.dumps(told, ensure_ascii=False, separators=(",", ":")).encode()}


def _where(members: Mapping[str, Member]) -> dict[str, Any]:
    return {
        "offsets": [members[name].offset for name in _MEMBERS],
        "sizes": [members[name].size for name in _MEMBERS],
        "json_offset": members["json"].offset,
        "json_size": members["json"].size,
    }


def places_of(rows: pa.Table) -> pa.Table:
    """Number of each place: its rank in the order of (city, place_id) among the places that are in the set."""
    first = rows.filter(pc.equal(rows["round"], 0)).select(["city", "place_id", "good"])
    ordered = first.sort_by([("city", "ascending"), ("place_id", "ascending")])
    return ordered.append_column("place", pa.array(np.arange(ordered.num_rows, dtype=np.int32)))
