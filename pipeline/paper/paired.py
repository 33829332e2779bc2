"""Is a row of a table better than another? Paired intervals over the queries that both were measured on.

Invariant: only predictions of the same queries with the same positives are compared, seed by seed; a query's difference
is the mean over seeds, and the interval is over queries: it says how far the result depends on which queries were
asked. How far it depends on the training shows in the table's standard deviation.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.common.text import Table, csv_text
from pipeline.evaluation.difference import interval_of
from pipeline.evaluation.predictions import Predictions, load_predictions, predictions_path
from pipeline.paper.measure import predictions_folder
from pipeline.paper.plan import Cell
from pipeline.paper.study import Study

KS = (1, 5)


@dataclass(frozen=True)
class Paired:
    """Recall@k of a second row and grouping minus that of a first, in points."""

    set_name: str
    first: str
    second: str
    k: int
    recalls: tuple[float, float]
    low: float
    high: float
    """The 95 % interval of the difference, over queries."""
    queries: int
    seeds: int

    @property
    def value(self) -> float:
        """Points; positive: the second is better."""
        return self.recalls[1] - self.recalls[0]


def compare(first: Sequence[Predictions], second: Sequence[Predictions], k: int) -> tuple[np.ndarray, np.ndarray]:
    """Share of seeds that found each query, [Q] each, for runs in the order of their seeds.

    Raises:
        ValueError: not the same queries with the same positives.
    """
    every = [*first, *second]
    names = [[Path(q).name for q in p.queries] for p in every]
    if any(n != names[0] for n in names) or any(
        not np.array_equal(a, b) for p in every for a, b in zip(every[0].positives, p.positives, strict=True)
    ):
        raise ValueError("predictions of other queries or positives")
    hits = [np.mean([(p.ranks >= 0) & (p.ranks < k) for p in runs], axis=0) for runs in (first, second)]
    if first[0].protocol.without_positives == "drop":
        counted = np.array([len(p) > 0 for p in first[0].positives])
        hits = [found[counted] for found in hits]
    return hits[0], hits[1]


def paired(study: Study) -> Iterator[Paired]:
    """The comparisons that the table names, on every set, of the seeds that both rows have."""
    for set_name, loaded in study.sets.items():
        for (row, grouping), (other, its) in study.table.paired:
            one, two = _predictions(study, set_name, row, grouping), _predictions(study, set_name, other, its)
            seeds = sorted(one.keys() & two.keys())
            if not seeds:
                continue
            for k in KS:
                found = compare([one[s] for s in seeds], [two[s] for s in seeds], k)
                recalls = (100.0 * float(found[0].mean()), 100.0 * float(found[1].mean()))
                interval = interval_of(found[1] - found[0])
                names = f"{row} {grouping}", f"{other} {its}"
                yield Paired(loaded.name, *names, k, recalls, *interval, len(found[0]), len(seeds))


def _predictions(study: Study, set_name: str, row: str, grouping: str) -> dict[int, Predictions]:
    """Seed -> what a row answered under a grouping."""
    found: dict[int, Predictions] = {}
    for cell in study.cells:
        if cell.row == row and cell.set_name == set_name:
            for file in _files(study, cell, grouping):
                found[cell.training.config.seed] = load_predictions(file)
    return found


def _files(study: Study, cell: Cell, grouping: str) -> list[Path]:
    protocol = study.protocols.get((cell.row, cell.set_name), {}).get(grouping)
    if protocol is None:
        return []
    folder = predictions_folder(study.runner.run_folder(cell.training), cell)
    file = predictions_path(folder, study.sets[cell.set_name].name, protocol)
    return [file] if file.is_file() else []


def table(found: Sequence[Paired]) -> Table:
    """Rows for people; a difference whose interval leaves zero out is bold in markdown."""
    rows = [
        [d.set_name, d.first, d.second, str(d.k), f"{d.recalls[0]:.1f} -> {d.recalls[1]:.1f}",
         f"{d.value:+.1f} [{d.low:+.1f}, {d.high:+.1f}]", f"{d.queries:,} x {d.seeds}"]
        for d in found
    ]  # fmt: skip
    real = [(i, 5) for i, d in enumerate(found) if d.low > 0 or d.high < 0]
    head = ["set", "first", "second", "N", "recall, %", "difference, 95 % interval", "queries x seeds"]
    return Table(head, rows, (0, 1, 2), real)


def csv(found: Sequence[Paired]) -> str:
    """One line a difference."""
    head: list[object] = ["set", "first", "second", "n", "recall_first", "recall_second", "difference", "low", "high"]
    lines: list[list[object]] = [[*head, "queries", "seeds"]]
    for d in found:
        lines.append([d.set_name, d.first, d.second, d.k, *d.recalls, d.value, d.low, d.high, d.queries, d.seeds])
    return csv_text(lines)
