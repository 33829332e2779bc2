"""Where the first answers lie: on the ground where positions are known, else answer over query along the set.

Invariant: colours and signs are those of `figures`: green is right, red is wrong.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.evaluation.evaluate import Result
from pipeline.evaluation.report.figures import GREEN, GREY, RED, canvas, caption, heading
from pipeline.evaluation.sets.evaluation_set import EvaluationSet

APART = 3_000.0  # metres of emptiness that make two areas of a set (cities) panels of their own
PANELS = 6


def error_plot(evaluated: EvaluationSet, result: Result, path: Path) -> None:
    """Draws the first answer of every query, to `path`.

    Sets whose photos lie in several areas (cities) get a panel each, those with most queries first; an answer in
    another area is marked, not led to.
    """
    first = result.predictions[:, 0]
    right = np.array([np.isin(row, p).item() for row, p in zip(first, evaluated.positives, strict=True)], bool)
    if evaluated.database_positions is None or evaluated.query_positions is None:
        _order_plot(evaluated, result, right, path)
        return
    database, queries = evaluated.database_positions, evaluated.query_positions
    labels = areas(np.concatenate([database, queries]))
    of_database, of_queries = labels[: len(database)], labels[len(database) :]
    asked, counts = np.unique(of_queries, return_counts=True)
    shown = asked[np.argsort(-counts, kind="stable")][:PANELS]
    columns = min(2 if len(shown) == 4 else 3, len(shown))
    lines = -(-len(shown) // columns)
    extents = [np.ptp(np.concatenate([database[of_database == a], queries[of_queries == a]]), axis=0) for a in shown]
    shape = float(np.clip(np.median([e[1] / (e[0] + 1e-9) for e in extents]), 0.45, 1.1))
    width = 8.6 if columns == 1 else 11.0
    with canvas(width, lines * (width / columns - 0.6) * shape + 0.45 * lines + 1.5, path) as figure:
        axes = figure.subplots(lines, columns, squeeze=False)
        for number, (axis, area) in enumerate(zip(axes.flat, shown, strict=False)):
            inside, here = of_database == area, of_queries == area
            origin = np.concatenate([database[inside], queries[here]]).min(axis=0)
            points, asking = database[inside] - origin, queries - origin
            axis.scatter(*points.T, s=5, color="#cfd4da", lw=0)
            wrong = np.flatnonzero(~right & here)
            near = wrong[of_database[first[wrong]] == area]
            far = wrong[of_database[first[wrong]] != area]
            for q in near:
                axis.plot(*zip(asking[q], database[first[q]] - origin, strict=True), color=RED, lw=0.7, alpha=0.35)
            axis.scatter(*asking[right & here].T, s=20, color=GREEN, marker="o", lw=0, zorder=3)
            axis.scatter(*asking[near].T, s=24, color=RED, marker="x", lw=1.4, zorder=4)
            axis.scatter(*asking[far].T, s=22, color=RED, marker="^", lw=0, zorder=4)
            axis.set_aspect("equal", adjustable="datalim")
            axis.tick_params(labelsize=8)
            axis.set_xlabel("metres east", fontsize=9)
            axis.set_ylabel("metres north", fontsize=9)
            if len(shown) > 1:
                text = f"({chr(ord('a') + number)}) area {number + 1}: {(right & here).sum():,} of {here.sum():,} found"
                axis.set_title(text, fontsize=9, fontweight="normal", color=GREY)
        for axis in axes.flat[len(shown) :]:
            axis.set_visible(False)
        where = "" if len(shown) == len(asked) else f" · the {len(shown)} areas of {len(asked)} with most queries"
        figure.suptitle(
            f"Where the first answers lie\n{caption(result)}{where}", x=0.02, ha="left", fontsize=11, linespacing=1.5
        )
        figure.legend(handles=_legend(right, len(shown) > 1), loc="outside lower center", ncols=4, handletextpad=0.3)


def areas(points: np.ndarray, apart: float = APART) -> np.ndarray:
    """The number, from 0, of the area each of the points [n, 2] (metres) lies in, int64 [n].

    Points in touching cells of a grid of `apart` metres belong together; so areas are at least that far apart, and no
    two points nearer than that are ever separated.
    """
    cells, member = np.unique(np.floor(points / apart).astype(np.int64), axis=0, return_inverse=True)
    number = {tuple(map(int, cell)): -1 for cell in cells}
    count = 0
    for start in number:
        if number[start] >= 0:
            continue
        reached = [start]
        while reached:
            x, y = reached.pop()
            number[x, y] = count
            near = [(x + dx, y + dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
            reached += [cell for cell in near if number.get(cell, 0) < 0]
        count += 1
    return np.array([number[tuple(map(int, cell))] for cell in cells], np.int64)[member.ravel()]


def _legend(right: np.ndarray, several: bool) -> list[Any]:
    from matplotlib.lines import Line2D

    def entry(marker: str, colour: str, label: str) -> Any:
        return Line2D([], [], ls="", marker=marker, color=colour, label=label, markersize=6)

    entries = [
        entry(".", "#cfd4da", "database"),
        entry("o", GREEN, f"{right.sum():,} found"),
        entry("x", RED, f"{(~right).sum():,} wrong; a line leads to the answer"),
    ]
    return [*entries, entry("^", RED, "answer in another area")] if several else entries


def _order_plot(evaluated: EvaluationSet, result: Result, right: np.ndarray, path: Path) -> None:
    """For sequences and pairs: the row of the first answer over the row of the query; truth is a band."""
    query = np.arange(result.queries)
    with canvas(7.2, 7.4, path) as figure:
        axes = figure.subplots()
        truth = [(q, p) for q, positives in enumerate(evaluated.positives) for p in positives]
        if truth:
            axes.scatter(*zip(*truth, strict=True), s=7, color="#cfd4da", lw=0, label="positives")
        found = result.predictions[:, 0]
        axes.scatter(query[right], found[right], s=16, color=GREEN, lw=0, label=f"{right.sum():,} right")
        axes.scatter(
            query[~right], found[~right], s=20, color=RED, marker="x", lw=1.2, label=f"{(~right).sum():,} wrong"
        )
        axes.set(xlabel="query, in file order", ylabel="first answer, database row")
        heading(axes, "The first answer to each query", caption(result))
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3, handletextpad=0.3)
