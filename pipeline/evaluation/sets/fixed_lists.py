"""Sets given as fixed `.npy` lists, under the names of two tools: GSV-Cities' and OpenVPRLab's.

`<set>_dbImages.npy` with `<set>_qImages.npy`, or `<set>_ref_image_names.npy` with `<set>_query_image_names.npy`; and
the ground truth as `<set>_gt.npy`, `<set>_gt_25m.npy`, `<set>_ground_truth_25m.npy`, or `<set>_qIdx.npy` with
`<set>_pIdx.npy`.
Invariant: images and queries keep the order of the lists, which is the order their positives count in; a list that
names a photo which is not on disk raises `DataError`, it is never shortened; a name in a list is a plain relative path.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from pipeline.common.errors import DataError, UsageError
from pipeline.common.text import shown
from pipeline.config import EvaluationConfig
from pipeline.evaluation.sets.evaluation_set import EvaluationSet, clean_name
from pipeline.evaluation.sets.npy_lists import read_indices, read_ragged, read_strings

QUERIES_OF = {"dbImages": "qImages", "ref_image_names": "query_image_names"}  # list of the database -> of the queries
RADIUS = r"(?:_(?P<radius>\d+(?:\.\d+)?)m)?"
TRUTH = re.compile(rf"(?:gt|ground_truth){RADIUS}")
LISTED = re.compile(
    rf"(?P<prefix>.+?)_(?:{'|'.join([*QUERIES_OF, *QUERIES_OF.values()])}|[pq]Idx|{TRUTH.pattern})\.npy"
)
SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class Lists:
    """The files of one set's lists: `<folder>/<prefix>_<database>.npy` and the others beside it."""

    folder: Path
    prefix: str
    database: str
    """A key of `QUERIES_OF`."""

    def file(self, what: str) -> Path:
        """The file of one list."""
        return self.folder / f"{self.prefix}_{what}.npy"

    @property
    def split(self) -> str:
        """The split that the prefix names at its end; else empty."""
        last = self.prefix.rpartition("_")[2]
        return last if last in SPLITS else ""


def find_lists(path: Path, split: str) -> Lists | None:
    """The lists at `path`, a folder or one of the files; None when there are none.

    Raises `UsageError` when a folder holds the lists of several sets and `split` does not tell them apart.
    """
    folder, wanted = path, ""
    if path.is_file():
        named = LISTED.fullmatch(path.name)
        if named is None:
            return None
        folder, wanted = path.parent, named["prefix"]
    found = [
        Lists(folder, file.name.removesuffix(f"_{database}.npy"), database)
        for database in QUERIES_OF
        for file in sorted(folder.glob(f"*_{database}.npy"))
        if not file.name.startswith(".")
    ]
    if wanted:
        return next((lists for lists in found if lists.prefix == wanted), None)
    if len(found) > 1:
        of_split = [lists for lists in found if lists.split == split]
        if len(of_split) != 1:
            names = ", ".join(shown(lists.file(lists.database).name) for lists in found)
            raise UsageError(f"{path}: holds the lists of several sets; give one file instead: {names}")
        found = of_split
    return found[0] if found else None


def photos_there(lists: Lists, root: str) -> bool:
    """Whether the first photo of the list is on disk."""
    names = _names(lists.file(lists.database))
    return bool(names) and _folder_of(lists, names[0], root) is not None


