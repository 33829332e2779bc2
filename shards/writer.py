"""Writes a shard set from a catalogue: groups in parallel, then index, report and, last, the manifest.

Invariant: the folder has a manifest only when everything else in it is whole and on the disk; whatever kills the run,
the same call continues with the groups that are not finished and ends with the same bytes; another source or other
settings never mix into a folder.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import re
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from pipeline.common import files
from pipeline.common.cores import available_cores
from pipeline.common.errors import DataError, UsageError
from pipeline.common.files import locked, write_atomically
from pipeline.common.progress import Progress
from pipeline.common.text import shown as readable
from shards import groups, index, report, schema
from shards.catalogue import Catalogue, LeftOut
from shards.images import QUALITY, ImageRule
from shards.rounds import IMAGES_A_PLACE, shown

SETTINGS = "settings.json"
_BYTES_A_WORKER = 64_000_000  # photos worth a second of starting a process


@dataclass(frozen=True)
class WriteRule:
    """What is written. All but `max_bad` and `workers` decide the bytes and are kept in the manifest."""

    rounds: int = 4
    seed: int = 0
    shard_mb: float = 64.0  # of a shard, in 10^6 bytes, about
    image: ImageRule = field(default_factory=ImageRule)
    reading: dict[str, Any] = field(default_factory=dict)  # how the source was read (`sources.reading_settings`)
    max_bad: float = 0.01  # share of named images that may be missing or broken
    workers: int = 0  # processes; 0: one a core, where there is work for it

    def settings(self, catalogue: Catalogue) -> dict[str, Any]:
        """The manifest's settings."""
        return {
            "rounds": self.rounds,
            "seed": self.seed,
            "shard_mb": self.shard_mb,
            "check": self.image.check,
            "resize": self.image.resize,
            "png": f"JPEG of quality {QUALITY}" if self.image.convert else "left out",
            "reading": self.reading or {"kind": catalogue.kind},
            "source": {"images": catalogue.images, "places": catalogue.listed.num_rows, "digest": catalogue.digest},
        }


def write_shards(catalogue: Catalogue, out: Path, rule: WriteRule | None = None) -> report.Summary:
    """Writes (or finishes, or leaves as it is) the shard set of a catalogue in the folder `out`.

    PNG is converted, rather than left out, unless the source is GSV-Cities, whatever `rule.image.convert` says.

    Raises:
        UsageError: impossible settings; `out` holds another set, other files, or another run at work.
        DataError: a full disk; more than `max_bad` of the images are missing or broken (all named in report.csv); no
            place has four images.
    """
    with _told(out):
        return _write(catalogue, out, _completed(rule or WriteRule(), catalogue))


def write_part(catalogue: Catalogue, out: Path, rule: WriteRule, part: int, parts: int) -> int:
    """Writes the `part`-th (from 1) of `parts` shares of the groups; how many they are, 0 for a finished set.

    Other parts may be written at the same time, also on other machines that share `out`. Once all are written,
    `write_shards` finds their shards there and adds the index.

    Raises:
        As `write_shards`; UsageError also for a part that is none of `parts`.
    """
    if not 1 <= part <= parts:
        raise UsageError(f"--part {part}: give 1 to {parts}, the number in --parts")
    with _told(out):
        rule = _completed(rule, catalogue)
        settings = rule.settings(catalogue)
        if _already(out, settings) is not None:
            return 0
        plan = _planned(catalogue, out, rule)
        _begin(out, settings)
        _write_all(plan, out, rule, part, parts)
        return len(range(part - 1, len(plan), parts))


