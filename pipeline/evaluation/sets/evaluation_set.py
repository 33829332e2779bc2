"""An evaluation set: database and query images in a fixed order, and which database images are correct for a query.

Invariant: an `EvaluationSet` is complete and consistent once built: as many positives as queries, every positive a
row of the database, all files listed in the order in which groups are formed. Nothing here opens an image.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

import numpy as np

from pipeline.common.errors import DataError, UsageError
from pipeline.common.text import shown
from shards.sources.listing import walk

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png"})


@dataclass(frozen=True)
class EvaluationSet:
    """What is searched (N database images) for what (Q queries), and what counts as found."""

    name: str
    """Letters, digits, `_`, `-` and `.` only, so that it can be part of a metric's name."""
    database: list[Path]
    """N images, in the order in which ordered groups are formed."""
    queries: list[Path]
    """Q images, likewise."""
    positives: list[np.ndarray]
    """Q sorted int64 arrays of database rows."""
    rule: str
    """What makes a positive: `25 m`, `+-10 frames`, `pairs`."""
    database_positions: np.ndarray | None = None
    """UTM east and north in metres, float64 [N, 2]; None where the set has none."""
    query_positions: np.ndarray | None = None
    """The same of the queries [Q, 2]."""
    database_part: np.ndarray | None = None
    """Where retrieval stays within a part of the set (MSLS-challenge: a city): the part of each image, int64 [N]."""
    query_part: np.ndarray | None = None
    """The part of each query, int64 [Q]."""
    has_ground_truth: bool = True
    """False where positives are unknown: the set can be predicted and exported, not scored."""
    remarks: tuple[str, ...] = field(default=())
    """What a reader of the recall should know: counts that differ from the published ones, say."""

    def __post_init__(self) -> None:
        if not self.database or not self.queries:
            empty = "database" if not self.database else "queries"
            raise DataError(f"{self.name}: the set has no {empty}; nothing can be evaluated")
        if len(self.positives) != len(self.queries):
            raise DataError(f"{self.name}: {len(self.queries):,} queries but positives of {len(self.positives):,}")
        highest = max((int(p.max()) for p in self.positives if len(p)), default=0)
        lowest = min((int(p.min()) for p in self.positives if len(p)), default=0)
        if highest >= len(self.database) or lowest < 0:
            raise DataError(
                f"{self.name}: a positive names row {highest}, the database has {len(self.database):,} images"
            )

    @property
    def without_positives(self) -> int:
        """How many queries have no correct database image at all."""
        return sum(len(p) == 0 for p in self.positives)


def list_images(folder: Path, natural: bool = False) -> list[Path]:
    """All images below `folder` (jpg, jpeg, png in any case), sorted by path as the field does.

    `natural` sorts runs of digits by value, for sequences whose numbers are not zero-padded. Hidden files and
    debris are skipped, linked folders followed, each once. Raises `DataError` when there are none, or a folder cannot
    be read.
    """
    found = [
        Path(parent, name)
        for parent, names in walk(folder, _unreadable)
        for name in names
        if Path(name).suffix.lower() in IMAGE_SUFFIXES
    ]
    if not found:
        raise DataError(f"{folder}: no jpg, jpeg or png image in this folder or below it")
    return sorted(found, key=_natural if natural else str)


def _unreadable(error: OSError) -> NoReturn:
    raise DataError(f"{shown(error.filename)}: cannot be read ({error.strerror}); give yourself permission to read it")


def _natural(path: Path) -> list[tuple[int, str]]:
    return [(int(run), "") if run.isdigit() else (-1, run) for run in re.split(r"(\d+)", str(path))]


def check_names(sets: Iterable[EvaluationSet]) -> None:
    """Refuses two sets of one name: recalls, predictions and metrics are known by it, so they would mix.

    Raises:
        UsageError: with the name and the folders.
    """
    seen: dict[str, EvaluationSet] = {}
    for one in sets:
        other = seen.setdefault(one.name, one)
        if other is not one:
            folders = " and ".join(shown(s.database[0].parent) for s in (other, one))
            raise UsageError(
                f"two sets are called '{one.name}' ({folders}): their results would have one name; evaluate one "
                "of them under another folder name, for example through a symbolic link"
            )


def clean_name(text: str) -> str:
    """A name that metric names and file names accept: every other character becomes `_`."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", text).strip("_") or "set"
