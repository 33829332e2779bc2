"""The paper's figures: attention before and after adaptation, places on a map, retrieval against baselines.

Invariant: as in `figures`: every picture says what it was made of, green is right and red is wrong with a sign beside
the colour; and none shows one side alone: the comparison also shows where the baseline is better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.common.errors import UsageError
from pipeline.config.image_size import ImageSize
from pipeline.evaluation.evaluate import Result
from pipeline.evaluation.recall import first_hits
from pipeline.evaluation.report.figures import (
    GREEN,
    GREY,
    INK,
    RED,
    TILE,
    as_seen,
    canvas,
    caption,
    is_right,
    lay_over,
    metres_text,
    photo_tile,
    short_name,
    usual_aspect,
)
from pipeline.evaluation.sets.evaluation_set import EvaluationSet
from pipeline.paper.place_features import Features

MARKERS = "osD^vP*X"
HUES = ("#3b6fb6", "#e08214", "#1a9850", "#8e5ba6", "#17a2b8", "#b5651d", "#d6518f", "#7a8b2a", "#5f6b7a")


def attention_comparison(
    photos: Sequence[Path],
    maps: Sequence[tuple[str, Sequence[np.ndarray]]],
    size: ImageSize,
    path: Path,
    below: str,
) -> None:
    """A column a photo: the photo, then one row for each of `maps`, (title, n of `attention_maps`).

    Each map is spread over its own range, 2nd to 98th percentile, so colours compare within a picture alone. Photos
    have the shape in which the model sees them.
    """
    wide, gap, left, head, foot = 1.9, 0.07, 0.34, 0.94, 0.36
    rows = 1 + len(maps)
    width, height = left + len(photos) * (wide + gap) + 0.1, head + rows * (wide + gap) + foot
    with canvas(width, height, path, layout="none") as figure:
        figure.text(left / width, 1 - 0.12 / height, "What the backbone looks at", fontsize=14, weight="bold", va="top")
        figure.text(left / width, 1 - 0.42 / height, below, fontsize=8.5, color=GREY, va="top")
        for row, title in enumerate(["photo", *(title for title, _ in maps)]):
            middle = 1 - (head + row * (wide + gap) + wide / 2) / height
            figure.text(0.17 / width, middle, title, rotation=90, ha="center", va="center", fontsize=10.5)
        for column, photo in enumerate(photos):
            pixels = as_seen(photo, size)
            faded = np.repeat(pixels.mean(2, keepdims=True), 3, axis=2) / 255 * 0.75
            name = short_name(photo, 30)
            middle = left + column * (wide + gap) + wide / 2
            figure.text(middle / width, 1 - (head - 0.05) / height, name, fontsize=7.5, color=GREY, ha="center")
            for row in range(rows):
                x, y = left + column * (wide + gap), head + row * (wide + gap) + wide
                axes = figure.add_axes((x / width, 1 - y / height, wide / width, wide / height))
                axes.axis("off")
                if row == 0:
                    axes.imshow(pixels, interpolation="antialiased")
                    continue
                heat = maps[row - 1][1][column]
                low, high = np.percentile(heat, (2, 98))
                lay_over(axes, faded, heat, alpha=0.62, vmin=low, vmax=high)
        _scale(figure, left, width, height)


def _scale(figure: Any, left: float, width: float, height: float) -> None:
    axes = figure.add_axes((left / width, 0.16 / height, 1.5 / width, 0.09 / height))
    axes.imshow(np.linspace(0, 1, 128)[None], aspect="auto", cmap="inferno")
    axes.axis("off")
    figure.text((left + 1.58) / width, 0.2 / height, "low to high channel mean", fontsize=8, color=GREY, va="center")


def tsne(points: np.ndarray, perplexity: float) -> np.ndarray:
    """The t-SNE map [n, 2] of points [n, d] (some hundreds), by scikit-learn's exact method, started from PCA.

    The same points give the same map. Neighbourhoods mean something, distances between clusters and sizes do not.

    Raises:
        UsageError: fewer than three times the perplexity of points.
    """
    if not 1 <= perplexity <= len(points) / 3:
        least = int(3 * max(perplexity, 1))
        raise UsageError(f"perplexity {perplexity:g} wants at least {least} photos, there are {len(points)}")
    from sklearn.manifold import TSNE

    method = TSNE(perplexity=perplexity, method="exact", init="pca", random_state=0, n_jobs=1)
    return np.asarray(method.fit_transform(np.asarray(points, np.float64)))


def place_maps(
    found: Sequence[Features], labels: np.ndarray, path: Path, below: str, perplexity: float = 30.0
) -> list[float]:
    """A t-SNE map for each stage, places by colour and sign; rings mark photos whose nearest photo is of another place.

    Returns the percentage of photos whose nearest photo is of the same place, a stage.

    Raises:
        UsageError: too few photos for the perplexity.
    """
    shares = []
    width, height = max(4.1 * len(found) + 0.2, 6.0), 5.5
    with canvas(width, height, path, layout="none") as figure:
        places = int(labels.max()) + 1
        title = f"{len(labels)} photos of {places} places"
        figure.text(0.15 / width, 1 - 0.12 / height, title, fontsize=14, weight="bold", va="top")
        figure.text(0.15 / width, 1 - 0.42 / height, below, fontsize=8.5, color=GREY, va="top")
        for number, stage in enumerate(found):
            positions = tsne(stage.values, perplexity)
            same = stage.same_place(labels)
            shares.append(100.0 * float(same.mean()))
            left = 0.15 + 4.1 * number
            axes = figure.add_axes((left / width, 0.36 / height, 3.95 / width, 3.95 / height))
            for place in range(places):
                at = positions[labels == place]
                colour, marker = HUES[place % len(HUES)], MARKERS[place // len(HUES) % len(MARKERS)]
                axes.scatter(*at.T, s=20, color=colour, marker=marker, lw=0, alpha=0.9)
            axes.scatter(*positions[~same].T, s=60, facecolors="none", edgecolors=RED, linewidths=0.8)
            axes.set(xticks=[], yticks=[])
            axes.grid(False)
            for spine in axes.spines.values():
                spine.set(visible=True, color="#c5cad1")
            axes.set_title(f"({'abcdefgh'[number]}) {stage.title}", fontsize=11, pad=18)
            text = f"nearest photo of the same place: {shares[-1]:.1f} %"
            axes.text(0, 1.015, text, transform=axes.transAxes, fontsize=8.5, color=GREY, va="bottom")
        note = "t-SNE keeps neighbourhoods: distances between clusters mean nothing. "
        note += "Red ring: the nearest photo, in the full space, shows another place."
        figure.text(0.15 / width, 0.12 / height, note, fontsize=8, color=GREY)
    return shares


@dataclass(frozen=True)
class Difference:
    """Queries that one of two methods answers rightly at first and the other does not (rows of the set)."""

    ours: np.ndarray
    """ours right, the baseline wrong"""
    baseline: np.ndarray
    """the reverse"""


def differences(evaluated: EvaluationSet, ours: Result, baseline: Result) -> Difference:
    """Where the first answers of two results differ in being right."""
    a = first_hits(ours.predictions, evaluated.positives) == 0
    b = first_hits(baseline.predictions, evaluated.positives) == 0
    return Difference(np.flatnonzero(a & ~b), np.flatnonzero(b & ~a))


def retrieval_comparison(
    evaluated: EvaluationSet, results: Sequence[tuple[str, Result]], path: Path, count: int = 6
) -> Difference:
    """Query, then the first answer of each method, ours first; on queries where ours and the first baseline differ.

    Rows are shared between the two kinds of difference as the queries are, at least one for each that occurs, and
    spread evenly over the set.

    Raises:
        UsageError: they nowhere differ.
    """
    (name, ours), (other, baseline), *_ = results
    found = differences(evaluated, ours, baseline)
    both = len(found.ours) + len(found.baseline)
    if not both:
        raise UsageError(f"{evaluated.name}: '{name}' and '{other}' are right on the same queries: nothing to draw")
    reverse = min(len(found.baseline), max(round(count * len(found.baseline) / both), int(len(found.baseline) > 0)))
    rows = [*_spread(found.ours, max(count - reverse, int(len(found.ours) > 0))), *_spread(found.baseline, reverse)]
    tile = (TILE, round(TILE / usual_aspect([evaluated.queries[q] for q in rows])))
    wide, gap, label, head = 2.2, 0.16, 0.56, 1.3
    high = wide * tile[1] / tile[0]
    width, height = gap + (1 + len(results)) * (wide + gap), head + len(rows) * (high + label)
    width = max(width, 7.2)
    with canvas(width, height, path, layout="none") as figure:

        def say(inches: float, text: str, **style: Any) -> None:
            figure.text(gap / width, 1 - inches / height, text, va="top", **style)

        say(0.13, "First answers where the methods differ", fontsize=14, fontweight="bold")
        say(0.42, "\n".join(f"{n}: {caption(r)}" for n, r in results[:2]), fontsize=8.5, color=GREY, linespacing=1.35)
        text = f"{name} alone right: {len(found.ours)} queries; {other} alone right: {len(found.baseline)}"
        say(0.84, f"{text}; of {ours.queries:,}", fontsize=8.5, color=INK)
        for row, query in enumerate(rows):
            top = head + row * (high + label)
            for column, result in enumerate([None, *(result for _, result in results)]):
                at = gap + column * (wide + gap)
                axes = figure.add_axes((at / width, 1 - (top + high) / height, wide / width, high / height))
                if result is None:
                    photo_tile(axes, evaluated.queries[query], tile, INK, "query", short_name(evaluated.queries[query]))
                    continue
                answer = int(result.predictions[query, 0])
                right = is_right(evaluated, result, query, 0)
                text = f"{'✓' if right else '✗'} {results[column - 1][0]}"
                note = f"{metres_text(evaluated, query, answer)}d² {result.distances[query, 0]:.3f}"
                note += f"\n{short_name(evaluated.database[answer])}"
                photo_tile(axes, evaluated.database[answer], tile, GREEN if right else RED, text, note)
    return found


def _spread(rows: np.ndarray, count: int) -> list[int]:
    """`count` of the rows, evenly over them."""
    at = np.unique(np.linspace(0, len(rows) - 1, min(count, len(rows))).round().astype(int))
    return [int(row) for row in rows[at]]