def from_lists(lists: Lists, config: EvaluationConfig) -> EvaluationSet:
    """The set of the lists; photos are looked for beside the lists, one folder up, or below the root."""
    database_file, queries_file = lists.file(lists.database), lists.file(QUERIES_OF[lists.database])
    database, queries = _names(database_file), _names(queries_file)
    remarks: tuple[str, ...] = ()
    rule = "listed positives"
    truth, radius = _truth(lists, config.radius)
    if truth is not None:
        positives = read_ragged(truth)
        if radius is not None:
            rule = f"{radius:g} m"
            if radius != config.radius:
                remarks = (
                    f"radius={config.radius:g} does not apply: {truth.name} lists what lies within {radius:g} m",
                )
    elif lists.file("pIdx").exists() and lists.file("qIdx").exists():
        positives = read_ragged(lists.file("pIdx"))
        kept = read_indices(lists.file("qIdx"))
        if len(kept) and not 0 <= kept.min() <= kept.max() < len(queries):
            raise DataError(f"{lists.file('qIdx')}: names query {kept.max()}, the list has {len(queries):,}")
        if len(kept) < len(queries):
            used = f"{len(kept):,} of the {len(queries):,} listed queries are used, those in {lists.prefix}_qIdx.npy"
            remarks = (used,)
        queries = [queries[row] for row in kept]
    else:
        raise DataError(
            f"{lists.file('gt')}: no ground truth; expected it, or {lists.prefix}_gt_25m.npy, or "
            f"{lists.prefix}_qIdx.npy and _pIdx.npy"
        )
    if not database:
        raise DataError(f"{database_file}: names no photo")
    root = _folder_of(lists, database[0], config.root)
    if root is None:
        usual = ", ".join(dict.fromkeys(map(str, _usual_folders(lists, config.root))))
        raise DataError(f"{database_file}: '{shown(database[0])}' is in none of {usual}")
    return EvaluationSet(
        clean_name(lists.prefix),
        existing([root / name for name in database], str(database_file)),
        existing([root / name for name in queries], str(queries_file)),
        positives,
        rule,
        remarks=remarks,
    )


def existing(paths: Sequence[Path], where: str) -> list[Path]:
    """`paths`, all of them on disk; else `DataError` with their number and the first, `where` being what named them."""
    missing = [path for path in paths if not _is_there(path)]
    if missing:
        raise DataError(
            f"{where}: {len(missing):,} of {len(paths):,} photos are not on disk, the first is {shown(missing[0])}"
        )
    return list(paths)


def _is_there(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # a name too long for the disk, or with a NUL character
        return False


def _names(file: Path) -> list[str]:
    """The photos of a list. Raises `DataError` for a name that leads out of the photos' folder."""
    names = read_strings(file)
    for name in names:
        path = PurePosixPath(name)
        if not name or path.is_absolute() or ".." in path.parts or "\0" in name:
            raise DataError(f"{file}: '{shown(name)}' is no plain path relative to the photos' folder")
    return names


def _truth(lists: Lists, radius: float) -> tuple[Path | None, float | None]:
    """The file of positives, and the radius that its name tells; (None, None) where there is none.

    Of several, the one of `radius`; `UsageError` where none is.
    """
    found: dict[Path, float | None] = {}
    for file in sorted(lists.folder.glob(f"{_literal(lists.prefix)}_*.npy")):
        told = TRUTH.fullmatch(file.stem.removeprefix(f"{lists.prefix}_"))
        if told is not None:
            found[file] = None if told["radius"] is None else float(told["radius"])
    if len(found) > 1:
        of_radius: dict[Path, float | None] = {file: of for file, of in found.items() if of == radius}
        if len(of_radius) != 1:
            names = ", ".join(file.name for file in found)
            raise UsageError(
                f"{lists.folder}: {names} are several ground truths, none of radius {radius:g}; set radius"
            )
        found = of_radius
    return next(iter(found.items()), (None, None))


def _literal(text: str) -> str:
    """Text without meaning in a glob pattern."""
    return re.sub(r"([*?[])", r"[\1]", text)


def _usual_folders(lists: Lists, root: str) -> list[Path]:
    """The folders that listed names may be relative to."""
    below = Path(root).expanduser()
    short = lists.prefix.partition("_")[0]
    named = (below / name for name in (lists.prefix, lists.prefix.lower(), short, short.lower()))
    return [lists.folder, lists.folder.parent, *named, below]


def _folder_of(lists: Lists, first: str, root: str) -> Path | None:
    return next((folder for folder in _usual_folders(lists, root) if _is_there(folder / first)), None)
