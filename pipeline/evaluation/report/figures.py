"""Pictures of an evaluation: retrieval grids, recall curves, what the backbone looks at.

Invariant: every picture names its set, protocol and recall; green is a correct answer and red a wrong one, everywhere,
with a sign beside the colour for those who do not see it. Files are drawn without a display (Agg).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pipeline.data.images import load_image, normalise, to_input
from pipeline.evaluation.evaluate import Result
from pipeline.evaluation.recall import first_hits
from pipeline.evaluation.sets.evaluation_set import EvaluationSet

GREEN, RED, BLUE, GREY, INK = "#1a9850", "#d73027", "#3b6fb6", "#8a8f98", "#22262d"
CURVES = ("#3b6fb6", "#e08214", "#1a9850", "#8e5ba6", "#d73027", "#5f6b7a", "#17a2b8", "#b5651d")
DPI = 110
TILE = 300  # width of a photo in a grid, pixels; photos are fitted in, never cropped or stretched
STYLE: Any = {
    "font.family": "sans-serif",
    "font.size": 10,
    "axes.titlesize": 12,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelcolor": INK,
    "axes.edgecolor": "#c5cad1",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e8eaee",
    "axes.axisbelow": True,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
}
Kind = Literal["correct", "failures", "worst"]


@contextmanager
def canvas(width: float, height: float, path: Path, layout: Any = "constrained") -> Iterator[Any]:
    """A figure in the house style, inches, saved to `path` at the end (.png, or .jpg for photos)."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(width, height), layout=layout)
        FigureCanvasAgg(figure)
        yield figure
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=DPI, pil_kwargs={"quality": 88} if path.suffix == ".jpg" else {})


def heading(axes: Any, title: str, below: str) -> None:
    """A bold title, and what it is about in grey below it."""
    axes.set_title(title, pad=24)
    axes.text(0, 1.02, below, transform=axes.transAxes, fontsize=8.5, color=GREY, va="bottom", in_layout=False)


def caption(result: Result) -> str:
    """Set, protocol, recall: the line under every picture."""
    recalls = ", ".join(f"R@{k} {value:.1f}" for k, value in result.recalls.items())
    return f"{result.set_name} · {result.protocol.name} · {recalls or 'not scored'}"


