"""Pictures of an evaluation: retrieval grids, recall curves, what the backbone looks at.

Invariant: every picture names its set, protocol and recall; green is a correct answer and red a wrong one, everywhere,
with a sign beside the colour for those who do not see it. Files are drawn without a display (Agg).
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pipeline.common.files import naming
from pipeline.common.text import printable
from pipeline.config.image_size import ImageSize, input_size
from pipeline.data.images import load_image, normalise, to_input
from pipeline.evaluation.describe.encode import by_shape
from pipeline.evaluation.evaluate import Result
from pipeline.evaluation.recall import first_hits
from pipeline.evaluation.sets.evaluation_set import EvaluationSet

GREEN, RED, BLUE, GREY, INK = "#1a9850", "#d73027", "#3b6fb6", "#8a8f98", "#22262d"
CURVES = ("#3b6fb6", "#e08214", "#1a9850", "#8e5ba6", "#d73027", "#5f6b7a", "#17a2b8", "#b5651d")
DPI = 110
PAPER_DPI = 300
TILE = 585  # width of a photo in a grid, pixels: 1.95 inches at 300 dpi; fitted in, never cropped or stretched
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
    "text.parse_math": False,  # a dollar sign in a file's name is one
    "pdf.fonttype": 42,  # letters stay letters
    "svg.fonttype": "none",
    "svg.hashsalt": "figures",  # the same picture, the same bytes
}
VECTOR = (".pdf", ".svg")
Kind = Literal["correct", "failures", "worst"]


_also: ContextVar[tuple[str, ...]] = ContextVar("also", default=())


@contextmanager
def also_as(formats: Sequence[str]) -> Iterator[None]:
    """Figures drawn inside are also written as .pdf, .svg or .png beside their file: vectors, photos at 300 dpi."""
    token = _also.set(tuple(formats))
    try:
        yield
    finally:
        _also.reset(token)


@contextmanager
def canvas(width: float, height: float, path: Path, layout: Any = "constrained", dpi: int = DPI) -> Iterator[Any]:
    """A figure in the house style, inches, saved to `path` at the end.

    .png, .jpg for photos, or .pdf and .svg, whose photos have 300 dpi whatever `dpi` is; also in the formats of
    `also_as`.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # a letter in a name that the font does not have is drawn as a box
        figure = Figure(figsize=(width, height), layout=layout)
        FigureCanvasAgg(figure)
        yield figure
        vector = path.suffix in VECTOR
        jpeg: Any = {"pil_kwargs": {"quality": 88}} if path.suffix == ".jpg" else {}
        path.parent.mkdir(parents=True, exist_ok=True)
        with naming(path):
            figure.savefig(path, dpi=PAPER_DPI if vector else dpi, metadata=_undated(path), **jpeg)
        for ending in _also.get():
            # beside x.jpg a photo figure's x.png; beside x.png, which is there at screen size, x.300dpi.png
            other = (
                path.with_suffix(f".{ending}") if path.suffix != f".{ending}" else path.with_suffix(f".300dpi.{ending}")
            )
            with naming(other):
                figure.savefig(other, dpi=PAPER_DPI, metadata=_undated(other))


