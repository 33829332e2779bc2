"""The values of a filled table: our recalls over seeds, and the paper's figures that may stand beside them."""

from __future__ import annotations

import statistics
from dataclasses import dataclass

from pipeline.evaluation.protocol import Protocol
from pipeline.evaluation.report import paper_numbers
from pipeline.evaluation.report.paper_numbers import FIGURES, Reported
from pipeline.evaluation.sets.evaluation_set import EvaluationSet
from pipeline.evaluation.sets.registry import published_name
from pipeline.paper.study import Study


@dataclass(frozen=True)
class Value:
    """A recall over seeds, percent."""

    seeds: tuple[float, ...]

    @property
    def mean(self) -> float:
        """Over seeds."""
        return statistics.fmean(self.seeds)

    @property
    def deviation(self) -> float | None:
        """Sample standard deviation over seeds; None for one seed."""
        return statistics.stdev(self.seeds) if len(self.seeds) > 1 else None

    def __str__(self) -> str:
        return f"{self.mean:.1f}" + ("" if self.deviation is None else f" ±{self.deviation:.1f}")


def value(study: Study, row: str, loaded: EvaluationSet, protocol: Protocol, k: int) -> Value | None:
    """A recall of a row, None where it has not been measured."""
    found = study.values.get((row, loaded.name, protocol.name), {}).get(k)
    return Value(tuple(found)) if found else None


def paper_set(study: Study, loaded: EvaluationSet) -> str:
    """The set whose figures in the paper stand beside ours: the same one, else the first of the paper's table."""
    name = published_name(loaded.name) or loaded.name
    known = any(_reported(study, row, name) for row in study.table.rows)
    return name if known else study.table.sets[0]


def paper_figure(study: Study, row: str, loaded: EvaluationSet) -> Reported | None:
    """The paper's figures that stand beside a row, on the set `paper_set` names."""
    return _reported(study, row, paper_set(study, loaded))


def _reported(study: Study, row: str, set_name: str) -> Reported | None:
    table, name = study.table.rows[row].paper or (study.name, row)
    if table == "":  # a single row of the paper, in no table of its own
        return FIGURES.get((set_name, name, "")) or next(
            (f for (s, method, _), f in FIGURES.items() if (s, method) == (set_name, name)), None
        )
    if table == "sota":
        return paper_numbers.reported(set_name)
    return paper_numbers.table_row(table, name).get(set_name)


def by_row(study: Study, set_name: str) -> dict[str, dict[str, Protocol]]:
    """Row -> grouping (single, shuffled, ordered, bank) -> the protocol its values on a set were measured under."""
    return {row: study.protocols[row, set_name] for row in study.table.rows if (row, set_name) in study.protocols}
