"""Evaluation sets by name or path: `load_set("tokyo247", config)`, `load_set("/photos/my_city", config)`.

Invariant: what comes back depends on the folder's contents and the configuration alone, in an order that is always
the same; a set that is missing or malformed raises `DataError` naming the folder expected and how it should look.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.common.errors import DataError, UsageError
from pipeline.common.text import shown
from pipeline.config import EvaluationConfig
from pipeline.evaluation.sets import layouts, msls
from pipeline.evaluation.sets.evaluation_set import EvaluationSet, check_names, clean_name, list_images
from pipeline.evaluation.sets.fixed_lists import SPLITS, Lists, find_lists, from_lists, photos_there
from pipeline.evaluation.sets.manifest import SUFFIXES, from_manifest, manifest_in
from pipeline.evaluation.sets.registry import SETS, count_remark, key, published_name

__all__ = ["Availability", "EvaluationSet", "available", "list_images", "load_set", "load_sets"]

DEFAULT_ROUTE = "night_right->day_right"
TABLES = (".npy", ".npz", ".mat", ".csv", ".parquet")  # files that may say what is correct


def load_set(name_or_path: str, config: EvaluationConfig) -> EvaluationSet:
    """The evaluation set `name_or_path`.

    A name of `registry.SETS`, however it is written (`Tokyo24/7`, `svox-night`, `nordland**`), is looked up below
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
            raise DataError(_missing(name, config.root, config.split))
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
            f"{shown(text)}: neither a path, nor a folder below root '{config.root}', nor one of the sets "
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
            told = str(error)  # most name the set already
            left_out.append(told if told.startswith(name) else f"{name}: {told}")
    if not sets:
        raise DataError("; ".join(left_out) or f"no evaluation set under {config.root}/: give --sets or --root")
    return sets, left_out


def sets_there(names: Sequence[str], config: EvaluationConfig) -> tuple[dict[str, EvaluationSet], list[str]]:
    """(Name as given -> the set, of those that are there; a line for each that is not).

    Raises:
        UsageError: two sets of one name.
    """
    sets, missing = {}, []
    for name in names:
        try:
            sets[name] = load_set(name, config)
        except (DataError, UsageError) as error:
            missing.append(str(error))
    check_names(sets.values())
    return sets, missing


def _load_published(name: str, folder: Path, config: EvaluationConfig, route: str) -> EvaluationSet:
    entry = SETS[name]
    loaded: EvaluationSet
    lists = _published_lists(name, folder, config.split)
    if lists is not None and (entry.layout != "msls_val" or photos_there(lists, config.root)):
        loaded = dataclasses.replace(from_lists(lists, config), name=name)
    elif entry.layout in ("utm", "svox"):
        base = layouts.split_folder(folder, config.split, entry.queries)
        if base is None:
            raise DataError(_missing(name, config.root, config.split, folder))
        loaded = _unread(layouts.from_folders(name, base, config, entry.queries), folder, base)
    elif entry.layout == "pairs":
        loaded = _unread(layouts.pairs(name, folder, config), folder)
    elif entry.layout == "nordland":
        loaded = layouts.nordland(name, folder, config, entry.frames, sparse=name == "nordland_star")
        loaded = _unread(loaded, folder)
    elif entry.layout == "gardens_point":
        title = clean_name(f"{name}_{route}".replace("->", "_in_")) if route else name
        loaded = layouts.traverses(title, folder, config, route or DEFAULT_ROUTE, entry.frames)
    elif entry.layout == "msls_val":
        loaded = msls.val(name, folder, config)
    else:
        loaded = msls.challenge(name, folder, config)
    return _remarked(loaded, name, config.split)


def _published_lists(name: str, folder: Path, split: str) -> Lists | None:
    """The fixed lists of a published set in its folder, where one list can stand for the set; None where none lie."""
    entry = SETS[name]
    if entry.layout not in ("utm", "pairs", "msls_val") or entry.queries != ("queries",):
        return None  # lists of Nordland are one of its two protocols, those of SVOX one of its conditions
    try:
        lists = find_lists(folder, split)
    except UsageError:
        return None
    if lists is None:
        return None
    named = {published_name(lists.prefix), published_name(lists.prefix.removesuffix(f"_{split}"))}
    return lists if name in named else None


def _lists_that_decide(folder: Path, config: EvaluationConfig) -> Lists | None:
    """The fixed lists in a folder that say what its set is, also where it holds database/ and queries/ as well.

    Lists of another split than the one whose folders are there do not, nor, beside Mapillary's own tables, do lists
    whose photos are not on disk.
    """
    base = layouts.split_folder(folder, config.split)
    of_split = base is not None and base != folder
    try:
        lists = find_lists(folder, config.split)
    except UsageError:
        if of_split:
            return None
        raise
    if lists is None or (of_split and lists.split not in ("", config.split)):
        return None
    return None if msls.original_cities(folder) and not photos_there(lists, config.root) else lists


