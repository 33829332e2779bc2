"""Opens a source folder, whichever of the known layouts it has.

Invariant: the layout found is a function of the folder's content, and is told to the user and kept in the manifest.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pipeline.common.errors import UsageError
from shards.catalogue import Catalogue
from shards.sources import gsv_cities, street_view

Kind = Literal["auto", "gsv_cities", "folders", "utm"]


@dataclass(frozen=True)
class SourceRule:
    """How a source is read."""

    kind: Kind = "auto"
    cities: tuple[str, ...] = ()  # gsv_cities: city_ids to keep; none keeps all
    cell_m: float = 10.0  # utm: side of a place's cell in metres
    heading_deg: float = 30.0  # utm: width of a place's heading sector in degrees; 0 ignores headings


def detect(root: Path) -> Kind:
    """gsv_cities where Dataframes/ and Images/ are there, utm where a picture's name has a position, else folders.

    Raises:
        UsageError: no such folder, or only one of GSV-Cities' two folders.
    """
    if not root.is_dir():
        raise UsageError(f"--source {root}: no such folder")
    if gsv_cities.is_gsv_cities(root):
        return "gsv_cities"
    for half, other in (("Dataframes", "Images"), ("Images", "Dataframes")):
        if (root / half).is_dir():
            raise UsageError(f"{root}: has {half}/ but no {other}/ (GSV-Cities needs both); or give --kind folders")
    return "utm" if street_view.has_utm_names(root) else "folders"


def read_source(root: Path, rule: SourceRule | None = None) -> Catalogue:
    """The catalogue of a source folder.

    Raises:
        UsageError, DataError: as `detect` and the readers.
    """
    rule = rule or SourceRule()
    kind = detect(root) if rule.kind == "auto" else rule.kind
    if not root.is_dir():
        raise UsageError(f"--source {root}: no such folder")
    if rule.cities and kind != "gsv_cities":
        raise UsageError(f"--cities goes with GSV-Cities' layout only; {root} is read as {kind}")
    if kind == "gsv_cities":
        return gsv_cities.read(root, rule.cities)
    if kind == "utm":
        if rule.cell_m <= 0 or rule.heading_deg < 0:
            raise UsageError(f"--cell-m {rule.cell_m} must be above 0 and --heading-deg {rule.heading_deg} not below 0")
        return street_view.read_utm(root, rule.cell_m, rule.heading_deg)
    return street_view.read_folders(root)


def reading_settings(kind: str, rule: SourceRule) -> dict[str, Any]:
    """The part of the manifest's settings that says how the source was read: what had an effect, no more."""
    if kind == "gsv_cities":
        return {"kind": kind, "cities": sorted(rule.cities)}
    if kind == "utm":
        return {"kind": kind, "cell_m": rule.cell_m, "heading_deg": rule.heading_deg}
    return {"kind": kind}
