"""Which pictures an evaluation leaves: curves, grids of answers, error plots and attention, each a file.

Invariant: every picture belongs to one set; a set without ground truth gets the grid of its answers alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.evaluation.evaluate import Result
from pipeline.evaluation.report import figures
from pipeline.evaluation.report.error_plots import error_plot
from pipeline.evaluation.report.precision import first_answers, precision_recall, summary
from pipeline.evaluation.sets.evaluation_set import EvaluationSet

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
            asked = scored[0].queries - (
                scored[0].without_positives if scored[0].protocol.without_positives == "drop" else 0
            )
            path = folder / f"{name}.curves.png"
            below = f"{name} · {scored[0].queries:,} queries in {scored[0].database:,} images · {evaluated.rule}"
            figures.recall_curves(curves, path, "Recall@N by protocol", below, asked)
            drawn.append(Picture(name, "Recall@N", path))
            path = folder / f"{name}.precision.png"
            figures.precision_recall_curves({r.protocol.name: _precision(evaluated, r) for r in scored}, path, below)
            drawn.append(Picture(name, "precision and recall over a distance threshold", path))
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


def _precision(evaluated: EvaluationSet, result: Result) -> tuple[np.ndarray, np.ndarray, str]:
    """Precision, recall and a note for `precision_recall_curves`; thresholds are L2."""
    squared, right, positives = first_answers(result.predictions, result.distances, evaluated.positives)
    precision, recall, threshold = precision_recall(np.sqrt(np.maximum(squared, 0)), right, positives)
    return precision, recall, summary(precision, recall, threshold)


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
