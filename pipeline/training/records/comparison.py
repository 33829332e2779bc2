"""Recorded runs side by side: their metrics, and only the settings in which they differ.

Invariant: numbers come from the MLflow store as recorded, each under the name that carries its protocol; recalls of
different protocols are different rows, never averaged or mixed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.common.errors import UsageError
from pipeline.common.text import Table
from pipeline.evaluation.protocol import read_metric_name
from pipeline.training.records.tracking import open_client

# where runs are recorded, how often and how fast, not what they are
UNINTERESTING = (
    "name", "output", "tracking.", "data.workers", "data.prefetch", "data.cache", "validate.workers",
    "train.log_", "train.resume", "train.save_every", "train.keep", "train.timeout",
)  # fmt: skip


@dataclass(frozen=True)
class Run:
    """A recorded run.

    Attributes:
        name: as given by the user; made unique by the MLflow id where several share it.
        run_id: MLflow's.
        experiment: MLflow's id of it.
        status: MLflow's ("FINISHED", "RUNNING", "KILLED", "FAILED").
        params: flat settings as text.
        metrics: newest value by metric name.
        history: (step, value) of each recall metric recorded at more than one step.
    """

    name: str
    run_id: str
    experiment: str
    status: str
    params: dict[str, str]
    metrics: dict[str, float]
    history: dict[str, list[tuple[int, float]]]


def load_runs(uri: str, experiment: str, wanted: Sequence[str] = ()) -> list[Run]:
    """Runs of an experiment, oldest first: those named (by name or id), or the newest of each name.

    Raises:
        UsageError: no such experiment, no such run (the known ones are listed), or nothing recorded.
    """
    if uri.startswith("sqlite:///") and not Path(uri.removeprefix("sqlite:///")).is_file():
        raise UsageError(f"{uri.removeprefix('sqlite:///')}: there is no record of runs; give --output or --uri")
    client = open_client(uri)
    found = client.get_experiment_by_name(experiment)
    if found is None:
        known = ", ".join(e.name for e in client.search_experiments())
        raise UsageError(f"{uri} has no experiment '{experiment}'; it has: {known}")
    entries: list[Any] = []
    token = None
    while True:
        page = client.search_runs([found.experiment_id], order_by=["attributes.start_time ASC"], page_token=token)
        entries += list(page)
        token = page.token
        if not token:
            break
    if not entries:
        raise UsageError(f"experiment '{experiment}' in {uri} has no runs yet; train one first")
    if wanted:
        chosen = []
        for key in wanted:
            matches = [e for e in entries if key in (e.info.run_name, e.info.run_id)]
            if not matches:
                names = sorted({e.info.run_name for e in entries})
                raise UsageError(f"experiment '{experiment}' has no run '{key}'; it has: {', '.join(names)}")
            chosen.append(matches[-1])
    else:
        chosen = list({e.info.run_name: e for e in entries}.values())
    names = [e.info.run_name for e in chosen]
    runs = []
    for entry in chosen:
        name = entry.info.run_name
        if names.count(name) > 1:
            name = f"{name} {entry.info.run_id[:6]}"
        metrics = {k: float(v) for k, v in sorted(entry.data.metrics.items())}
        history = {
            key: sorted((m.step, float(m.value)) for m in client.get_metric_history(entry.info.run_id, key))
            for key in metrics
            if key.startswith("validation/")
        }
        runs.append(
            Run(
                name,
                entry.info.run_id,
                found.experiment_id,
                entry.info.status,
                dict(entry.data.params),
                metrics,
                history,
            )
        )
    return runs


def differing_settings(runs: Sequence[Run]) -> list[tuple[str, list[str]]]:
    """(setting, value in each run) of the settings that are not the same in all runs."""
    keys = sorted({key for run in runs for key in run.params})
    rows = [(key, [run.params.get(key, "-") for run in runs]) for key in keys]
    return [(k, v) for k, v in rows if len(set(v)) > 1 and not k.startswith(UNINTERESTING)]


def metric_rows(runs: Sequence[Run]) -> list[tuple[str, list[float | None]]]:
    """(metric, value in each run): recalls first, by set, protocol and N; then loss and speed."""
    keys = {key for run in runs for key in run.metrics}

    def order(key: str) -> tuple[Any, ...]:
        recall = read_metric_name(key)
        if recall is None:
            return (2, key)
        return (0, {"evaluation": 0, "validation": 1}.get(recall[0], 2), *recall[1:])

    shown = [k for k in keys if read_metric_name(k) or k in ("train/loss", "train/images_per_second")]
    return [(key, [run.metrics.get(key) for run in runs]) for key in sorted(shown, key=order)]


def best(metric: str, values: Sequence[float | None]) -> set[int]:
    """Positions of the best value of a row where there is one: the highest recall, the lowest loss; else none."""
    present = [v for v in values if v is not None]
    if len(present) < 2 or len(set(present)) < 2 or not (read_metric_name(metric) or metric == "train/loss"):
        return set()
    target = min(present) if metric == "train/loss" else max(present)
    return {i for i, v in enumerate(values) if v == target}


def table(runs: Sequence[Run]) -> Table:
    """A head of run names, metric rows with the best marked, then the settings that differ."""
    rows: list[list[str]] = []
    marked: list[tuple[int, int]] = []
    for metric, values in metric_rows(runs):
        marked += [(len(rows), i + 1) for i in best(metric, values)]
        digits = 4 if metric == "train/loss" else 1
        rows.append([metric, *("-" if v is None else f"{v:.{digits}f}" for v in values)])
    for key, values_of_setting in differing_settings(runs):
        rows.append([key, *values_of_setting])
    if any(run.status != "FINISHED" for run in runs):
        rows.append(["status", *[run.status.lower() for run in runs]])
    return Table(["", *[run.name for run in runs]], rows, marked=marked)


def draw_curves(runs: Sequence[Run], path: Path) -> bool:
    """Recall@N over N for each set and protocol, and validation recall over steps; False when nothing is recorded."""
    panels: dict[str, dict[str, list[tuple[int, float]]]] = {}
    for run in runs:
        for key, value in run.metrics.items():
            if (recall := read_metric_name(key)) is not None:
                kind, set_name, protocol, k = recall
                if kind == "evaluation":
                    panels.setdefault(f"{set_name}, {protocol}", {}).setdefault(run.name, []).append((k, value))
    progress: dict[str, dict[str, list[tuple[int, float]]]] = {}
    for run in runs:
        for key, points in run.history.items():
            if (recall := read_metric_name(key)) is not None:
                _, set_name, protocol, k = recall
                if k == 5 and len(points) > 1:
                    progress.setdefault(f"validation {set_name}, {protocol}, R@5", {})[run.name] = points
    if not panels and not progress:
        return False
    from pipeline.evaluation.report.figures import CURVES, canvas

    drawn = [(t, c, "N, answers looked at") for t, c in _collapsed(panels).items()]
    drawn += [(t, c, "step") for t, c in _collapsed(progress).items()]
    columns = min(len(drawn), 3)
    rows = -(-len(drawn) // columns)
    colours = {run.name: CURVES[i % len(CURVES)] for i, run in enumerate(runs)}
    markers = {run.name: "osD^vP*X"[i % 8] for i, run in enumerate(runs)}
    with canvas(0.4 + 4.1 * columns, 0.7 + 3.1 * rows, path) as figure:
        figure.suptitle("Recall of the runs", x=0.01, ha="left", fontsize=14, fontweight="bold")
        axes = figure.subplots(rows, columns, squeeze=False)
        for number, (axis, (title, lines, label)) in enumerate(zip(axes.flat, drawn, strict=False)):
            for name, points in lines.items():
                style = {"color": colours[name], "marker": markers[name], "ms": 4, "lw": 1.8}
                axis.plot(*zip(*sorted(points), strict=True), label=name, **style)
            if label.startswith("N"):
                axis.set_xticks(sorted({k for points in lines.values() for k, _ in points}))
            axis.set(xlabel=label, ylabel="recall  (%)", ylim=(0, 102))
            axis.set_title(f"({chr(ord('a') + number % 26)}) {title}", fontsize=9.5)
        for axis in axes.flat[len(drawn) :]:
            axis.set_visible(False)
        handles = {
            label: line for axis in axes.flat for line, label in zip(*axis.get_legend_handles_labels(), strict=True)
        }
        figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=min(4, len(handles)))
    return True


def _collapsed(panels: dict[str, dict[str, list[tuple[int, float]]]]) -> dict[str, dict[str, list[tuple[int, float]]]]:
    """Panels of one set that show the same numbers, as protocols do to a model without cross-image encoder, as one."""
    titles: dict[tuple[str, str], list[str]] = {}
    for title in sorted(panels):
        set_name, _, rest = title.partition(", ")
        titles.setdefault((set_name, repr(sorted(panels[title].items()))), []).append(rest)
    firsts = {(s, key): f"{s}, {rest[0]}" for (s, key), rest in titles.items()}
    return {f"{s}, {' = '.join(rest)}": panels[firsts[s, key]] for (s, key), rest in titles.items()}
