"""Sets given as fixed `.npy` lists: `<set>_dbImages.npy`, `<set>_qImages.npy` and `<set>_gt.npy` (or `qIdx`, `pIdx`).

Invariant: images and queries keep the order of the lists, which is the order their positives count in; a list that
names a photo which is not on disk raises `DataError`, it is never shortened.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline.common.errors import DataError, UsageError
from pipeline.config import EvaluationConfig
from pipeline.evaluation.sets.evaluation_set import EvaluationSet, clean_name
from pipeline.evaluation.sets.npy_lists import read_indices, read_ragged, read_strings

SUFFIX = "_dbImages.npy"


def list_prefix(path: Path, split: str) -> Path | None:
    """`<folder>/<set>` of the lists at `path`, a folder or one of the files; None when there are none.

    Raises `UsageError` when a folder holds the lists of several sets and `split` does not tell them apart.
    """
    if path.is_file():
        stem = path.name.rpartition("_")[0]
        return path.parent / stem if stem and (path.parent / f"{stem}{SUFFIX}").exists() else None
    prefixes = sorted(p.name.removesuffix(SUFFIX) for p in path.glob(f"*{SUFFIX}"))
    if len(prefixes) > 1:
        of_split = [prefix for prefix in prefixes if prefix.endswith(f"_{split}")]
        if len(of_split) != 1:
            raise UsageError(
                f"{path}: holds the lists of {', '.join(prefixes)}; name one file, as {prefixes[0]}{SUFFIX}"
            )
        prefixes = of_split
    return path / prefixes[0] if prefixes else None


def from_lists(prefix: Path, config: EvaluationConfig) -> EvaluationSet:
    """The set of the lists `prefix`_*.npy; photos are looked for beside the lists, one folder up, or below the root."""
    database = read_strings(_beside(prefix, "dbImages"))
    queries = read_strings(_beside(prefix, "qImages"))
    remarks: tuple[str, ...] = ()
    if _beside(prefix, "gt").exists():
        positives = read_ragged(_beside(prefix, "gt"))
    elif _beside(prefix, "pIdx").exists() and _beside(prefix, "qIdx").exists():
        positives = read_ragged(_beside(prefix, "pIdx"))
        kept = read_indices(_beside(prefix, "qIdx"))
        if len(kept) and not 0 <= kept.min() <= kept.max() < len(queries):
            raise DataError(f"{prefix}_qIdx.npy: names query {kept.max()}, the list has {len(queries):,}")
        if len(kept) < len(queries):
            remarks = (
                f"{len(kept):,} of the {len(queries):,} listed queries are used, those in {prefix.name}_qIdx.npy",
            )
        queries = [queries[row] for row in kept]
    else:
        raise DataError(f"{prefix}_gt.npy: no ground truth; expected it, or {prefix.name}_qIdx.npy and _pIdx.npy")
    root = _photos(prefix, database[0] if database else "", config.root)
    return EvaluationSet(
        clean_name(prefix.name),
        existing([root / name for name in database], f"{prefix}{SUFFIX}"),
        existing([root / name for name in queries], f"{prefix}_qImages.npy"),
        positives,
        "listed positives",
        remarks=remarks,
    )


def existing(paths: Sequence[Path], where: str) -> list[Path]:
    """`paths`, all of them on disk; else `DataError` with their number and the first, `where` being what named them."""
    missing = [path for path in paths if not path.exists()]
    if missing:
        raise DataError(
            f"{where}: {len(missing):,} of {len(paths):,} photos are not on disk, the first is {missing[0]}"
        )
    return list(paths)


def _beside(prefix: Path, what: str) -> Path:
    return prefix.parent / f"{prefix.name}_{what}.npy"


def _photos(prefix: Path, first: str, root: str) -> Path:
    """The folder the listed names are relative to: the first of the usual ones that holds the first photo."""
    below = Path(root).expanduser()
    short = prefix.name.partition("_")[0]
    named = (below / name for name in (prefix.name, prefix.name.lower(), short, short.lower()))
    usual = [prefix.parent, prefix.parent.parent, *named, below]
    for folder in usual:
        if (folder / first).exists():
            return folder
    raise DataError(f"{prefix}{SUFFIX}: '{first}' is in none of {', '.join(dict.fromkeys(map(str, usual)))}")
