"""Answers for people and other programs: a table, GeoJSON, CSV, KML, and a pairs list for hloc.

Invariant: one row, feature or placemark an answer, best first, with all that is known of it. Distances on the ground
are metres everywhere; GeoJSON and KML have longitude first, as their standards say (RFC 7946; OGC KML 2.2).
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from pipeline.common.errors import DataError, UsageError
from pipeline.common.files import write_atomically
from pipeline.common.text import Table, csv_text, printable, shown
from pipeline.locate.answers import Answer, Found
from pipeline.locate.photo_index import PhotoIndex

FORMATS = (".geojson", ".csv", ".kml", ".txt")
NO_MATCH = "probably not on this map"
COLUMNS = ("photo", "rank", "place", "distance", "confidence", "matched", "lat", "lon", "utm_east", "utm_north",
           "utm_zone", "metres", "right", "photo_lat", "photo_lon")  # fmt: skip


def check_format(path: Path) -> None:
    """Raises `UsageError` where the name's ending is none of `FORMATS`."""
    if path.suffix.lower() not in FORMATS:
        raise UsageError(
            f"--to {shown(path)}: '{shown(path.suffix)}' is no known ending; it can be .geojson, .csv, .kml, or .txt "
            "(a pairs list for hloc)"
        )


def export(answers: Sequence[Answer], index: PhotoIndex, path: Path) -> None:
    """Writes the answers in the format of the file's ending.

    Raises:
        UsageError: no such format; DataError: a name that the format cannot hold.
    """
    check_format(path)
    write = {".geojson": geojson, ".csv": csv, ".kml": kml, ".txt": pairs}[path.suffix.lower()]
    write_atomically(path, write(answers, index))


def table(answers: Sequence[Answer], index: PhotoIndex) -> Table:
    """The answers on a terminal; columns that nothing is known for are left out. Right ones are marked."""
    head = ["photo", "#", "place", "distance", "confidence", "latitude", "longitude", "UTM east", "UTM north", "zone",
            "metres away"]  # fmt: skip
    rows, marked = [], []
    for answer in answers:
        own = answer.own
        if own.degrees or own.metres or own.problem:
            said = f"(broken GPS: {own.problem})" if own.problem else "(its own position)"
            utm = own.metres or ("", "")
            rows.append([str(answer.photo), "", said, "", "", *_degrees(own.degrees), *map(_metre, utm), own.zone, ""])
        for rank, found in enumerate(answer.found, 1):
            if found.right:
                marked.append((len(rows), 1))
            confidence = "" if found.confidence is None else f"{found.confidence:.2f}"
            metres = "" if found.metres is None else f"{found.metres:,.0f}"
            zone = index.zone if found.utm else ""
            rows.append([str(answer.photo), str(rank), _below(found.place, index), f"{found.distance:.3f}", confidence,
                         *_degrees(found.degrees), *map(_metre, found.utm or ("", "")), zone, metres])  # fmt: skip
        if answer.matched is False:
            rows.append([str(answer.photo), "", NO_MATCH, *[""] * 8])
    used = [n for n in range(len(head)) if n < 4 or any(row[n] for row in rows)]
    return Table(
        [head[n] for n in used],
        [[row[n] for n in used] for row in rows],
        left=(0, 2),
        marked=marked,
        grouped=True,
    )


def geojson(answers: Sequence[Answer], index: PhotoIndex) -> str:
    """A FeatureCollection of points in longitude and latitude (WGS84); geometry null where they are not known."""
    features = []
    for answer in answers:
        for row, found in zip(_rows(answer, index), answer.found, strict=True):
            point = found.degrees and {"type": "Point", "coordinates": [found.degrees[1], found.degrees[0]]}
            known = {name: value for name, value in row.items() if value is not None and name not in ("lat", "lon")}
            features.append({"type": "Feature", "geometry": point, "properties": known})
    return json.dumps({"type": "FeatureCollection", "features": features}, indent=1) + "\n"


