"""Draws the miniature: all places over all cores, into GSV-Cities' layout and an evaluation folder.

Invariant: a photo appears under its name only when it is whole, so a killed run is continued by the same command;
the bytes depend on the settings alone, not on the number of processes.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

from pipeline.common.errors import DataError, UsageError
from pipeline.common.progress import Progress
from shards.sources.miniature.layout import PlacePhotos, data_frames, plan_photos

FORMAT = 1  # of the pictures: raise it when a change of the drawing changes their bytes


@dataclass(frozen=True)
class MiniatureSummary:
    """What was asked for and what was drawn now.

    Args:
        training: folder in GSV-Cities' layout; evaluation: folder holding `images/{val,test}/{database,queries}`.
        places, images: of the training set; database, queries: photos of each evaluation split.
        drawn: photos drawn by this call; the others were there. seconds: wall time.
    """

    training: Path
    evaluation: Path
    places: int
    images: int
    database: dict[str, int]
    queries: dict[str, int]
    drawn: int
    seconds: float

    def describe(self) -> str:
        """One line for a person."""
        sets = ", ".join(f"{s} {self.database[s]} database + {self.queries[s]} queries" for s in self.database)
        done = f"{self.drawn} drawn in {self.seconds:.1f} s" if self.drawn else "nothing to do"
        return f"{self.places} places with {self.images} photos in {self.training}; {sets} in {self.evaluation}; {done}"


def draw(
    out: Path,
    places: int = 300,
    seed: int = 0,
    size: tuple[int, int] = (320, 240),
    workers: int | None = None,
    val_places: int | None = None,
    test_places: int | None = None,
) -> MiniatureSummary:
    """Draws what is missing of the miniature with these settings.

    Args:
        out: folder that gets `gsv/` and `eval/miniature/`.
        places: training places, spread evenly over the towns.
        seed: of everything.
        size: width and height of a photo in pixels.
        workers: processes; None: one a core. The files are the same with any number.
        val_places, test_places: evaluation places; None: a fifth and a third of `places`.

    Raises:
        UsageError: a count or size that cannot be.
        DataError: `out` holds a miniature of other settings, or cannot be written.
    """
    started = time.monotonic()
    val_places = max(places // 5, 2) if val_places is None else val_places
    test_places = max(places // 3, 2) if test_places is None else test_places
    _check(places, val_places, test_places, size, workers)
    out = Path(out)
    settings = {
        "format": FORMAT, "places": places, "seed": seed, "size": list(size),
        "val_places": val_places, "test_places": test_places,
    }  # fmt: skip
    try:
        _claim(out, settings)
        planned = plan_photos(places, seed, val_places, test_places)
        for folder in {(out / photo.file).parent for place in planned for photo in place.photos}:
            folder.mkdir(parents=True, exist_ok=True)
        missing = _missing(out, planned)
        drawn = sum(len(place.photos) for place in missing)
        _draw_all(out, missing, size, min(workers or _cores(), max(len(missing), 1)))
        for path, text in data_frames(planned).items():  # last: a reader that finds them finds every photo
            if not (out / path).is_file() or (out / path).read_text() != text:
                (out / path).parent.mkdir(parents=True, exist_ok=True)
                write_whole(out / path, text.encode())
    except OSError as error:
        raise DataError(f"{error.filename or out}: the miniature cannot be written there ({error.strerror})") from error
    count = lambda part: sum(part in p.file for place in planned for p in place.photos)  # noqa: E731
    splits = ("val", "test")
    return MiniatureSummary(
        out / "gsv", out / "eval" / "miniature", places, count("gsv/"),
        {s: count(f"/{s}/database/") for s in splits}, {s: count(f"/{s}/queries/") for s in splits},
        drawn, time.monotonic() - started,
    )  # fmt: skip


def _check(places: int, val_places: int, test_places: int, size: tuple[int, int], workers: int | None) -> None:
    if places < 1 or val_places < 0 or test_places < 0:
        raise UsageError(f"places={places}, val_places={val_places}, test_places={test_places}: at least 1, 0 and 0")
    if max(places, val_places, test_places) > 1100:
        raise UsageError(
            f"places={max(places, val_places, test_places)}: the miniature's map has room for 1100 places a split"
        )
    if min(size) < 32 or max(size) > 2048:
        raise UsageError(f"size={size}: a photo's sides must lie between 32 and 2048 pixels")
    if workers is not None and workers < 1:
        raise UsageError(f"workers={workers}: at least one process")


def _claim(out: Path, settings: dict[str, object]) -> None:
    """Writes the settings beside the photos, or refuses a folder drawn with others."""
    note = out / "miniature.json"
    if note.is_file():
        try:
            found = json.loads(note.read_text())
        except ValueError as error:
            raise DataError(f"{note}: not readable ({error}); remove {out} and draw again") from error
        if found != settings:
            other = ", ".join(f"{k} {found.get(k)} there, {v} asked" for k, v in settings.items() if found.get(k) != v)
            raise DataError(f"{out} holds a miniature of other settings ({other}); give another --out or remove it")
        return
    out.mkdir(parents=True, exist_ok=True)
    write_whole(note, (json.dumps(settings, indent=1) + "\n").encode())


def _missing(out: Path, planned: list[PlacePhotos]) -> list[PlacePhotos]:
    """The places with the photos that are not there yet."""
    there = {
        path.as_posix() for top in ("gsv", "eval") for path in (out / top).rglob("*") if path.suffix.lower() == ".jpg"
    }
    left = []
    for place in planned:
        photos = tuple(p for p in place.photos if (out / p.file).as_posix() not in there)
        if photos:
            left.append(PlacePhotos(place.town, place.seed, photos))
    return left


def _draw_all(out: Path, missing: list[PlacePhotos], size: tuple[int, int], workers: int) -> None:
    if not missing:
        return
    with Progress("drawing the miniature", sum(len(p.photos) for p in missing), "photos") as progress:
        for done in _run(out, missing, size, workers):
            progress.advance(done)


def _run(out: Path, missing: list[PlacePhotos], size: tuple[int, int], workers: int) -> Iterator[int]:
    if workers == 1:
        for place in missing:
            yield draw_place(out, place, size)
        return
    # spawn: the caller may hold threads (torch, OpenMP) that a fork would break
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        futures = [pool.submit(_draw_some, out, missing[k : k + 8], size) for k in range(0, len(missing), 8)]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _draw_some(out: Path, places: list[PlacePhotos], size: tuple[int, int]) -> int:
    return sum(draw_place(out, place, size) for place in places)


def draw_place(out: Path, place: PlacePhotos, size: tuple[int, int]) -> int:
    """Draws and writes the photos of one place; returns how many."""
    from shards.sources.miniature.picture import Studio

    studio = Studio(place.town, place.seed)
    for photo in place.photos:
        write_whole(out / photo.file, studio.photograph(photo, size))
    return len(place.photos)


def write_whole(path: Path, content: bytes) -> None:
    """Writes under a temporary name, then renames: the name never shows half a file."""
    temporary = path.with_name(f".{os.getpid()}.{path.name[-40:]}.part")
    temporary.write_bytes(content)
    temporary.replace(path)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