def _undated(path: Path) -> Any:
    """Metadata that leaves the date out: the same results give the same file."""
    return {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}.get(path.suffix)


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
    missed = any(not is_right(evaluated, result, q, 0) for q in chosen)
    columns = 1 + answers + int(missed)
    tile = (TILE, round(TILE / usual_aspect([evaluated.queries[q] for q in chosen])))
    # laid out by hand, in inches: automatic layout of this many axes takes seconds
    wide, gap, label, head = 1.95, 0.14, 0.56, 0.86
    high = wide * tile[1] / tile[0]
    width, height = gap + columns * (wide + gap), head + len(chosen) * (high + label)
    with canvas(width, height, path, layout="none") as figure:
        figure.text(gap / width, 1 - 0.14 / height, title, fontsize=14, fontweight="bold", va="top")
        figure.text(gap / width, 1 - 0.42 / height, caption(result), fontsize=9.5, color=GREY, va="top")

        def place(row: int, column: int) -> Any:
            left, top = gap + column * (wide + gap), head + row * (high + label)
            return figure.add_axes((left / width, 1 - (top + high) / height, wide / width, high / height))

        for row, query in enumerate(chosen):
            photo_tile(
                place(row, 0), evaluated.queries[query], tile, INK, "query", short_name(evaluated.queries[query])
            )
            for rank in range(answers):
                found = int(result.predictions[query, rank])
                if found < 0:  # the database is smaller
                    continue
                right = is_right(evaluated, result, query, rank)
                text = f"{'✓' if right else '✗'} {rank + 1}"
                note = f"{metres_text(evaluated, query, found)}d² {result.distances[query, rank]:.3f}"
                note += f"\n{short_name(evaluated.database[found])}"
                colour = GREEN if right else RED
                photo_tile(place(row, 1 + rank), evaluated.database[found], tile, colour, text, note)
            if not is_right(evaluated, result, query, 0) and len(evaluated.positives[query]):
                positive = int(evaluated.positives[query][0])
                ranks = np.flatnonzero(np.isin(result.predictions[query], evaluated.positives[query]))
                where = (
                    f"first right answer: {ranks[0] + 1}"
                    if len(ranks)
                    else f"none in {result.predictions.shape[1]} answers"
                )
                where += f"\n{short_name(evaluated.database[positive])}"
                photo_tile(place(row, columns - 1), evaluated.database[positive], tile, BLUE, "a positive", where)


def answer_grid(
    rows: Sequence[tuple[Path, Sequence[tuple[Path, str]]]],
    path: Path,
    title: str,
    below: str,
    right: Sequence[Sequence[bool | None]] | None = None,
) -> None:
    """A row for each photo that asked: the photo, then its (answer, label) pairs.

    `right`: of each answer, for a green or a red frame; None, and all of them without it: not known, a blue frame.

    Labels have one or two lines: above the answer, and below it over the name of its file. An answer whose file is no
    longer there leaves an empty tile that says so.
    """
    columns = 1 + max(len(answers) for _, answers in rows)
    tile = (TILE, round(TILE / usual_aspect([photo for photo, _ in rows])))
    wide, gap, label, head = 1.95, 0.14, 0.56, 0.86
    high = wide * tile[1] / tile[0]
    width, height = max(5.0, gap + columns * (wide + gap)), head + len(rows) * (high + label)
    with canvas(width, height, path, layout="none") as figure:
        figure.text(gap / width, 1 - 0.14 / height, title, fontsize=14, fontweight="bold", va="top")
        figure.text(gap / width, 1 - 0.42 / height, below, fontsize=9.5, color=GREY, va="top")
        for row, (photo, answers) in enumerate(rows):
            shown = [(photo, INK, "where is this?", short_name(photo))]
            for rank, (file, text) in enumerate(answers, 1):
                above, _, note = text.partition("\n")
                known = None if right is None else right[row][rank - 1]
                colour, sign = {True: (GREEN, "✓ "), False: (RED, "✗ "), None: (BLUE, "")}[known]
                shown.append((file, colour, f"{sign}{rank}   {above}", f"{note}\n{short_name(file)}".strip()))
            for column, (file, colour, text, note) in enumerate(shown):
                left, top = gap + column * (wide + gap), head + row * (high + label)
                box = (left / width, 1 - (top + high) / height, wide / width, high / height)
                if file.is_file():
                    photo_tile(figure.add_axes(box), file, tile, colour, text, note)
                else:
                    figure.text(box[0], box[1] + box[3] / 2, f"{text}\n(no longer there)", fontsize=8, color=GREY)


