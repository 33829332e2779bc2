"""How evaluation sets lie on disk: folders with @utm names, SVOX, pairs, Nordland, traverses of a walk.

Invariant: every function takes the set's folder and returns an `EvaluationSet` whose images come in sorted order; a
layout that is not there raises `DataError` naming the folder and how it should look.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.common.errors import DataError
from pipeline.common.text import shown
from pipeline.config import EvaluationConfig
from pipeline.evaluation.sets.evaluation_set import EvaluationSet, list_images
from pipeline.evaluation.sets.ground_truth import paired, within_frames, within_radius
from pipeline.evaluation.sets.utm import file_position, file_positions, position_remarks

NAMED = "name images @UTM_east@UTM_north@...@.jpg, set frames for sequences without positions, or write a manifest"


def split_folder(folder: Path, split: str, queries: Sequence[str] = ("queries",)) -> Path | None:
    """Where below `folder` database and queries lie: images/<split>, <split>, processed/<split>, or right there."""
    for place in (f"images/{split}", split, f"processed/{split}", "."):
        base = folder / place
        if database_folder(base) is not None and all((base / name).is_dir() for name in queries):
            return base
    return None


def database_folder(base: Path) -> Path | None:
    """The folder of database images in `base`, `database` or SVOX's `gallery`."""
    return next((base / name for name in ("database", "gallery") if (base / name).is_dir()), None)


def from_folders(
    name: str,
    base: Path,
    config: EvaluationConfig,
    queries: Sequence[str] = ("queries",),
    unlabelled: bool = False,
) -> EvaluationSet:
    """A set from `base`/{database,<queries>}: metres where names carry positions, else +- `config.frames`.

    With neither it is refused, or, where `unlabelled`, a set without ground truth: answers are shown, not scored.
    """
    folder = database_folder(base)
    if folder is None:
        raise DataError(f"{base}: expected the folders database (or gallery) and {' and '.join(queries)} here")
    in_database = list_images(folder)
    in_queries = [path for part in queries for path in list_images(base / part)]
    return by_position(name, in_database, in_queries, config, unlabelled)


def by_position(
    name: str, database: list[Path], queries: list[Path], config: EvaluationConfig, unlabelled: bool = False
) -> EvaluationSet:
    """Positives by the positions in file names within `config.radius`; without positions, by `config.frames`."""
    of_database, of_queries = file_positions(database), file_positions(queries)
    if of_database is not None and of_queries is not None:
        ignored = (f"frames={config.frames} does not apply: positions decide",) if config.frames is not None else ()
        return EvaluationSet(
            name,
            database,
            queries,
            within_radius(of_database, of_queries, config.radius),
            f"{config.radius:g} m",
            of_database,
            of_queries,
            remarks=ignored + position_remarks([*database, *queries], np.concatenate([of_database, of_queries])),
        )
    if unlabelled and of_database is None and of_queries is None and config.frames is None:
        empty = [np.zeros(0, np.int64) for _ in queries]
        told = f"no position in the names: answers are shown, not scored; to score them, {NAMED}"
        return EvaluationSet(name, database, queries, empty, "no ground truth", has_ground_truth=False, remarks=(told,))
    if of_database is not None or of_queries is not None or config.frames is None:
        bare = database[0] if of_database is None else queries[0]
        raise DataError(f"{shown(bare)}: no position in this name; {NAMED}")
    return by_frame(name, database, queries, config.frames)


def by_frame(
    name: str, database: list[Path], queries: list[Path], frames: int, stride: int = 1, remarks: tuple[str, ...] = ()
) -> EvaluationSet:
    """Positives are frames: query i is the database's frame `stride` * i, and `frames` to either side are correct."""
    if stride == 1 and len(database) != len(queries):
        raise DataError(
            f"{name}: {len(database):,} database frames ({database[0].parent}) but {len(queries):,} query frames "
            f"({queries[0].parent}); frame i of both must be the same place"
        )
    numbers = stride * np.arange(len(queries))
    return EvaluationSet(
        name, database, queries, within_frames(len(database), numbers, frames), f"+-{frames} frames", remarks=remarks
    )


