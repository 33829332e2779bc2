"""`train.log` in the run's folder: a line for each record of metrics, and the curves that are drawn of them at the end.

A line is `step 120  train/loss 0.8123  train/lr 0.0001 ...`, with or without MLflow. Invariant: steps that a kill lost
after the last checkpoint are dropped when the run continues, so every step stands there once.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from pathlib import Path

from pipeline.common.files import naming, write_atomically

LOG, PICTURE = "train.log", "curves.png"
FEWEST = 20  # records; a curve of fewer says little, and costs the import of matplotlib


class RunLog:
    """Appends to `<run>/train.log`; a run that continues at `step` forgets what came later.

    Raises:
        OSError: it cannot be written.
    """

    def __init__(self, run: Path, step: int) -> None:
        self.file = run / LOG
        kept = [line for line in _lines(self.file) if int(line.split()[1]) <= step]
        write_atomically(self.file, "".join(f"{line}\n" for line in kept))

    def write(self, values: Mapping[str, float], step: int) -> None:
        """One line."""
        with naming(self.file), self.file.open("a") as log:
            log.write("  ".join([f"step {step}", *(f"{name} {value:.6g}" for name, value in values.items())]) + "\n")


def read(run: Path) -> dict[str, list[tuple[int, float]]]:
    """(step, value) of each metric in a run's log."""
    found: dict[str, list[tuple[int, float]]] = {}
    for line in _lines(run / LOG):
        first, *pairs = line.split("  ")
        for pair in pairs:
            name, _, value = pair.rpartition(" ")
            found.setdefault(name, []).append((int(first.split()[1]), float(value)))
    return found


def draw(run: Path, fewest: int = FEWEST) -> Path | None:
    """Loss and validation R@1 and R@5 over the steps as `<run>/curves.png`; None where there are fewer than `fewest`
    records, or matplotlib is not installed."""
    metrics = read(run)
    loss = metrics.get("train/loss", [])
    recalls = {name: points for name, points in metrics.items() if re.search(r"recall_at_[15]$", name)}
    if len(loss) < fewest:
        return None
    try:
        from matplotlib.figure import Figure
    except ImportError:
        print(f"{run / PICTURE} is not drawn: matplotlib is not installed", file=sys.stderr)
        return None
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    panels = figure.subplots(1, 2 if recalls else 1, squeeze=False)[0]
    panels[0].plot(*zip(*loss, strict=True))
    panels[0].set(xlabel="step", ylabel="loss", title=run.name)
    for name, points in sorted(recalls.items()):
        label = name.removeprefix("validation/").replace(".recall_at_", " R@")
        panels[1].plot(*zip(*points, strict=True), marker="o", label=label)
    if recalls:
        panels[1].set(xlabel="step", ylabel="recall, %", title="validation", ylim=(0, 100))
        panels[1].legend(fontsize="small")
    with naming(run / PICTURE):
        figure.savefig(run / PICTURE, dpi=150)
    return run / PICTURE


def _lines(file: Path) -> list[str]:
    """Whole lines; a kill may have cut the last."""
    text = file.read_text() if file.is_file() else ""
    return [line for line in text[: text.rfind("\n") + 1].splitlines() if re.match(r"step \d+  ", line)]
