"""Draws the miniature: all places over all cores, into GSV-Cities' layout and an evaluation folder.

Invariant: a photo appears under its name only when it is whole, so a killed run is continued by the same command;
the bytes depend on the settings alone, not on the number of processes.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from pipeline.common.cores import available_cores
from pipeline.common.errors import DataError, UsageError
from pipeline.common.files import write_atomically
from pipeline.common.progress import Progress
from shards.sources.miniature.photograph import Studio
from shards.sources.miniature.plan import PlacePhotos, data_frames, plan_photos

FORMAT = 4  # of the pictures: raise it when a change of the drawing changes their bytes


@dataclass(frozen=True)
class MiniatureConfig:
    """What to draw, and where."""

    out: str = "data/miniature"
    """Folder that gets gsv/ (GSV-Cities' layout) and eval/miniature/ (database and queries)."""
    places: int = 300
    """Training places, spread evenly over four towns."""
    street_places: int = 1
    """Places along one street, 10 to 20 m apart, that show some of the same houses (1 to 20); 1: a street each."""
    seed: int = 0
    """Seed of everything; the same seed gives the same bytes."""
    width: int = 320
    """Width of a photo in pixels (32 to 2048)."""
    height: int = 240
    """Height of a photo in pixels (32 to 2048)."""
    val_places: int | None = None
    """Places of the validation folder; none: a fifth of --places."""
    test_places: int | None = None
    """Places of the test folder; none: a third of --places."""
    workers: int | None = None
    """Processes; none: one a core. The files are the same with any number."""

    def counts(self) -> tuple[int, int, int]:
        """Training, validation and test places.

        Raises:
            UsageError: a count or size that cannot be.
        """
        val = max(self.places // 5, 2) if self.val_places is None else self.val_places
        test = max(self.places // 3, 2) if self.test_places is None else self.test_places
        limits = {"places": (1, 22_000), "street_places": (1, 20), "width": (32, 2048), "height": (32, 2048)}
        limits |= {"val_places": (0, 22_000), "test_places": (0, 22_000), "workers": (1, 4096)}
        workers = 1 if self.workers is None else self.workers
        given = {**vars(self), "val_places": val, "test_places": test, "workers": workers}
        for name, (low, high) in limits.items():
            if not low <= given[name] <= high:
                raise UsageError(f"{name} = {given[name]}: must be {low} to {high}")
        if max(self.places, val, test) > 1100 * self.street_places:
            raise UsageError(f"places = {max(self.places, val, test)}: the map has room for 1100 streets of a split")
        return self.places, val, test


@dataclass(frozen=True)
class MiniatureSummary:
    """What was asked for (photos by folder: "gsv", "val/database", ...) and how many were drawn now, in how long."""

    photos: dict[str, int]
    drawn: int
    seconds: float

    def describe(self) -> str:
        """One line for a person."""
        done = f"{self.drawn} drawn in {self.seconds:.1f} s" if self.drawn else "nothing to do"
        return ", ".join(f"{n} photos in {name}" for name, n in self.photos.items()) + "; " + done


def draw(config: MiniatureConfig) -> MiniatureSummary:
    """Draws what is missing of the miniature with these settings.

    Raises:
        UsageError: a count or size that cannot be.
        DataError: the folder holds a miniature of other settings, or cannot be written.
    """
    started, out, counts = time.monotonic(), Path(config.out), config.counts()
    try:
        _claim(out, config, counts)
        planned = plan_photos(config.seed, counts, config.street_places)
        files = [photo.file for place in planned for photo in place.photos]
        for folder in {(out / file).parent for file in files}:
            folder.mkdir(parents=True, exist_ok=True)
        there = {path.relative_to(out).as_posix() for top in ("gsv", "eval") for path in (out / top).rglob("*.*")}
        left = (replace(place, photos=tuple(p for p in place.photos if p.file not in there)) for place in planned)
        missing = [place for place in left if place.photos]
        drawn = sum(len(place.photos) for place in missing)
        with Progress("drawing the miniature", drawn, "photos") as progress:
            for done in _run(out, missing, config):
                progress.advance(done)
        for path, text in data_frames(planned).items():  # last: a reader that finds them finds every photo
            if not (out / path).is_file() or (out / path).read_text() != text:
                (out / path).parent.mkdir(parents=True, exist_ok=True)
                write_atomically(out / path, text.encode())
    except OSError as error:
        raise DataError(f"{error.filename or out}: the miniature cannot be written there ({error.strerror})") from error
    photos = Counter("gsv" if file.startswith("gsv") else "/".join(file.split("/")[-3:-1]) for file in files)
    return MiniatureSummary(dict(photos), drawn, time.monotonic() - started)


def _claim(out: Path, config: MiniatureConfig, counts: tuple[int, int, int]) -> None:
    """Writes the settings beside the photos, or refuses a folder drawn with others."""
    settings = {"format": FORMAT, **dict(zip(("places", "val_places", "test_places"), counts, strict=True))}
    settings |= {name: getattr(config, name) for name in ("street_places", "seed", "width", "height")}
    note = out / "miniature.json"
    if not note.is_file():
        out.mkdir(parents=True, exist_ok=True)
        write_atomically(note, (json.dumps(settings, indent=1) + "\n").encode())
        return
    try:
        found = json.loads(note.read_text())
        other = ", ".join(f"{k} {found.get(k)} there, {v} asked" for k, v in settings.items() if found.get(k) != v)
    except (ValueError, AttributeError) as error:
        raise DataError(f"{note}: not readable ({error}); remove {out} and draw again") from error
    if other:
        raise DataError(f"{out} holds a miniature of other settings ({other}); give another --out or remove it")


def _run(out: Path, missing: list[PlacePhotos], config: MiniatureConfig) -> Iterator[int]:
    """Draws the places, and yields how many photos are done each time some are."""
    cores = available_cores()
    parts = [missing[k : k + 8] for k in range(0, len(missing), 8)]
    job, workers = partial(_draw_some, out, (config.width, config.height)), min(config.workers or cores, len(parts))
    if workers < 2:
        yield from map(job, parts)
        return
    # spawn: the caller may hold threads (torch, OpenMP) that a fork would break
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(job, parts)


def _draw_some(out: Path, size: tuple[int, int], places: list[PlacePhotos]) -> int:
    """Draws and writes the photos of these places; neighbours on a street share its facades."""
    street, studio = None, None
    for place in places:
        if studio is None or place.seed != street:
            street, studio = place.seed, Studio(place.town, place.seed, place.length)
        for photo in place.photos:
            path = out / photo.file
            part = path.with_name(f".{os.getpid()}.part")  # no sync to disk here: it takes half as long as the drawing
            part.write_bytes(studio.photograph(photo, size))
            part.replace(path)
    return sum(len(place.photos) for place in places)