def csv(answers: Sequence[Answer], index: PhotoIndex) -> str:
    """A row an answer, `COLUMNS`; empty where not known."""
    rows = [row for answer in answers for row in _rows(answer, index)]
    values = [["" if row[name] is None else row[name] for name in COLUMNS] for row in rows]
    return csv_text([COLUMNS, *values])


def kml(answers: Sequence[Answer], index: PhotoIndex) -> str:
    """A folder a photo, a placemark an answer; without a point where latitude and longitude are not known."""
    root = ElementTree.Element("kml", xmlns="http://www.opengis.net/kml/2.2")
    document = ElementTree.SubElement(root, "Document")
    for answer in answers:
        folder = ElementTree.SubElement(document, "Folder")
        ElementTree.SubElement(folder, "name").text = printable(str(answer.photo))
        if answer.matched is False:
            ElementTree.SubElement(folder, "description").text = NO_MATCH
        for rank, (row, found) in enumerate(zip(_rows(answer, index), answer.found, strict=True), 1):
            mark = ElementTree.SubElement(folder, "Placemark")
            ElementTree.SubElement(mark, "name").text = printable(f"{rank} {_below(found.place, index)}")
            told = [f"{name}: {row[name]}" for name in ("distance", "confidence", "metres") if row[name] is not None]
            ElementTree.SubElement(mark, "description").text = ", ".join(told)
            if found.degrees is not None:
                point = ElementTree.SubElement(mark, "Point")
                ElementTree.SubElement(point, "coordinates").text = f"{found.degrees[1]:.7f},{found.degrees[0]:.7f}"
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def pairs(answers: Sequence[Answer], index: PhotoIndex) -> str:
    """Lines `query db` as hloc reads them: the query's name below the folder of all queries, the place's below the
    index's root. Photos that are probably not on the map have no line.

    Raises:
        DataError: a name with white space, at which hloc would cut it.
    """
    folders = {answer.photo.absolute().parent for answer in answers}
    root = Path(os.path.commonpath(folders)) if folders else Path()
    lines = []
    for answer in answers:
        query = str(answer.photo.absolute().relative_to(root))
        for found in answer.found if answer.matched is not False else ():
            place = _below(found.place, index)
            for name in (query, place):
                if len(name.split()) != 1:
                    raise DataError(f"{shown(name)}: a pairs list for hloc cannot hold names with spaces; rename it")
            lines.append(f"{query} {place}\n")
    return "".join(lines)


def _rows(answer: Answer, index: PhotoIndex) -> list[dict[str, Any]]:
    """Plain values of `COLUMNS` for each answer; None where not known."""
    own = answer.own.degrees or (None, None)
    return [
        dict.fromkeys(COLUMNS)
        | found.to_dict()
        | {"photo": printable(str(answer.photo)), "place": printable(str(found.place)), "rank": rank}
        | {"matched": answer.matched, "photo_lat": own[0], "photo_lon": own[1]}
        | {"utm_zone": index.zone if found.utm and index.zone else None}
        for rank, found in enumerate(answer.found, 1)
    ]


def _below(place: Path, index: PhotoIndex) -> str:
    """A place's name below the index's root."""
    root = index.about["root"]
    return str(place.relative_to(root) if place.is_relative_to(root) else place)


def _degrees(point: tuple[float, float] | None) -> tuple[str, str]:
    return ("", "") if point is None else (f"{point[0]:.6f}", f"{point[1]:.6f}")


def _metre(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.1f}"


def label(found: Found) -> str:
    """Two lines below and above an answer in a picture: distance and confidence; where it is."""
    sure = "" if found.confidence is None else f" · {100 * found.confidence:.0f} %"
    away = "" if found.metres is None else f"{found.metres:,.0f} m away"
    where = away or (", ".join(_degrees(found.degrees)) if found.degrees else "")
    if not where and found.utm:
        where = f"{found.utm[0]:.1f} E  {found.utm[1]:.1f} N"
    return f"{found.distance:.3f}{sure}\n{where}"
