"""Opens a source folder, whichever of the known layouts it has.

Invariant: the layout found is a function of the folder's content, and is told to the user and kept in the manifest. A
folder that is part of a known layout is never read as something else.
"""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pipeline.common.errors import DataError, UsageError
from pipeline.common.text import shown
from shards.catalogue import Catalogue
from shards.sources import gsv_cities, msls, street_view
from shards.sources.listing import names_in

Kind = Literal["auto", "gsv_cities", "msls", "folders", "utm"]
CELLS = {"utm": (10.0, 30.0), "msls": (25.0, 60.0)}  # metres of a cell, degrees of a sector
_LOOKED_AT = 200  # pictures whose names are looked at
_LOOKED_BELOW = 50  # a source with more folders holds places, not data sets
_SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class SourceRule:
    """How a source is read."""

    kind: Kind = "auto"
    cities: tuple[str, ...] = ()  # gsv_cities, msls: cities to keep; none keeps all (msls: all but its validation)
    cell_m: float | None = None  # utm, msls: side of a place's cell in metres; None: 10, 25
    heading_deg: float | None = None  # utm, msls: width of a sector in degrees; None: 30, 60; 0 ignores headings

    def cells(self, kind: str) -> tuple[float, float]:
        """Side of a cell in metres and width of a sector in degrees of a layout.

        Raises:
            UsageError: one out of range.
        """
        cell_m, heading_deg = CELLS[kind]
        cell_m = cell_m if self.cell_m is None else self.cell_m
        heading_deg = heading_deg if self.heading_deg is None else self.heading_deg
        if not 0.01 <= cell_m <= 1e6 or not 0 <= heading_deg <= 360:
            raise UsageError(f"--cell_m {cell_m}: give 0.01 to 1,000,000; --heading_deg {heading_deg}: give 0 to 360")
        return cell_m, heading_deg


def locate(root: Path) -> tuple[Path, Kind]:
    """The folder to read, `root` or the only one directly below it that has a known layout, and its layout.

    gsv_cities where Dataframes/ and Images/ are there, msls where a city has postprocessed.csv, utm where a picture's
    name has a position, else folders.

    Raises:
        UsageError: no such folder; a part of GSV-Cities' or Mapillary SLS's layout; several data sets or the splits of
            an evaluation set below.
    """
    if not root.is_dir():
        raise UsageError(f"--source {shown(root)}: no such folder")
    if (kind := _known(root)) is not None:
        return root, kind
    _refuse_half(root)
    inside = [root / name for name in names_in(root) if (root / name).is_dir()]
    found = [(f, kind) for f in inside if (kind := _known(f))] if len(inside) <= _LOOKED_BELOW else []
    if len(found) > 1:
        names = ", ".join(shown(folder.name) for folder, _ in found)
        raise UsageError(f"--source {shown(root)}: holds several data sets ({names}); give one of them")
    return found[0] if found else (root, _loose(root))


def detect(root: Path) -> Kind:
    """The layout that `locate` finds. Raises as it."""
    return locate(root)[1]


def _known(root: Path) -> Kind | None:
    if gsv_cities.find_layout(root) is not None:
        return "gsv_cities"
    return "msls" if msls.find_cities(root) is not None else None


def _refuse_half(root: Path) -> None:
    """One of GSV-Cities' two folders without the other, or given itself."""
    names = {name for name in names_in(root) if (root / name).is_dir()}
    half = "Images" if "Images" in names else next((n for n in names if n.lower() == "dataframes"), None)
    if half is not None:
        other = "Dataframes" if half == "Images" else "Images"
        raise UsageError(
            f"--source {shown(root)}: has {half}/ but no {other}/ (GSV-Cities needs both); or give --kind folders"
        )
    whole = root.resolve()
    if whole.name.lower() in ("images", "dataframes") and gsv_cities.find_layout(whole.parent) is not None:
        raise UsageError(f"--source {shown(root)}: is GSV-Cities' {whole.name}/ alone; give {shown(whole.parent)}")


def _loose(root: Path) -> Kind:
    """utm or folders, unless the photos' names or folders say that they belong to something else."""
    looked_at = itertools.islice(street_view.pictures(root), _LOOKED_AT)
    if any(gsv_cities.PHOTO_NAME.fullmatch(path.rsplit("/", 1)[-1]) for path in looked_at):
        raise UsageError(
            f"--source {shown(root)}: its photos are named as GSV-Cities', but there is no Dataframes/ beside them; "
            "give the folder that holds Images/ and Dataframes/, or --kind folders where each folder is a place"
        )
    if not street_view.has_utm_names(root):
        return "folders"
    for base in (root / "images", root):
        splits = [name for name in _SPLITS if (base / name).is_dir()]
        if len(splits) > 1:
            raise UsageError(
                f"--source {shown(root)}: holds {', '.join(splits)} of an evaluation set; give one of them, such as "
                f"{shown(base / splits[0])}, or --kind utm for all"
            )
    return "utm"


def read_source(root: Path, rule: SourceRule | None = None) -> Catalogue:
    """The catalogue of a source folder.

    Raises:
        UsageError, DataError: as `locate` and the readers.
    """
    rule = rule or SourceRule()
    if not root.is_dir():
        raise UsageError(f"--source {shown(root)}: no such folder")
    folder, kind = locate(root) if rule.kind == "auto" else (root, rule.kind)
    if rule.cities and kind not in ("gsv_cities", "msls"):
        raise UsageError(f"--cities goes with GSV-Cities and Mapillary SLS only; {shown(root)} is read as {kind}")
    catalogue = _read(folder, kind, rule)
    if folder != root:
        catalogue = dataclasses.replace(catalogue, remarks=(f"read from {shown(folder)}", *catalogue.remarks))
    return catalogue


def _read(root: Path, kind: Kind, rule: SourceRule) -> Catalogue:
    try:
        if kind == "gsv_cities":
            return gsv_cities.read(root, rule.cities)
        if kind == "msls":
            return msls.read(root, rule.cities, *rule.cells(kind))
        if kind == "utm":
            return street_view.read_utm(root, *rule.cells(kind))
        return street_view.read_folders(root)
    except OSError as error:
        raise DataError(f"{shown(error.filename or root)}: cannot be read ({error.strerror})") from None


def reading_settings(kind: str, rule: SourceRule) -> dict[str, Any]:
    """The part of the manifest's settings that says how the source was read: what had an effect, no more."""
    settings: dict[str, Any] = {"kind": kind}
    if kind in ("gsv_cities", "msls"):
        settings["cities"] = sorted(rule.cities)
    if kind in CELLS:
        settings["cell_m"], settings["heading_deg"] = rule.cells(kind)
    return settings