def pair_folders(folder: Path, split: str) -> tuple[Path, Path] | None:
    """Database and query folders of a set in pairs: new/old, ref/query, or the common ones."""
    base = split_folder(folder, split)
    common = [(base / "database", base / "queries")] if base is not None else []
    for database, queries in (*common, (folder / "new", folder / "old"), (folder / "ref", folder / "query")):
        if database.is_dir() and queries.is_dir():
            return database, queries
    return None


def pairs(name: str, folder: Path, config: EvaluationConfig) -> EvaluationSet:
    """One to one by file name (AmsterTime, SPED): new/old, ref/query, or the common folders."""
    found = pair_folders(folder, config.split)
    if found is None:
        raise DataError(f"{folder}: expected new/ and old/, ref/ and query/, or images/{config.split}/...")
    in_database, in_queries = (list_images(side) for side in found)
    matches = paired([_pair_key(p) for p in in_database], [_pair_key(p) for p in in_queries], str(folder))
    return EvaluationSet(name, in_database, in_queries, matches, "pairs")


def _pair_key(path: Path) -> str:
    """The stem; of an @utm name its made-up position, because the rest of the name may differ between partners."""
    position = file_position(path)
    return path.stem if position is None else f"@{position[0]:.2f}@{position[1]:.2f}"


def nordland_folders(folder: Path, split: str) -> tuple[Path, Path] | None:
    """Nordland's summer and winter: the common folders, summer/winter, or ref/query, where ref is winter."""
    base = split_folder(folder, split)
    common = [(base / "database", base / "queries")] if base is not None else []
    for summer, winter in (*common, (folder / "summer", folder / "winter"), (folder / "query", folder / "ref")):
        if summer.is_dir() and winter.is_dir():
            return summer, winter
    return None


def nordland(name: str, folder: Path, config: EvaluationConfig, frames: int, sparse: bool) -> EvaluationSet:
    """Nordland in its two protocols.

    `**` (`sparse` False): each winter frame is a query, summer is the database, +- 10 frames. `*`: every tenth summer
    frame is a query, winter is the database, +- 1 frame of 10 i.
    """
    found = nordland_folders(folder, config.split)
    if found is None:
        raise DataError(f"{folder}: expected summer/ and winter/, ref/ and query/, or images/{config.split}/...")
    summer, winter = found
    in_summer, in_winter = list_images(summer, natural=True), list_images(winter, natural=True)
    frames = frames if config.frames is None else config.frames
    if not sparse:
        return by_frame(name, in_summer, in_winter, frames)
    if len(in_summer) == len(in_winter):
        in_summer = in_summer[::10]
    if len(in_summer) != (len(in_winter) + 9) // 10:
        raise DataError(
            f"{summer}: {len(in_summer):,} queries for {len(in_winter):,} database frames; in the * protocol "
            "every tenth frame is a query"
        )
    return by_frame(name, in_winter, in_summer, frames, stride=10)


def traverses(name: str, folder: Path, config: EvaluationConfig, route: str, frames: int) -> EvaluationSet:
    """Two traverses of one walk; the `route` "night_right->day_right" looks the first up in the second."""
    asked, _, searched = (part.strip() for part in route.partition("->"))
    for part in (asked, searched):
        if not part or not (folder / part).is_dir():
            known = ", ".join(sorted(p.name for p in folder.iterdir() if p.is_dir())) or "none"
            raise DataError(
                f"{folder / part}: no such traverse; '{route}' goes queries->database, folders here: {known}"
            )
    frames = frames if config.frames is None else config.frames
    return by_frame(
        name, list_images(folder / searched, natural=True), list_images(folder / asked, natural=True), frames
    )