@contextlib.contextmanager
def _told(out: Path) -> Iterator[None]:
    """A disk's error in one line."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise DataError(f"{readable(out)}: {reason}; finished shards are kept, the same command continues") from error


def _write(catalogue: Catalogue, out: Path, rule: WriteRule) -> report.Summary:
    settings = rule.settings(catalogue)
    if (done := _already(out, settings)) is not None:
        return done
    start = time.monotonic()
    plan = _planned(catalogue, out, rule)
    # a second run is refused at once; one that writes a part, at the first group that both want
    with locked(out / schema.UNFINISHED / "lock", f"--out {out}: another run is writing there"):
        _begin(out, settings)
        _write_all(plan, out, rule, 1, 1)
        counts, left_out = _complete(catalogue, plan, out, rule, settings)
    shutil.rmtree(out / schema.UNFINISHED)
    return report.Summary(str(out), counts, report.reasons(left_out), time.monotonic() - start, plan.images)


def _planned(catalogue: Catalogue, out: Path, rule: WriteRule) -> groups.GroupPlan:
    """The groups to write; refuses what can be refused before any work. Makes `out`."""
    if len(catalogue.left_out) > rule.max_bad * catalogue.images:
        _refuse(out, catalogue, list(catalogue.left_out), rule.max_bad, began=False)
    plan = groups.plan_groups(catalogue, rule.seed, rule.shard_mb)
    if not len(plan):
        raise DataError(
            f"{catalogue.root}: no place has {IMAGES_A_PLACE} images, of {catalogue.listed.num_rows:,} places"
        )
    out.mkdir(parents=True, exist_ok=True)
    _check_space(out, plan, rule)
    return plan


def _write_all(plan: groups.GroupPlan, out: Path, rule: WriteRule, part: int, parts: int) -> None:
    """The groups of a part, with a progress line."""
    images = plan.images if parts == 1 else None  # a part's are known when its tasks are made
    label = "writing shards" if parts == 1 else f"writing shards, part {part} of {parts}"
    with Progress(label, images, "images") as progress:
        for written in _write_groups(plan, out, rule, part, parts):
            progress.advance(written)


def check_writable(out: Path, shared: bool = False) -> None:
    """Whether the shards can be written to `out`, before any work is done; leaves nothing behind.

    `shared`: other parts may be written there at the same time; then the folder stays, as it may be theirs already.

    Raises:
        UsageError: they cannot, such as on a read-only file system.
    """
    made = [] if shared else [folder for folder in (out, *out.parents) if not os.path.lexists(folder)]
    try:
        if not out.is_file():  # told later, with what else may be wrong with it
            files.check_writable(out, "--out")
    finally:
        for folder in made:
            with contextlib.suppress(OSError, ValueError):
                folder.rmdir()


def remove_shards(out: Path) -> None:
    """Deletes the files of a shard set, finished or not, and nothing else; the manifest first.

    Raises:
        UsageError: they cannot be deleted.
    """
    try:
        for path in sorted(out.iterdir() if out.is_dir() else [], key=lambda p: (p.name != schema.MANIFEST, p.name)):
            if path.name == schema.UNFINISHED:
                shutil.rmtree(path)
            elif _is_ours(path.name):
                path.unlink()
    except OSError as error:
        raise UsageError(f"--out {readable(out)}: the earlier shards cannot be deleted ({error.strerror})") from None


def _completed(rule: WriteRule, catalogue: Catalogue) -> WriteRule:
    """The rule with defaults filled in, or a refusal."""
    if not 1 <= rule.rounds <= schema.MAX_ROUNDS:
        raise UsageError(f"--rounds {rule.rounds}: give 1 to {schema.MAX_ROUNDS}")
    if not 0 <= rule.max_bad <= 1:
        raise UsageError(f"--max_bad {rule.max_bad}: a share between 0 and 1")
    if rule.shard_mb <= 0 or rule.workers < 0 or rule.image.resize < 0:
        raise UsageError("--shard_mb must be above 0, --workers and --resize not below 0")
    image = ImageRule(rule.image.check, rule.image.resize, catalogue.kind != "gsv_cities")
    return WriteRule(rule.rounds, rule.seed, float(rule.shard_mb), image, rule.reading, rule.max_bad, rule.workers)


def _already(out: Path, settings: dict[str, Any]) -> report.Summary | None:
    """The summary of a set that is finished in `out`; None where there is work to do; refuses anything else there."""
    if not out.exists():
        return None
    if not out.is_dir():
        raise UsageError(f"--out {out}: is a file")
    names = {path.name for path in out.iterdir()}
    if foreign := sorted(name for name in names if not _is_ours(name)):
        raise UsageError(f"--out {out}: holds other files ({readable(foreign[0])}); give an empty folder or a new name")
    earlier = out / schema.UNFINISHED / SETTINGS
    if schema.MANIFEST in names:
        found = index.read_index(str(out)).manifest
        _compare(out, found["settings"], settings)
        problem = next((s["name"] for s in found["shards"] if _size(out / s["name"]) != s["bytes"]), None)
        if problem:
            raise DataError(f"{out}/{problem}: missing or truncated; start with --overwrite to write the set again")
        if schema.UNFINISHED in names:  # killed between the manifest and the tidying
            shutil.rmtree(out / schema.UNFINISHED)
        return report.Summary(str(out), found["counts"], found["left_out"], 0.0, 0)
    if earlier.exists():
        _compare(out, _settings(earlier), settings)
    elif any(name.endswith(".tar") for name in names):
        raise UsageError(f"--out {out}: holds shards without a manifest; start with --overwrite to write the set again")
    return None


def _settings(path: Path) -> dict[str, Any]:
    """The settings of a set that was begun."""
    try:
        settings = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        settings = None
    if not isinstance(settings, dict):
        raise UsageError(f"{path}: not readable; start with --overwrite to write the set again")
    return settings


def _compare(out: Path, before: dict[str, Any], now: dict[str, Any]) -> None:
    """Raises UsageError naming what differs between the settings in `out` and these."""
    old, new = _flat(before), _flat(now)
    keys = [key for key in sorted(old.keys() | new.keys()) if old.get(key) != new.get(key)]
    changes = [f"{readable(key)} {readable(old.get(key))} -> {readable(new.get(key))}" for key in keys]
    if changes:
        raise UsageError(
            f"--out {out}: holds shards of another source or other settings: {', '.join(changes)}; "
            "give another --out, the earlier settings, or --overwrite"
        )


def _flat(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        flat.update(_flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value})
    return {key: value[:12] if key.endswith("digest") else value for key, value in flat.items()}


def _is_ours(name: str) -> bool:
    ours = (schema.MANIFEST, schema.INDEX, schema.REPORT, schema.UNFINISHED)
    return name in ours or re.fullmatch(r"round-\d{2,}-\d{5,}\.tar", name) is not None


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else -1


def _check_space(out: Path, plan: groups.GroupPlan, rule: WriteRule) -> None:
    needed = plan.round_bytes * rule.rounds - sum(path.stat().st_size for path in out.glob("round-*.tar"))
    free = shutil.disk_usage(out).free
    if not rule.image.resize and needed > free:
        raise UsageError(f"--out {out}: about {needed / 1e9:,.1f} GB needed, {free / 1e9:,.1f} GB free; lower --rounds")


def _begin(out: Path, settings: dict[str, Any]) -> None:
    """The folder of unfinished work, and in it the settings; parts may begin at the same moment."""
    folder = out / schema.UNFINISHED
    folder.mkdir(exist_ok=True)
    if not (folder / SETTINGS).exists():
        own = folder / f"{SETTINGS}.{socket.gethostname()}.{os.getpid()}"
        write_atomically(folder / SETTINGS, schema.canonical(settings), own)


def _write_groups(plan: groups.GroupPlan, out: Path, rule: WriteRule, part: int, parts: int) -> Iterator[int]:
    """Writes the groups of a part, in processes; yields the photos of each as it is finished."""
    tasks = plan.tasks(out, rule.seed, rule.rounds, rule.image, part, parts)
    worth = 1 + plan.source_bytes // parts // _BYTES_A_WORKER
    workers = min(rule.workers or min(available_cores(), worth), len(plan))
    if workers == 1:
        yield from map(groups.write_group, tasks)
        return
    spawn = multiprocessing.get_context("spawn")  # fork would copy whatever threads the caller has
    with ProcessPoolExecutor(workers, spawn, initializer=_end_with_parent) as pool:
        waiting: set[Future[int]] = set()
        try:
            for task in tasks:
                waiting.add(pool.submit(groups.write_group, task))
                if len(waiting) >= 3 * workers:  # bounds the memory of tasks in flight
                    finished, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                    yield from (future.result() for future in finished)
            while waiting:
                finished, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                yield from (future.result() for future in finished)
        except BrokenProcessPool:
            hint = "out of memory? then lower --workers"
            raise UsageError(
                f"a worker was killed ({hint}); finished shards are kept, the same command goes on"
            ) from None
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _end_with_parent() -> None:
    """In a worker: leave at once when the parent is gone, so that a killed run leaves no writers behind."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _complete(
    catalogue: Catalogue, plan: groups.GroupPlan, out: Path, rule: WriteRule, settings: dict[str, Any]
) -> tuple[dict[str, int], list[LeftOut]]:
    """Index, report and manifest from the finished groups; refuses where too many images are bad."""
    parts = [groups.read_part(out, g) for g in range(len(plan))]
    facts = [fact for _, fact in parts]
    left_out = [*catalogue.left_out, *(LeftOut(*item) for fact in facts for item in fact["left_out"])]
    if len(left_out) > rule.max_bad * catalogue.images:
        _refuse(out, catalogue, left_out, rule.max_bad, began=True)
    rows = pa.concat_tables([table for table, _ in parts]).sort_by([("round", "ascending"), ("number", "ascending")])
    places = groups.places_of(rows)
    if not places.num_rows:
        write_atomically(out / schema.REPORT, report.report_bytes(left_out))
        raise DataError(f"{out}/{schema.REPORT}: no place has {IMAGES_A_PLACE} good images; it says what is wrong")
    under = catalogue.listed.filter(pc.less(catalogue.listed["images"], IMAGES_A_PLACE)).to_pylist()
    fallen = [*_fallen_at_sight(catalogue, plan), *(tuple(item) for fact in facts for item in fact["fallen"])]
    shards = sorted((shard for fact in facts for shard in fact["shards"]), key=lambda shard: shard["name"])
    used = sum(shown(n, rule.rounds) for n in places["good"].to_pylist())
    counts = {
        "places": places.num_rows, "places_named": catalogue.listed.num_rows, "places_under_four": len(under),
        "places_fallen": len(fallen), "rounds": rule.rounds, "samples": rows.num_rows,
        "images_named": catalogue.images, "images_used": used, "images_bad": len(left_out),
        "images_unused": catalogue.images - used - len(left_out), "duplicates": catalogue.duplicates,
        "unlisted": catalogue.unlisted, "made_again": sum(fact["made_again"] for fact in facts),
        "shards": len(shards), "bytes": sum(shard["bytes"] for shard in shards),
    }  # fmt: skip
    told = report.report_bytes([*left_out, *report.place_lines(under, fallen)])
    data = index.index_bytes(_with_place(rows, places))
    manifest = {
        "format_version": schema.FORMAT_VERSION, "settings": settings, "counts": counts,
        "left_out": report.reasons(left_out), "shards": shards,
        "index_sha256": schema.sha256(data), "report_sha256": schema.sha256(told),
    }  # fmt: skip
    work = out / schema.UNFINISHED
    for name, content in (
        (schema.REPORT, told),
        (schema.INDEX, data),
        (schema.MANIFEST, schema.sealed_manifest(manifest)),
    ):
        write_atomically(out / name, content, work / (name + ".tmp"))
    return counts, left_out


