"""Results as people and programs read them: one terminal table, markdown, CSV and JSON.

Invariant: a recall is never written without its protocol; the groupings of a set stand next to each other, and the
paper's figures, where it gives any, stand in the row of the same protocol, or in a row of their own with theirs.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from pipeline.common.errors import DataError
from pipeline.common.files import write_atomically
from pipeline.common.text import Table, csv_text, markdown_text, printable
from pipeline.evaluation.evaluate import Result, SearchCost
from pipeline.evaluation.protocol import Protocol, metric_name
from pipeline.evaluation.report.paper_numbers import FIGURES, HEADLINE, Reported, reported
from pipeline.evaluation.sets.registry import SETS, published_name

FORMAT_VERSION = 1


def paper_figures(result: Result) -> Reported | None:
    """The paper's figures for this set, where it gives them and the protocol is the paper's in every field.

    Its PCA was fitted on Pitts30k, its images were resized after normalising, positives follow the set's published
    rule; a query without positives makes a difference only where there is one.
    """
    ours, rule = result.protocol, SETS[result.set_name].rule if result.set_name in SETS else None
    theirs = ours.resize == "published" and ours.rule == rule and (not ours.pca or _is_pitts30k(ours.pca_source))
    plain = dataclasses.replace(ours, resize="antialias", pca_source=None, rule=Protocol(groups="single").rule)
    if not result.without_positives:
        plain = dataclasses.replace(plain, without_positives="miss")
    return FIGURES.get((result.set_name, HEADLINE, plain.name)) if theirs else None


def _is_pitts30k(source: str | None) -> bool:
    """Whether a set, by name or folder, is Pitts30k."""
    return source is not None and published_name(Path(source).name) == "pitts30k"


def table(results: Sequence[Result]) -> Table:
    """A row a set and protocol: the recalls, counts, the paper's recalls. The best of a set is marked."""
    ks = sorted({k for result in results for k in result.recalls})
    rows: list[dict[str, str]] = []
    marked: set[tuple[int, str]] = set()
    for set_name, group in _by_set(results):
        scored = [result for result in group if result.recalls]
        best = {k: max(r.recalls[k] for r in scored if k in r.recalls) for k in ks} if scored else {}
        matched = False
        for result in group:
            paper = paper_figures(result)
            matched |= paper is not None
            row = {"set": set_name, "protocol": result.protocol.name}
            for k in ks:
                value = result.recalls.get(k)
                row[f"R@{k}"] = _percent(value)
                if len(scored) > 1 and value is not None and value == best[k]:
                    marked.add((len(rows), f"R@{k}"))
            row["queries"] = f"{result.queries:,}"
            row["database"] = f"{result.database:,}"
            row["no positive"] = f"{result.without_positives:,}" if result.recalls else "-"
            if (cost := result.cost) is not None:
                row["bytes an image"] = f"{cost.bytes_each:,}" + f" + {cost.refine_bytes:,}" * (cost.refine_bytes > 0)
                row["ms a query"] = f"{cost.milliseconds:.3f}"
            if (change := result.against) is not None:
                against = f"R@{change.k} - whole, 95 %"
                row[against] = f"{change.value:+.1f} [{change.low:+.1f}, {change.high:+.1f}]"
                if change.real:
                    row[against] += " real"
            row["paper R@1/5/10"] = _cells(paper)
            rows.append(row)
        headline = reported(set_name)
        if headline is not None and not matched:
            theirs = f"paper: {Protocol(groups='ordered', group_size=headline.group_size).name}, PCA 4096"
            recalls = {f"R@{k}": _percent(headline.at(k)) for k in ks}
            rows.append({"set": set_name, "protocol": theirs, **recalls, "paper R@1/5/10": _cells(headline)})
    fullest: dict[str, str] = max(rows, key=len, default={"set": "", "protocol": ""})
    columns = list(fullest)
    if not any(row["paper R@1/5/10"] != "-" for row in rows):
        columns = [c for c in columns if c != "paper R@1/5/10"]
    return Table(
        head=columns,
        rows=[[row.get(c, "") for c in columns] for row in rows],
        left=(0, 1),
        marked={(row, columns.index(c)) for row, c in marked},
        grouped=True,
    )


