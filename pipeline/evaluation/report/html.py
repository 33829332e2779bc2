"""One HTML file for an evaluation: its tables, curves, grids and error plots; opens anywhere, without a network.

Invariant: the file refers to nothing outside itself: styles are inline, pictures are data URLs, there are no scripts.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.common.text import printable
from pipeline.evaluation.evaluate import Result
from pipeline.evaluation.report import figures
from pipeline.evaluation.report.error_plots import error_plot
from pipeline.evaluation.report.tables import notes, table
from pipeline.evaluation.sets.evaluation_set import EvaluationSet

CSS = """
:root { --ink: #22262d; --grey: #6b7280; --line: #e3e6ea; --green: #1a9850; }
* { box-sizing: border-box; }
body { margin: 0; color: var(--ink); background: #f6f7f9;
       font: 15px/1.55 system-ui, "Segoe UI", Helvetica, sans-serif; }
main { max-width: 1120px; margin: 0 auto; padding: 36px 28px 80px; }
h1 { font-size: 26px; margin: 0 0 4px; }
h2 { font-size: 19px; margin: 44px 0 12px; }
.about { color: var(--grey); margin: 0 0 24px; overflow-wrap: anywhere; }
.card { background: #fff; border: 1px solid var(--line); border-radius: 10px; padding: 18px 20px;
        margin: 0 0 18px; overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; white-space: nowrap; }
th, td { text-align: right; padding: 6px 10px; border-bottom: 1px solid var(--line); }
th { font-weight: 600; color: var(--grey); font-size: 13px; border-bottom-width: 2px; }
th:nth-child(-n+2), td:nth-child(-n+2) { text-align: left; }
tr.first td { border-top: 2px solid var(--line); }
td.best { color: var(--green); font-weight: 700; }
td.set { font-weight: 600; }
ul { margin: 14px 0 0; padding-left: 18px; color: var(--grey); font-size: 13.5px; }
img { max-width: 100%; height: auto; display: block; margin: 0 auto; }
figure { margin: 0; }
nav a { margin-right: 16px; color: #3b6fb6; text-decoration: none; }
summary { cursor: pointer; font-weight: 600; margin: 2px 0; }
details[open] > summary { margin-bottom: 12px; }
@media print { body { background: #fff; } .card { break-inside: avoid; } }
"""
GRIDS: tuple[tuple[figures.Kind, str], ...] = (
    ("correct", "Found at first"),
    ("failures", "First answer wrong"),
    ("worst", "Worst errors: no right answer at all"),
)
SOME = 6  # queries, spread over the set, of which answers or attention are shown


@dataclass(frozen=True)
class Picture:
    """A drawn file and what it shows."""

    set_name: str
    title: str
    path: Path
    open: bool = True
    """Whether the report shows it unfolded."""


def draw(
    results: Sequence[Result], sets: Sequence[EvaluationSet], folder: Path, model: Any | None = None
) -> list[Picture]:
    """Draws everything the report shows, into `folder`: for each set the curves of its protocols, for each protocol
    grids and an error plot, and with a `model` what it attends to in some queries. Sets without ground truth get a
    grid of answers alone."""
    drawn: list[Picture] = []
    for evaluated in sets:
        own = [result for result in results if result.set_name == evaluated.name]
        scored = [result for result in own if result.recalls]
        name = evaluated.name
        if scored:
            curves = {result.protocol.name: figures.curve_of(evaluated, result) for result in scored}
            path = folder / f"{name}.curves.png"
            below = f"{name} · {scored[0].queries:,} queries in {scored[0].database:,} images · {evaluated.rule}"
            figures.recall_curves(curves, path, "Recall@N by protocol", below)
            drawn.append(Picture(name, "Recall@N", path))
        for number, result in enumerate(scored):
            protocol = result.protocol.name
            path = folder / f"{name}.{protocol}.errors.png"
            error_plot(evaluated, result, path)
            drawn.append(Picture(name, f"{protocol}: where the first answers lie", path, number == 0))
            for kind, title in GRIDS:
                chosen = figures.choose(evaluated, result, kind)
                if chosen:
                    path = folder / f"{name}.{protocol}.{kind}.jpg"
                    figures.retrieval_grid(evaluated, result, chosen, path, title)
                    drawn.append(Picture(name, f"{protocol}: {title.lower()}", path, number == 0))
        some = np.linspace(0, len(evaluated.queries) - 1, min(SOME, len(evaluated.queries))).round().astype(int)
        for result in own if not scored else ():
            protocol, path = result.protocol.name, folder / f"{name}.{result.protocol.name}.answers.jpg"
            figures.answer_grid(_answers(evaluated, result, some), path, "Answers", figures.caption(result))
            drawn.append(Picture(name, f"{protocol}: answers, which are right is not known", path))
        if model is not None:
            path = folder / f"{name}.attention.jpg"
            queries = [evaluated.queries[i] for i in some]
            figures.attention_overlay(model, queries, path, "Channel mean of the patch tokens")
            drawn.append(Picture(name, "attention: what the patch tokens of some queries weigh", path))
    return drawn


def _answers(
    evaluated: EvaluationSet, result: Result, queries: np.ndarray
) -> list[tuple[Path, list[tuple[Path, str]]]]:
    """Queries with their first answers and L2 distances, as `answer_grid` draws them."""
    return [
        (
            evaluated.queries[q],
            [
                (evaluated.database[row], f"{distance**0.5:.3f}")
                for row, distance in zip(result.predictions[q, :5], result.distances[q, :5], strict=True)
                if row >= 0
            ],
        )
        for q in queries
    ]


def write_report(
    results: Sequence[Result], pictures: Sequence[Picture], path: Path, title: str, about: Mapping[str, str]
) -> None:
    """Writes the page. `about`: facts of the head line, such as checkpoint, date, descriptor size."""
    facts = " · ".join(f"{html.escape(key)} {html.escape(value)}" for key, value in about.items())
    names = list(dict.fromkeys(result.set_name for result in results))
    links = "".join(f'<a href="#{html.escape(name)}">{html.escape(name)}</a>' for name in names)
    parts = [
        f"<h1>{html.escape(title)}</h1><p class=about>{facts}</p><nav>{links}</nav>",
        f"<h2>Recall and its protocol</h2><div class=card>{_table(results)}<ul>",
        *(f"<li>{html.escape(printable(note))}</li>" for note in notes(results)),
        "</ul></div>",
    ]
    for name in names:
        parts.append(f'<h2 id="{html.escape(name)}">{html.escape(name)}</h2>')
        parts += [_figure(picture) for picture in pictures if picture.set_name == name]
    page = (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{CSS}</style></head>'
        f"<body><main>{''.join(parts)}</main></body></html>\n"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_name(path.name + ".tmp")
    fresh.write_text(page)
    fresh.replace(path)


def _table(results: Sequence[Result]) -> str:
    if not results:
        return "<p>no results</p>"
    found = table(results)
    lines = ["<table><tr>" + "".join(f"<th>{html.escape(c)}</th>" for c in found.head) + "</tr>"]
    previous = ""
    for i, row in enumerate(found.rows):
        first = row[0] != previous
        cells = []
        for n, text in enumerate(row):
            kind = "best" if (i, n) in found.marked else "set" if n == 0 else ""
            told = "" if n == 0 and not first else printable(text)
            cells.append(f'<td class="{kind}">{html.escape(told)}</td>')
        lines.append(f'<tr class="{"first" if first and previous else ""}">' + "".join(cells) + "</tr>")
        previous = row[0]
    return "".join([*lines, "</table>"])


def _figure(picture: Picture) -> str:
    data = base64.b64encode(picture.path.read_bytes()).decode()
    name = html.escape(f"{picture.set_name}, {picture.title}")
    kind = "jpeg" if picture.path.suffix == ".jpg" else "png"
    shown = f'<figure><img alt="{name}" src="data:image/{kind};base64,{data}"></figure>'
    state = " open" if picture.open else ""
    return f"<div class=card><details{state}><summary>{html.escape(picture.title)}</summary>{shown}</details></div>"