def _remarked(loaded: EvaluationSet, name: str | None, split: str) -> EvaluationSet:
    """With a remark where its counts are not the published ones."""
    remark = count_remark(name, split, len(loaded.database), len(loaded.queries)) if name else None
    return dataclasses.replace(loaded, remarks=(*loaded.remarks, remark)) if remark else loaded


def _load_path(path: Path, config: EvaluationConfig, route: str) -> EvaluationSet:
    """A set by what lies at `path`. In a folder, fixed lists decide, then a manifest, then the layout."""
    name = _path_name(path)
    if path.is_file():
        if path.suffix.lower() in SUFFIXES:
            return from_manifest(path, config)
        lists = find_lists(path, config.split)
    else:
        if route or (path / "day_left").is_dir():
            title = clean_name(f"{name}_{route}".replace("->", "_in_")) if route else name
            return layouts.traverses(title, path, config, route or DEFAULT_ROUTE, SETS["gardens_point"].frames)
        lists = _lists_that_decide(path, config)
    if lists is not None:
        return from_lists(lists, config)
    if path.is_dir():
        manifest = manifest_in(path)
        if manifest is not None:
            return dataclasses.replace(from_manifest(manifest, config), name=name)
        base = layouts.split_folder(path, config.split)
        if base is not None:
            return _unread(layouts.from_folders(name, base, config, unlabelled=True), path, base)
        if msls.original_cities(path):
            return msls.val("msls_val", path, config)
        if msls.challenge_cities(path):
            return msls.challenge("msls_challenge", path, config)
        if layouts.pair_folders(path, config.split) is not None:
            return _unread(layouts.pairs(name, path, config), path)
    raise DataError(
        f"{shown(path)}: no evaluation set here; expected images/{config.split}/{{database,queries}}, database/ and "
        f"queries/, a .csv or .parquet manifest, or *_dbImages.npy with *_qImages.npy; {_contents(path)}"
    )


def _unread(loaded: EvaluationSet, *folders: Path) -> EvaluationSet:
    """With a remark that names tables and lists beside the photos that were not read."""
    left = [file.name for folder in dict.fromkeys(folders) for file in sorted(folder.iterdir())
            if file.suffix.lower() in TABLES and not file.name.startswith(".")]  # fmt: skip
    if not left:
        return loaded
    more = f" and {len(left) - 5} more" if len(left) > 5 else ""
    return dataclasses.replace(
        loaded, remarks=(*loaded.remarks, f"not read: {', '.join(map(shown, left[:5]))}{more}; the folders decide")
    )


def _contents(path: Path) -> str:
    """What lies at a path, in a few words."""
    if not path.is_dir():
        return "this is a file"
    names = sorted(entry.name + ("/" if entry.is_dir() else "") for entry in path.iterdir())
    more = f" and {len(names) - 6} more" if len(names) > 6 else ""
    return f"it holds {', '.join(map(shown, names[:6]))}{more}" if names else "it is empty"


def _path_name(path: Path) -> str:
    """The dataset's folder: .../miniature for .../miniature/images/val as well."""
    # not resolve(): a symbolic link has a name of its own
    whole = Path(os.path.abspath(path))  # noqa: PTH100
    named = whole.with_suffix("") if whole.is_file() else whole
    parts = [part for part in named.parts if part not in ("images", "processed", *SPLITS)]
    return clean_name(parts[-1] if parts else "set")


def _find(root: str, name: str, split: str) -> Path | None:
    """The folder below `root` where the set lies, in any case and however joined (`msls-val`, `pitts30k-val`).

    Of several the first that holds the set; else the first that has one of its names.
    """
    below = Path(root).expanduser()
    present: dict[str, Path] = {}
    for folder in sorted(below.iterdir()) if below.is_dir() else ():
        if folder.is_dir():
            present.setdefault(key(folder.name), folder)
    names = [alias + end for end in ("", split) for alias in map(key, SETS[name].folders)]
    named = [present[alias] for alias in names if alias in present]
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
    return looks[entry.layout]() is not None or _published_lists(name, folder, split) is not None


def _missing(name: str, root: str, split: str, folder: Path | None = None) -> str:
    expected = folder or Path(root) / SETS[name].folders[0]
    looks = SETS[name].looks.replace("{split}", split)
    return f"{name} is not there: expected {expected}/ with {looks}" + (f"; {_contents(folder)}" if folder else "")


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
    known: set[Path | None] = set()
    for name in SETS:
        there = _find(root, name, split)
        known.add(there)
        folder = there if there is not None and _is_there(name, there, split) else None
        found.append(Availability(name, folder, _missing(name, root, split).partition("expected ")[2]))
    for folder in sorted(below.iterdir()) if below.is_dir() else []:
        if folder.is_dir() and folder not in known and layouts.split_folder(folder, split) is not None:
            found.append(Availability(folder.name, folder, str(folder)))
    return found
