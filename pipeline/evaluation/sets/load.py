"""Evaluation sets by name or path: `load_set("tokyo247", config)`, `load_set("/photos/my_city", config)`.

Invariant: what comes back depends on the folder's contents and the configuration alone, in an order that is always
the same; a set that is missing or malformed raises `DataError` naming the folder expected and how it should look.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.common.errors import DataError, UsageError
from pipeline.config import EvaluationConfig
from pipeline.evaluation.sets import layouts, msls
from pipeline.evaluation.sets.evaluation_set import EvaluationSet, clean_name, list_images
from pipeline.evaluation.sets.fixed_lists import from_lists, list_prefix
from pipeline.evaluation.sets.manifest import SUFFIXES, from_manifest
from pipeline.evaluation.sets.registry import SETS, count_remark, published_name

__all__ = ["Availability", "EvaluationSet", "available", "list_images", "load_set", "load_sets"]

DEFAULT_ROUTE = "night_right->day_right"
SPLITS = ("train", "val", "test")


def load_set(name_or_path: str, config: EvaluationConfig) -> EvaluationSet:
    """The evaluation set `name_or_path`.

    A name of `published.SETS`, however it is written (`Tokyo24/7`, `svox-night`, `nordland**`), is looked up below
    `config.root`. A path may be a folder in any layout (the dataset's or the one holding database/ and queries/), a
    CSV or Parquet manifest, or the folder or a file of fixed `.npy` lists. `gardens_point:day_right->night_right`
    (queries->database) chooses the traverses of a walk. Raises `DataError` for what is missing or malformed,
    `UsageError` for a name that is ambiguous.
    """
    text, route = str(name_or_path), ""
    if "->" in text and ":" in text:
        text, _, route = text.rpartition(":")
    name = published_name(text)
    if name is not None:
        folder = _find(config.root, name, config.split)
        if folder is None:
            raise DataError(_missing(name, config.root))
        return _load_published(name, folder, config, route)
    path = Path(text).expanduser()
    if not path.exists():
        path = Path(config.root).expanduser() / text
    if text.lower() == "nordland":
        raise UsageError(
            "nordland has two protocols: say nordland* (2,760 queries, +-1 frame) or nordland** (+-10 frames)"
        )
    if not path.exists():
        raise DataError(
            f"{text}: neither a path, nor a folder below root '{config.root}', nor one of the sets "
            f"{', '.join(sorted(SETS))}"
        )
    loaded = _load_path(path, config, route)
    # a folder called as a published set is compared with it: MSLS with 11,000 queries is not MSLS-val
    return _remarked(loaded, published_name(loaded.name), config.split)


def load_sets(names: Sequence[str], config: EvaluationConfig) -> tuple[list[EvaluationSet], list[str]]:
    """(The sets that are there, a line for each that is not). Raises `DataError` where none is."""
    sets, left_out = [], []
    for name in names:
        try:
            sets.append(load_set(name, config))
        except (DataError, UsageError) as error:
            left_out.append(f"{name}: {error}")
    if not sets:
        raise DataError("; ".join(left_out) or f"no evaluation set under {config.root}/: give --sets or --root")
    return sets, left_out


def _load_published(name: str, folder: Path, config: EvaluationConfig, route: str) -> EvaluationSet:
    entry = SETS[name]
    loaded: EvaluationSet
    if entry.layout in ("utm", "svox"):
        base = layouts.split_folder(folder, config.split, entry.queries)
        if base is None:
            raise DataError(_missing(name, config.root, folder))
        loaded = layouts.from_folders(name, base, config, entry.queries)
    elif entry.layout == "pairs":
        loaded = layouts.pairs(name, folder, config)
    elif entry.layout == "nordland":
        loaded = layouts.nordland(name, folder, config, entry.frames, sparse=name == "nordland_star")
    elif entry.layout == "gardens_point":
        title = clean_name(f"{name}_{route}".replace("->", "_in_")) if route else name
        loaded = layouts.traverses(title, folder, config, route or DEFAULT_ROUTE, entry.frames)
    elif entry.layout == "msls_val":
        loaded = msls.val(name, folder, config)
    else:
        loaded = msls.challenge(name, folder, config)
    return _remarked(loaded, name, config.split)


def _remarked(loaded: EvaluationSet, name: str | None, split: str) -> EvaluationSet:
    """With a remark where its counts are not the published ones."""
    remark = count_remark(name, split, len(loaded.database), len(loaded.queries)) if name else None
    return dataclasses.replace(loaded, remarks=(*loaded.remarks, remark)) if remark else loaded


def _load_path(path: Path, config: EvaluationConfig, route: str) -> EvaluationSet:
    """A set by what lies at `path`."""
    name = _path_name(path)
    if path.is_dir():
        if route or (path / "day_left").is_dir():
            title = clean_name(f"{name}_{route}".replace("->", "_in_")) if route else name
            return layouts.traverses(title, path, config, route or DEFAULT_ROUTE, SETS["gardens_point"].frames)
        base = layouts.split_folder(path, config.split)
        if base is not None:
            return layouts.from_folders(name, base, config)
        if msls.original_cities(path):
            return msls.val("msls_val", path, config)
        if msls.challenge_cities(path):
            return msls.challenge("msls_challenge", path, config)
        if layouts.pair_folders(path, config.split) is not None:
            return layouts.pairs(name, path, config)
    elif path.suffix.lower() in SUFFIXES:
        return from_manifest(path, config)
    prefix = list_prefix(path, config.split)
    if prefix is not None:
        return from_lists(prefix, config)
    raise DataError(
        f"{path}: no evaluation set here; expected images/{config.split}/{{database,queries}}, database/ and queries/, "
        "a .csv or .parquet manifest, or *_dbImages.npy with *_qImages.npy"
    )


def _path_name(path: Path) -> str:
    """The dataset's folder: .../miniature for .../miniature/images/val as well."""
    whole = path.resolve()
    named = whole.with_suffix("") if whole.is_file() else whole
    parts = [part for part in named.parts if part not in ("images", "processed", *SPLITS)]
    return clean_name(parts[-1] if parts else "set")


def _find(root: str, name: str, split: str) -> Path | None:
    """The folder below `root`, in any case, where the set lies; else the first that has one of its names."""
    below = Path(root).expanduser()
    present = {p.name.lower(): p for p in sorted(below.iterdir()) if p.is_dir()} if below.is_dir() else {}
    named = [present[alias.lower()] for alias in SETS[name].folders if alias.lower() in present]
    return next((folder for folder in named if _is_there(name, folder, split)), named[0] if named else None)


def _is_there(name: str, folder: Path, split: str) -> bool:
    """Whether `folder` has the set's layout; looks at folders only."""
    entry = SETS[name]
    looks: dict[str, Callable[[], object]] = {
        "utm": lambda: layouts.split_folder(folder, split, entry.queries),
        "svox": lambda: layouts.split_folder(folder, split, entry.queries),
        "pairs": lambda: layouts.pair_folders(folder, split),
        "nordland": lambda: layouts.nordland_folders(folder, split),
        "gardens_point": lambda: (folder / "day_right").is_dir() or None,
        "msls_val": lambda: msls.original_cities(folder) or msls.utm_base(folder),
        "msls_challenge": lambda: msls.challenge_cities(folder) or None,
    }
    return looks[entry.layout]() is not None


def _missing(name: str, root: str, folder: Path | None = None) -> str:
    expected = folder or Path(root) / SETS[name].folders[0]
    return f"{name} is not there: expected {expected}/ with {SETS[name].looks}"


@dataclass(frozen=True)
class Availability:
    """Whether a set is on disk."""

    name: str
    """Its name, as `load_set` takes it."""
    folder: Path | None
    """Its folder, None when it is missing."""
    expected: str
    """Where it is looked for and how it should look."""


def available(root: str, split: str = "test") -> list[Availability]:
    """All published sets and every other folder with database and queries below `root`, present or missing."""
    below = Path(root).expanduser()
    found = []
    known: set[str] = set()
    for name, entry in SETS.items():
        folder = _find(root, name, split)
        if folder is not None and not _is_there(name, folder, split):
            folder = None
        known |= {alias.lower() for alias in entry.folders}
        found.append(Availability(name, folder, _missing(name, root).partition("expected ")[2]))
    for folder in sorted(below.iterdir()) if below.is_dir() else []:
        if folder.is_dir() and folder.name.lower() not in known and layouts.split_folder(folder, split) is not None:
            found.append(Availability(folder.name, folder, str(folder)))
    return found