def recall_curves(curves: Mapping[str, np.ndarray], path: Path, title: str, below: str = "", queries: int = 0) -> None:
    """Recall@N over N, one line for each name (a protocol, a run): percent [n] for N = 1 ... n (`curve_of`).

    Names whose curves are the same share a line. With the number of `queries` each curve has its 95 % interval.
    """
    with canvas(7.4, 4.6, path) as figure:
        axes = figure.subplots()
        together = collapse(curves)
        longest = max(len(curve) for curve in curves.values())
        lowest = min(float(curve.min()) for curve in curves.values())
        for number, (name, curve) in enumerate(together.items()):
            style: dict[str, Any] = {"color": CURVES[number % len(CURVES)], "lw": 1.8, "ms": 4}
            style |= {"ls": ("-", "--", "-.", ":")[number % 4], "marker": "osD^vP*X"[number % 8]}
            n = np.arange(1, len(curve) + 1)
            if queries:
                low, high = wilson(curve, queries)
                axes.fill_between(n, low, high, color=style["color"], alpha=0.13, lw=0)
            axes.plot(n, curve, label=f"{name}   R@1 {curve[0]:.1f}", **style)
        axes.set(xlabel="N, answers looked at", ylabel="Recall@N  (%)", xlim=(0.7, longest + 0.3))
        if queries:
            below += " · shaded: 95 % interval over queries"
        heading(axes, title, below)
        axes.set_ylim(max(0, lowest - 6), 101)
        ticks = [n for n in (1, 5, 10, 15, 20, 25, 50, 100) if n <= longest]
        axes.set_xticks(ticks)
        axes.legend(loc="lower right")


def precision_recall_curves(curves: Mapping[str, tuple[np.ndarray, np.ndarray, str]], path: Path, below: str) -> None:
    """Precision over recall, one line a protocol: name -> (precision [t], recall [t] in 0 ... 1, a note)."""
    with canvas(7.4, 4.8, path) as figure:
        axes = figure.subplots()
        for number, (name, (precision, recall, note)) in enumerate(curves.items()):
            axes.step(100 * recall, 100 * precision, where="post", color=CURVES[number % len(CURVES)], lw=1.8,
                      ls=("-", "--", "-.", ":")[number % 4], label=f"{name}   {note}")  # fmt: skip
        axes.set(xlabel="Recall  (% of the queries that have a right answer)", ylabel="Precision  (%)")
        axes.set(xlim=(-1, 101), ylim=(-1, 102))
        heading(axes, "First answers accepted up to a distance", below)
        axes.legend(loc="lower left")


