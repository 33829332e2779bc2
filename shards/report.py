"""What a person is told at the end: a table of counts, and a file that names all that was left out, and why.

Invariant: images named = used + unused + bad, and places named = in the set + under four + fallen under four; nothing
disappears between the lines.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.common.text import FORMULA, Table, csv_text
from shards.catalogue import LeftOut


@dataclass(frozen=True)
class Summary:
    """The outcome of writing a shard set: the manifest's counts, and this run's time (0 where nothing was to do)."""

    root: str
    counts: Mapping[str, int]
    reasons: Mapping[str, int]
    seconds: float
    images_opened: int

    def __str__(self) -> str:
        c = self.counts
        lines = [
            ("places", f"{c['places']:,}", f"of {c['places_named']:,} named"),
            ("  under four images", f"{c['places_under_four']:,}", "left out, named in report.csv"),
            ("  fallen under four", f"{c['places_fallen']:,}", "by missing or broken images"),
            ("rounds", f"{c['rounds']:,}", f"{c['samples']:,} samples of four images"),
            ("images", f"{c['images_named']:,}", f"and {c['duplicates']:,} rows that name one again"),
            ("  used", f"{c['images_used']:,}", f"{_percent(c['images_used'], c['images_named'])} %"),
            ("  unused", f"{c['images_unused']:,}", "in no round, or of a place under four"),
            ("  bad", f"{c['images_bad']:,}", "; ".join(f"{n:,} {reason}" for reason, n in self.reasons.items())),
            ("files no row names", f"{c['unlisted']:,}", "" if c["unlisted"] == 0 else "not read"),
            ("shards", f"{c['shards']:,}", f"{_bytes(c['bytes'])}"),
        ]
        if c["made_again"]:
            lines.append(("JPEGs made again", f"{c['made_again']:,}", "resized or converted, quality 95"))
        if self.seconds:
            speed = f"{self.images_opened / self.seconds:,.0f} images/s" if self.images_opened else ""
            lines.append(("seconds", f"{self.seconds:,.1f}", speed))
        return Table((), lines, (0, 2)).text()


def report_bytes(left_out: Iterable[LeftOut]) -> bytes:
    """report.csv: file, city, place, reason; a line with an empty file is about a whole place.

    A file's name that a spreadsheet would run as a formula (@utm names begin so) gets `./` before it, which names the
    same file.
    """
    rows = sorted(left_out)
    told = [(f"./{item.file}" if item.file.startswith(FORMULA) else item.file, *item[1:]) for item in rows]
    return csv_text([LeftOut._fields, *told]).encode()


def reasons(left_out: Iterable[LeftOut]) -> dict[str, int]:
    """How many images each reason left out, the commonest first; decoders' details are put together."""
    return dict(Counter(item.reason.split(":")[0] for item in left_out).most_common())


def place_lines(under_four: Iterable[Mapping[str, Any]], fallen: Iterable[tuple[str, str, int, int]]) -> list[LeftOut]:
    """The report's lines about places: those named with too few images, and those that lost too many."""
    lines = [LeftOut("", p["city"], p["place_id"], f"only {p['images']} images are named") for p in under_four]
    return lines + [LeftOut("", city, place, f"only {n} of {of} images are good") for city, place, n, of in fallen]


def _percent(part: int, whole: int) -> str:
    return f"{100 * part / max(whole, 1):.1f}"


def _bytes(n: int) -> str:
    for unit, size in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if n >= size:
            return f"{n / size:,.2f} {unit}"
    return f"{n} bytes"