def choose(evaluated: EvaluationSet, result: Result, kind: Kind, count: int = 6) -> list[int]:
    """Query rows worth looking at, spread evenly over the set; none where there are none of that kind.

    correct: the first answer is right. failures: it is wrong. worst: no answer is right, the farthest from the truth
    first where positions are known, else the most confident (nearest) wrong answers.
    """
    ranks = first_hits(result.predictions, evaluated.positives)
    known = np.fromiter((len(p) > 0 for p in evaluated.positives), bool, len(ranks))
    if kind == "worst":
        rows = np.flatnonzero((ranks < 0) & known)
        metres = errors_in_metres(evaluated, result)
        order = result.distances[rows, 0] if metres is None else -metres[rows]
        picked: list[int] = []
        for row in rows[np.argsort(order, kind="stable")]:
            # neighbours in a sequence show the same error again
            if all(abs(int(row) - other) > result.queries // 40 for other in picked):
                picked.append(int(row))
        return picked[:count]
    rows = np.flatnonzero(ranks == 0 if kind == "correct" else (ranks != 0) & known)
    return [int(row) for row in rows[np.unique(np.linspace(0, len(rows) - 1, min(count, len(rows))).astype(int))]]


def errors_in_metres(evaluated: EvaluationSet, result: Result) -> np.ndarray | None:
    """Distance from each query to its first answer, metres [Q]; None where the set has no positions."""
    if evaluated.database_positions is None or evaluated.query_positions is None:
        return None
    offsets = evaluated.database_positions[result.predictions[:, 0]] - evaluated.query_positions
    return np.asarray(np.hypot(offsets[:, 0], offsets[:, 1]))


def retrieval_grid(
    evaluated: EvaluationSet, result: Result, chosen: Sequence[int], path: Path, title: str, answers: int = 5
) -> None:
    """A row for each chosen query: the query, its first answers framed green or red, a positive where it was missed."""
    answers = min(answers, result.predictions.shape[1])
    missed = any(not _correct(evaluated, result, q, 0) for q in chosen)
    columns = 1 + answers + int(missed)
    tile = (TILE, round(TILE / _aspect([evaluated.queries[q] for q in chosen])))
    # laid out by hand, in inches: automatic layout of this many axes takes seconds
    wide, gap, label, head = 1.95, 0.14, 0.44, 0.86
    high = wide * tile[1] / tile[0]
    width, height = gap + columns * (wide + gap), head + len(chosen) * (high + label)
    with canvas(width, height, path, layout="none") as figure:
        figure.text(gap / width, 1 - 0.14 / height, title, fontsize=14, fontweight="bold", va="top")
        figure.text(gap / width, 1 - 0.42 / height, caption(result), fontsize=9.5, color=GREY, va="top")

        def place(row: int, column: int) -> Any:
            left, top = gap + column * (wide + gap), head + row * (high + label)
            return figure.add_axes((left / width, 1 - (top + high) / height, wide / width, high / height))

        for row, query in enumerate(chosen):
            _photo(place(row, 0), evaluated.queries[query], tile, INK, "query", _short(evaluated.queries[query]))
            for rank in range(answers):
                found = int(result.predictions[query, rank])
                if found < 0:  # the database is smaller
                    continue
                right = _correct(evaluated, result, query, rank)
                text = f"{'✓' if right else '✗'} {rank + 1}"
                note = f"{_metres(evaluated, query, found)}d² {result.distances[query, rank]:.3f}"
                colour = GREEN if right else RED
                _photo(place(row, 1 + rank), evaluated.database[found], tile, colour, text, note)
            if not _correct(evaluated, result, query, 0) and len(evaluated.positives[query]):
                positive = int(evaluated.positives[query][0])
                ranks = np.flatnonzero(np.isin(result.predictions[query], evaluated.positives[query]))
                where = (
                    f"first right answer: {ranks[0] + 1}"
                    if len(ranks)
                    else f"none in {result.predictions.shape[1]} answers"
                )
                _photo(place(row, columns - 1), evaluated.database[positive], tile, BLUE, "a positive", where)


def answer_grid(rows: Sequence[tuple[Path, Sequence[tuple[Path, str]]]], path: Path, title: str, below: str) -> None:
    """A row for each photo that asked: the photo, then its (answer, label) pairs; nobody knows which are right.

    Labels have one or two lines: above and below the answer; without a second line its name is below. An answer whose
    file is no longer there leaves an empty tile that says so.
    """
    columns = 1 + max(len(answers) for _, answers in rows)
    tile = (TILE, round(TILE / _aspect([photo for photo, _ in rows])))
    wide, gap, label, head = 1.95, 0.14, 0.44, 0.86
    high = wide * tile[1] / tile[0]
    width, height = max(5.0, gap + columns * (wide + gap)), head + len(rows) * (high + label)
    with canvas(width, height, path, layout="none") as figure:
        figure.text(gap / width, 1 - 0.14 / height, title, fontsize=14, fontweight="bold", va="top")
        figure.text(gap / width, 1 - 0.42 / height, below, fontsize=9.5, color=GREY, va="top")
        for row, (photo, answers) in enumerate(rows):
            shown = [(photo, INK, "where is this?", _short(photo))]
            for rank, (file, text) in enumerate(answers, 1):
                above, _, note = text.partition("\n")
                shown.append((file, BLUE, f"{rank}   {above}", note or _short(file)))
            for column, (file, colour, text, note) in enumerate(shown):
                left, top = gap + column * (wide + gap), head + row * (high + label)
                box = (left / width, 1 - (top + high) / height, wide / width, high / height)
                if file.is_file():
                    _photo(figure.add_axes(box), file, tile, colour, text, note)
                else:
                    figure.text(box[0], box[1] + box[3] / 2, f"{text}\n(no longer there)", fontsize=8, color=GREY)


def recall_curves(curves: Mapping[str, np.ndarray], path: Path, title: str, below: str = "") -> None:
    """Recall@N over N, one line for each name (a protocol, a run): percent [n] for N = 1 ... n (`curve_of`)."""
    with canvas(7.4, 4.6, path) as figure:
        axes = figure.subplots()
        longest = max(len(curve) for curve in curves.values())
        lowest = min(float(curve.min()) for curve in curves.values())
        for number, (name, curve) in enumerate(curves.items()):
            # lines that coincide stay visible: later ones are thinner and broken
            style: dict[str, Any] = {"color": CURVES[number % len(CURVES)], "lw": max(1.4, 3.0 - 0.7 * number)}
            style |= {"ls": ("-", "--", "-.", ":")[number % 4], "marker": "osD^vP*X"[number % 8], "ms": 4}
            axes.plot(np.arange(1, len(curve) + 1), curve, label=f"{name}   R@1 {curve[0]:.1f}", **style)
        axes.set(xlabel="N, answers looked at", ylabel="Recall@N  (%)", xlim=(0.7, longest + 0.3))
        heading(axes, title, below)
        axes.set_ylim(max(0, lowest - 6), 101)
        ticks = [n for n in (1, 5, 10, 15, 20, 25, 50, 100) if n <= longest]
        axes.set_xticks(ticks)
        axes.legend(loc="lower right")


def curve_of(evaluated: EvaluationSet, result: Result) -> np.ndarray:
    """Recall@1 ... Recall@K in percent, [K], under the result's own policy for queries without positives."""
    ranks = first_hits(result.predictions, evaluated.positives)
    if result.protocol.without_positives == "drop":
        ranks = ranks[np.fromiter((len(p) > 0 for p in evaluated.positives), bool, len(ranks))]
    within = (ranks[:, None] >= 0) & (ranks[:, None] < np.arange(1, result.predictions.shape[1] + 1))
    return 100.0 * within.mean(axis=0)


def attention_maps(model: Any, photos: Sequence[Path]) -> np.ndarray:
    """Channel means of the patch tokens of photos (paper, Fig. 1): float32 [n, G, G].

    `model.backbone(images [n, 3, S, S]) -> [n, 1 + G*G, D]`, in eval mode, on any device.
    """
    import torch

    inputs = torch.stack([to_input(load_image(photo), int(model.image_size)) for photo in photos])
    with torch.no_grad():
        tokens = model.backbone(normalise(inputs.to(next(model.parameters()).device))).float().cpu()
    side = math.isqrt(tokens.shape[1] - 1)
    return np.asarray(tokens[:, 1:].mean(-1).reshape(-1, side, side).numpy())


def attention_overlay(model: Any, photos: Sequence[Path], path: Path, title: str) -> None:
    """Photos above their `attention_maps`, each map scaled to its own range."""
    maps, size = attention_maps(model, photos), int(model.image_size)
    with canvas(2.0 * len(photos), 4.9, path) as figure:
        figure.suptitle(title, x=0.008, ha="left", fontsize=13, fontweight="bold")
        axes = figure.subplots(2, len(photos), squeeze=False)
        for i, photo in enumerate(photos):
            pixels = to_input(load_image(photo), size).permute(1, 2, 0).numpy()
            axes[0, i].imshow(pixels)
            axes[0, i].set_title(_short(photo), fontsize=8, fontweight="normal", loc="center")
            axes[1, i].imshow(pixels)
            axes[1, i].imshow(maps[i], cmap="inferno", alpha=0.65, extent=(0, size, size, 0), interpolation="bilinear")
            for ax in axes[:, i]:
                ax.axis("off")


def _photo(axes: Any, photo: Path, tile: tuple[int, int], colour: str, text: str, note: str) -> None:
    """A photo fitted into the tile, in a frame of its colour, with a label above and a note below."""
    from PIL import Image

    image = load_image(photo)
    image.thumbnail(tile, Image.Resampling.LANCZOS)
    shown = Image.new("RGB", tile, "#f1f3f5")
    shown.paste(image, ((tile[0] - image.width) // 2, (tile[1] - image.height) // 2))
    axes.imshow(np.asarray(shown), aspect="auto", interpolation="antialiased")
    axes.set(xticks=[], yticks=[])
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set(visible=True, color=colour, linewidth=3.2)
    axes.set_title(text, fontsize=9, color=colour, pad=4, loc="left")
    axes.set_xlabel(note, fontsize=7.5, color=GREY, labelpad=3)


def _aspect(photos: Sequence[Path]) -> float:
    """Width over height that suits most of the photos, between upright 3:4 and 16:9."""
    sizes = [load_image(photo).size for photo in photos]
    return float(np.clip(np.median([w / h for w, h in sizes]), 0.75, 16 / 9))


def _correct(evaluated: EvaluationSet, result: Result, query: int, place: int) -> bool:
    return bool(np.isin(result.predictions[query, place], evaluated.positives[query]))


def _metres(evaluated: EvaluationSet, query: int, found: int) -> str:
    if evaluated.database_positions is None or evaluated.query_positions is None:
        return ""
    far = float(np.linalg.norm(evaluated.database_positions[found] - evaluated.query_positions[query]))
    return f"{far:,.0f} m · " if far < 10_000 else f"{far / 1000:,.0f} km · "


def _short(path: Path, longest: int = 26) -> str:
    """The file's name; of `@utm` names, that never fit, their first fields."""
    name = path.stem if not path.stem.startswith("@") else ", ".join(path.stem.split("@")[1:3])
    return name if len(name) <= longest else name[: longest - 1] + "…"