def collapse(curves: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Curves that are the same number for number, under their names joined by "="."""
    names: dict[tuple[float, ...], list[str]] = {}
    for name, curve in curves.items():
        names.setdefault(tuple(np.asarray(curve, float).tolist()), []).append(name)
    return {" = ".join(same): np.array(curve) for curve, same in names.items()}


def wilson(percent: np.ndarray, queries: int) -> tuple[np.ndarray, np.ndarray]:
    """The 95 % Wilson score interval, in percent, of shares measured on so many independent queries (Wilson, 1927)."""
    z, share = 1.959964, np.asarray(percent, float) / 100
    middle = (share + z * z / (2 * queries)) / (1 + z * z / queries)
    half = z / (1 + z * z / queries) * np.sqrt(share * (1 - share) / queries + (z / (2 * queries)) ** 2)
    return 100 * (middle - half), 100 * (middle + half)


def curve_of(evaluated: EvaluationSet, result: Result) -> np.ndarray:
    """Recall@1 ... Recall@K in percent, [K], under the result's own policy for queries without positives."""
    ranks = first_hits(result.predictions, evaluated.positives)
    if result.protocol.without_positives == "drop":
        ranks = ranks[np.fromiter((len(p) > 0 for p in evaluated.positives), bool, len(ranks))]
    within = (ranks[:, None] >= 0) & (ranks[:, None] < np.arange(1, result.predictions.shape[1] + 1))
    return 100.0 * within.mean(axis=0)


def attention_maps(model: Any, photos: Sequence[Path]) -> list[np.ndarray]:
    """Channel means of the patch tokens of photos (paper, Fig. 1): for each float32 [h, w].

    `model.backbone(images [n, 3, H, W]) -> [n, 1 + h*w, D]`, in eval mode, on any device.
    """
    import torch

    maps: dict[int, np.ndarray] = {}
    device, size = next(model.parameters()).device, input_size(model)
    for rows, images in by_shape(to_input(load_image(photo), size) for photo in photos):
        with torch.no_grad():
            tokens = model.backbone(normalise(images.to(device))).float().cpu()
        grid = model.backbone.grid_of(*images.shape[-2:])
        maps |= zip(rows, tokens[:, 1:].mean(-1).unflatten(1, grid).numpy(), strict=True)
    return [maps[row] for row in range(len(photos))]


def attention_overlay(model: Any, photos: Sequence[Path], path: Path, title: str) -> None:
    """Photos above their `attention_maps`, each map scaled to its own range."""
    maps, size = attention_maps(model, photos), input_size(model)
    with canvas(2.0 * len(photos), 4.55, path) as figure:
        figure.suptitle(title, x=0.008, ha="left", fontsize=13, fontweight="bold")
        axes = figure.subplots(2, len(photos), squeeze=False)
        for i, photo in enumerate(photos):
            pixels = as_seen(photo, size)
            axes[0, i].imshow(pixels)
            axes[0, i].set_title(short_name(photo), fontsize=8, fontweight="normal", loc="center")
            lay_over(axes[1, i], pixels, maps[i], alpha=0.65)
            for ax in axes[:, i]:
                ax.axis("off")


def as_seen(photo: Path, size: ImageSize) -> np.ndarray:
    """A photo in the shape in which a model sees it, its longest side of at least 224 pixels: uint8 [H, W, 3]."""
    image = load_image(photo)
    shape = size.of_photo(image.height, image.width)
    larger = max(1.0, 224 / max(shape))
    height, width = (round(side * larger) for side in shape)
    return np.asarray(to_input(image, ImageSize(height, width)).permute(1, 2, 0).numpy())


def lay_over(axes: Any, pixels: np.ndarray, heat: np.ndarray, **style: Any) -> None:
    """A map [h, w] over the photo [H, W, 3] that it is of: both fill the photo's shape, whatever their sizes."""
    height, width = np.array(pixels.shape[:2]) / max(pixels.shape[:2])
    whole = (0, width, height, 0)
    axes.imshow(pixels, extent=whole)
    axes.imshow(heat, extent=whole, cmap="inferno", **{"interpolation": "bicubic", **style})


def photo_tile(axes: Any, photo: Path, tile: tuple[int, int], colour: str, text: str, note: str) -> None:
    """A photo fitted into the tile, in a frame of its colour, with a label above and a note below."""
    from PIL import Image, ImageOps

    image = load_image(photo)
    image = ImageOps.contain(image, tile, Image.Resampling.LANCZOS)  # enlarges small photos too
    shown = Image.new("RGB", tile, "#f1f3f5")
    shown.paste(image, ((tile[0] - image.width) // 2, (tile[1] - image.height) // 2))
    axes.imshow(np.asarray(shown), aspect="auto", interpolation="antialiased")
    axes.set(xticks=[], yticks=[])
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set(visible=True, color=colour, linewidth=3.2)
    axes.set_title(text, fontsize=9, color=colour, pad=4, loc="left")
    axes.set_xlabel(note, fontsize=7.5, color=GREY, labelpad=3)


def usual_aspect(photos: Sequence[Path]) -> float:
    """Width over height that suits most of the photos, between upright 3:4 and 16:9."""
    sizes = [load_image(photo).size for photo in photos]
    return float(np.clip(np.median([w / h for w, h in sizes]), 0.75, 16 / 9))


def is_right(evaluated: EvaluationSet, result: Result, query: int, place: int) -> bool:
    """Whether the answer at `place` of a query is a positive."""
    return bool(np.isin(result.predictions[query, place], evaluated.positives[query]))


def metres_text(evaluated: EvaluationSet, query: int, found: int) -> str:
    """How far an answer lies from its query, with a separator behind it; empty where positions are not known."""
    if evaluated.database_positions is None or evaluated.query_positions is None:
        return ""
    far = float(np.linalg.norm(evaluated.database_positions[found] - evaluated.query_positions[query]))
    return f"{far:,.0f} m · " if far < 10_000 else f"{far / 1000:,.0f} km · "


def short_name(path: Path, longest: int = 26) -> str:
    """The file's name; of `@utm` names, that never fit, their first fields."""
    name = printable(path.stem if not path.stem.startswith("@") else ", ".join(path.stem.split("@")[1:3]))
    return name if len(name) <= longest else name[: longest - 1] + "…"