def _with_place(rows: pa.Table, places: pa.Table) -> pa.Table:
    number = dict(zip(zip(places["city"].to_pylist(), places["place_id"].to_pylist(), strict=True),
                      places["place"].to_pylist(), strict=True))  # fmt: skip
    keys = zip(rows["city"].to_pylist(), rows["place_id"].to_pylist(), strict=True)
    rows = rows.append_column("place", pa.array([number[key] for key in keys], pa.int32()))
    return rows.select(schema.SCHEMA.names)


def _fallen_at_sight(catalogue: Catalogue, plan: groups.GroupPlan) -> list[tuple[str, str, int, int]]:
    """Places named with four images of which fewer have a file: (city, place, files, named)."""
    at = catalogue.table.select(["city", "place_id"]).take(pa.array(plan.starts)).to_pylist()
    there = {(p["city"], p["place_id"]): int(n) for p, n in zip(at, plan.counts, strict=True)}
    return [
        (p["city"], p["place_id"], n, p["images"])
        for p in catalogue.listed.filter(pc.greater_equal(catalogue.listed["images"], IMAGES_A_PLACE)).to_pylist()
        if (n := there.get((p["city"], p["place_id"]), 0)) < IMAGES_A_PLACE
    ]


def _refuse(out: Path, catalogue: Catalogue, left_out: list[LeftOut], max_bad: float, began: bool) -> None:
    """Names the bad images in report.csv and ends the run without a manifest."""
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(out / schema.REPORT, report.report_bytes(left_out))
    n, of = len(left_out), catalogue.images
    why = ", ".join(f"{count:,} {reason}" for reason, count in report.reasons(left_out).items())
    kept = "; a higher --max_bad continues with the shards written, repaired files need --overwrite" if began else ""
    raise DataError(
        f"{out}/{schema.REPORT}: {n:,} of {of:,} images cannot be used ({why}), {100 * n / of:.2f} % and over "
        f"--max_bad {max_bad:g}; repair them or raise --max_bad{kept}"
    )