def show(results: Sequence[Result]) -> None:
    """Prints the table and, below it, its notes."""
    if not results:
        print("no results")
        return
    table(results).print()
    print("\n" + "\n".join(map(printable, notes(results))))


def notes(results: Sequence[Result]) -> list[str]:
    """What the short names of protocols mean, which queries have no positive, and remarks: each once."""
    lines: dict[str, None] = {}
    if any(len([r for r in group if r.recalls]) > 1 for _, group in _by_set(results)):
        lines["the best of each set is marked; recalls in percent"] = None
    for result in results:
        lines[f"{result.protocol.name}: {result.protocol.describe()}"] = None
    for result in results:
        if result.without_positives and result.recalls:
            done = "counted as misses" if result.protocol.without_positives == "miss" else "dropped"
            lines[f"{result.set_name}: {result.without_positives:,} queries have no positive and are {done}"] = None
        for remark in result.remarks:
            lines[f"{result.set_name}: {remark}"] = None
    return list(lines)


def markdown(results: Sequence[Result]) -> str:
    """The table and its notes as markdown."""
    if not results:
        return "no results\n"
    return "\n".join([table(results).markdown(), *(f"- {markdown_text(note)}" for note in notes(results))]) + "\n"


def as_dicts(results: Iterable[Result]) -> list[dict[str, Any]]:
    """Results as plain values: what `results.json` holds and what a tracker logs (`metrics`)."""
    plain = []
    for result in results:
        paper = paper_figures(result) or reported(result.set_name)
        plain.append(
            {
                "set": result.set_name,
                "protocol_name": result.protocol.name,
                "protocol": result.protocol.to_dict(),
                "recalls": {str(k): value for k, value in result.recalls.items()},
                "metrics": {metric_name(result.set_name, result.protocol, k): v for k, v in result.recalls.items()},
                "queries": result.queries,
                "database": result.database,
                "without_positives": result.without_positives,
                "remarks": list(result.remarks),
                **({} if result.cost is None else {"cost": dataclasses.asdict(result.cost)}),
                **({} if result.against is None else {"against_whole": dataclasses.asdict(result.against)}),
                "paper": None if paper is None else {"recalls": paper.recalls, "group_size": paper.group_size},
            }
        )
    return plain


def write_json(results: Sequence[Result], path: Path, about: dict[str, Any]) -> None:
    """`{"format_version", **about, "results": [...]}`; `about` says which checkpoint, with its config and digest."""
    whole = {"format_version": FORMAT_VERSION, **about, "results": as_dicts(results)}
    write_atomically(path, json.dumps(whole, indent=2) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """A file of `write_json`. Raises `DataError` for anything else."""
    try:
        whole = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: not a results file ({error})") from None
    if not isinstance(whole, dict) or whole.get("format_version") != FORMAT_VERSION:
        raise DataError(f"{path}: not a results file of format {FORMAT_VERSION}; evaluate again")
    return whole


def write_csv(results: Sequence[Result], path: Path) -> None:
    """One line for each set, protocol and N."""
    settings = list(results[0].protocol.to_dict()) if results else []
    costs = [field.name for field in dataclasses.fields(SearchCost)]
    head = ["set", "protocol", "n", "recall", "queries", "database", "no_positive", *settings]
    lines: list[list[Any]] = [head + costs * any(r.cost is not None for r in results)]
    for r in results:
        for k, value in r.recalls.items():
            counts = [r.queries, r.database, r.without_positives]
            cost = [] if r.cost is None else list(dataclasses.asdict(r.cost).values())
            lines.append([r.set_name, r.protocol.name, k, value, *counts, *r.protocol.to_dict().values(), *cost])
    write_atomically(path, csv_text(lines))


def _by_set(results: Sequence[Result]) -> list[tuple[str, list[Result]]]:
    groups: dict[str, list[Result]] = {}
    for result in results:
        groups.setdefault(result.set_name, []).append(result)
    return list(groups.items())


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _cells(paper: Reported | None) -> str:
    return "-" if paper is None else " / ".join(_percent(value) for value in paper.recalls)
