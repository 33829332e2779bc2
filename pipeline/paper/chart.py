"""The figure of a table: bars for rows that are names, lines for rows that are numbers; ours and the paper's.

Invariant: a panel is one set, its protocols in its legend. A bar or a line shows the mean over seeds; dots on a bar are
the seeds, and a vertical stroke on a line is their standard deviation. The paper's figures are hollow, and drawn only
where they are for the same set.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.evaluation.protocol import Protocol
from pipeline.evaluation.report.figures import CURVES, GREY, INK, canvas
from pipeline.evaluation.report.paper_numbers import Reported
from pipeline.evaluation.sets.registry import published_name
from pipeline.paper import values
from pipeline.paper.study import Study

COLOURS = dict(zip(("single", "shuffled", "ordered", "bank"), CURVES, strict=False))


def draw(study: Study, path: Path) -> None:
    """Recall@1 of every row, a panel a set, to `path`."""
    lines = bool(study.table.axis)
    height = 4.4 if lines else 1.5 + 0.62 * len(study.table.rows)
    with canvas(1.0 + 5.6 * len(study.sets), height, path) as figure:
        figure.suptitle(study.table.title, x=0.01, ha="left", fontsize=13, fontweight="bold")
        panels = figure.subplots(1, len(study.sets), squeeze=False, sharey=not lines)[0]
        for panel, set_name in zip(panels, study.sets, strict=True):
            (_lines if lines else _bars)(panel, study, set_name)
            panel.set_title(study.sets[set_name].name, fontsize=10.5)
        handles = {label: h for p in panels for h, label in zip(*p.get_legend_handles_labels(), strict=True)}
        names = sorted(handles, key=lambda label: label.startswith("paper"))  # ours first
        figure.legend(
            [handles[label] for label in names], names, loc="outside lower center", ncols=4, fontsize=8.5, frameon=False
        )


def _bars(panel: Any, study: Study, set_name: str) -> None:
    """Horizontal bars, one for each grouping of a row; a dot a seed; a hollow diamond for the paper."""
    loaded, protocols = study.sets[set_name], values.by_row(study, set_name)
    groupings = _groupings(protocols)
    thick = 0.78 / max(1, len(groupings))
    rows = list(study.table.rows)
    for place, row in enumerate(rows):
        for number, g in enumerate(groupings):
            protocol = protocols.get(row, {}).get(g)
            found = None if protocol is None else values.value(study, row, loaded, protocol, 1)
            if found is None:
                continue
            y = place + (number - (len(groupings) - 1) / 2) * thick
            panel.barh(y, found.mean, thick * 0.9, color=COLOURS[g], alpha=0.85, label=_label(g, protocols))
            if len(found.seeds) > 1:
                panel.scatter(found.seeds, [y] * len(found.seeds), s=11, color=INK, lw=0, zorder=3, label="a seed")
            end = max(found.seeds)
            panel.annotate(
                f"{found.mean:.1f}", (end, y), (5, 0), textcoords="offset points", va="center", fontsize=7.5, color=GREY
            )
        figure = values.paper_figure(study, row, loaded) if _of_this_set(study, set_name) else None
        if figure is not None and figure.at(1) is not None:
            style = {"s": 46, "marker": "D", "facecolor": "white", "edgecolor": INK, "lw": 1.3, "zorder": 4}
            panel.scatter(figure.at(1), place, label=_theirs(study, set_name), **style)
    panel.set_yticks(range(len(rows)), rows)
    panel.set(ylim=(len(rows) - 0.45, -0.55), xlim=(0, 103), xlabel="Recall@1  (%)")
    panel.grid(False, axis="y")


def _lines(panel: Any, study: Study, set_name: str) -> None:
    """Recall@1 over the rows' numbers, a line for each grouping and series; the paper's dashed."""
    loaded, protocols = study.sets[set_name], values.by_row(study, set_name)
    if study.table.logarithmic:
        panel.set_xscale("log")
    for number, ending in enumerate(study.table.series or ("",)):
        rows = {row: r.axis for row, r in study.table.rows.items() if _in_series(study, row, ending)}
        named = ending if not study.table.series else (f", {ending.strip('+')}" if ending else ", without")
        for order, g in enumerate(_groupings(protocols)):
            # lines that coincide stay visible: later ones are thinner
            style = {"marker": "os"[number % 2], "ms": 8 - 2 * order, "lw": 3.2 - 0.9 * order, "capsize": 3}
            points = []
            for row, at in rows.items():
                protocol = protocols.get(row, {}).get(g)
                found = None if protocol is None else values.value(study, row, loaded, protocol, 1)
                if found is not None:
                    points.append((at, found.mean, found.deviation or 0.0))
            if points:
                x, mean, deviation = zip(*sorted(points), strict=True)
                colour = COLOURS[g] if number == len(study.table.series or ("",)) - 1 else _lighter(COLOURS[g])
                label = _label(g, protocols) + named
                panel.errorbar(x, mean, deviation if any(deviation) else None, color=colour, label=label, **style)
        theirs = _points(rows, lambda row: values.paper_figure(study, row, loaded))
        if theirs and _of_this_set(study, set_name):
            label = _theirs(study, set_name) + named
            dashed = {"ls": "--", "marker": "os"[number % 2], "ms": 5, "mfc": "white", "color": INK, "lw": 1.2}
            panel.plot(*zip(*theirs, strict=True), label=label, **dashed)
    ticks = sorted({r.axis for r in study.table.rows.values() if r.axis is not None})
    panel.set_xticks(ticks, [f"{t:g}" for t in ticks])
    panel.minorticks_off()
    panel.set(xlabel=study.table.axis, ylabel="Recall@1  (%)", ylim=(0, 103))


def _points(
    rows: Mapping[str, float | None], figure: Callable[[str], Reported | None]
) -> Sequence[tuple[float, float]]:
    points = []
    for row, x in rows.items():
        found = figure(row)
        if found is not None and x is not None and (y := found.at(1)) is not None:
            points.append((x, y))
    return sorted(points)


def _in_series(study: Study, row: str, ending: str) -> bool:
    others = [s for s in study.table.series if s and s != ending]
    return row.endswith(ending) and not any(row.endswith(other) for other in others)


def _groupings(protocols: Mapping[str, Mapping[str, Protocol]]) -> list[str]:
    return list(dict.fromkeys(g for row in protocols.values() for g in row))


def _label(grouping: str, protocols: Mapping[str, Mapping[str, Protocol]]) -> str:
    sizes = {row[grouping].group_size for row in protocols.values() if grouping in row}
    return grouping if grouping == "single" or len(sizes) > 1 else f"{grouping}{sizes.pop()}"


def _theirs(study: Study, set_name: str) -> str:
    return f"paper, {values.paper_set(study, study.sets[set_name])}, ordered"


def _of_this_set(study: Study, set_name: str) -> bool:
    """Whether the paper has figures for this very set: those for other photographs do not belong on its axes."""
    loaded = study.sets[set_name]
    return values.paper_set(study, loaded) == (published_name(loaded.name) or loaded.name)


def _lighter(colour: str) -> Any:
    import matplotlib.colors as colours

    return tuple(0.5 + 0.5 * part for part in colours.to_rgb(colour))
