"""The whole way on a drawn city, on two CPU processes: draw, shard, train three models, evaluate, record, compare.

    make demo        (or: python -m jobs.demo)

The models differ in one thing: no cross-image encoder, the encoder trained as published, and trained our way, so that
it also serves a single photo. Every step is a command that a person could type; it is printed before it runs. A demo
that was killed continues where it was when started again. It begins with how long it will take on this machine.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from jobs.cli import parse, run_job
from pipeline.common.errors import UserError
from pipeline.common.text import Table

CONFIG = "jobs/configs/demo.yaml"
SET = "miniature"
GROUPS = {
    "single": "each photo is described alone, as a robot with one photo must",
    "shuffled": "random groups of 16 test photos",
    "ordered": "16 neighbours in file order, often of one place, as published recalls are measured",
    "bank": "each photo beside the same 64 training photos: also for one photo alone",
}


@dataclass(frozen=True)
class Row:
    """A model that the demo trains: its name, what it is, the settings in which it differs, how it is evaluated."""

    run: str
    what: str
    settings: tuple[str, ...]
    groups: tuple[str, ...] = tuple(GROUPS)


ROWS = (
    # an image's descriptor does not depend on its group here
    Row("no-encoder", "no cross-image encoder", ("--model.cross_image.layers", "0"), ("single",)),
    Row("published", "cross-image encoder, as published", ("--train.passes", "group")),
    Row("ours", "cross-image encoder, joint training", ("--train.passes", "joint")),
)


@dataclass(frozen=True)
class DemoJob:
    """Run the demo."""

    output: str = "outputs/demo"
    """Folder of everything it makes; remove it to start anew."""
    places: int = 300
    """Training places of the miniature city."""
    processes: int = 2
    """Training processes."""
    epochs: int | None = None
    """Epochs of each training; none: what jobs/configs/demo.yaml says."""


class StepFailed(UserError):
    """A step of the demo ended with an error of its own, which it has already told."""

    def __init__(self, what: str, code: int) -> None:
        super().__init__(f"'{what}' ended with exit code {code}; mend it and start the demo again: it continues here")
        self.exit_code = code


def step(title: str, *command: str) -> None:
    """Prints and runs one command; its output goes to the terminal."""
    words = [Path(word).name if word.startswith(str(Path(sys.executable).parent)) else word for word in command]
    print(
        f"\n\033[1m{title}\033[0m\n$ {' '.join(words)}" if sys.stdout.isatty() else f"\n== {title}\n$ {' '.join(words)}"
    )
    sys.stdout.flush()
    start = time.monotonic()
    code = subprocess.run(command, env={**os.environ, "PYTHONUNBUFFERED": "1"}).returncode
    if code:
        raise StepFailed(title, code)
    print(f"({time.monotonic() - start:.0f} s)", flush=True)


def main() -> None:
    """Runs the steps in order and says where to look."""
    job = parse(DemoJob, __doc__ or "")
    out, start = Path(job.output), time.monotonic()
    print(f"Measuring this machine ...\nThe demo takes {expected(job)}.", flush=True)
    python, city, shards = sys.executable, out / "city", out / "shards"
    test_set = str(city / "eval" / SET)
    step("Draw a city", python, "-m", "jobs.miniature", "--out", str(city), "--places", str(job.places))
    step("Write its photos into shards", python, "-m", "jobs.prepare", "--source", str(city / "gsv"),
         "--out", str(shards), "--rounds", "2")  # fmt: skip
    together = ["--processes", str(job.processes), *(["--launcher", "cpu"] if job.processes > 1 else [])]
    epochs = ["--train.epochs", str(job.epochs)] if job.epochs else []
    for row in ROWS:
        step(f"Train '{row.run}': {row.what}", python, "-m", "jobs.train", "--config", CONFIG, "--name", row.run,
             *together, "--output", str(out), "--data.shards", str(shards), "--validate.sets", test_set,
             *row.settings, *epochs)  # fmt: skip
        step(f"Evaluate '{row.run}' on places it has never seen", python, "-m", "jobs.evaluate", *together,
             "--checkpoint", str(out / row.run), "--sets", test_set, "--groups", ",".join(row.groups))  # fmt: skip
    step("Compare them", python, "-m", "jobs.compare", "--output", str(out), "--runs", ",".join(r.run for r in ROWS))
    pictures(out, test_set)
    ending(out, time.monotonic() - start)


def expected(job: DemoJob) -> str:
    """How long the demo will take, from a few steps in as many processes at once as will train."""
    import yaml

    from shards.sources.miniature.drawing import MiniatureConfig

    threads = str(max((os.cpu_count() or 1) // job.processes, 1))
    command = (sys.executable, "-c", "from jobs.demo import measure; measure()")
    start = time.monotonic()
    running = [
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, "OMP_NUM_THREADS": threads})
        for _ in range(job.processes)
    ]
    answers = [process.communicate()[0] for process in running]
    if any(process.returncode for process in running):
        raise StepFailed("Measure this machine", max(process.returncode for process in running))
    took = time.monotonic() - start
    measured = [json.loads(answer.splitlines()[-1]) for answer in answers]
    photo, image, inside = (sum(m[k] for m in measured) / len(measured) for k in ("photo", "image", "inside"))
    _, val, test = MiniatureConfig(places=job.places).counts()
    epochs = job.epochs or yaml.safe_load(Path(CONFIG).read_text())["train"]["epochs"]
    drawing = photo * (6.5 * job.places + 6 * (val + test)) / (os.cpu_count() or 1)
    # a forward pass alone is a third of a step; the untrained model is validated too
    images = epochs * 4 * job.places + (epochs + 1) * 6 * val / 3 + 6 * test / 3
    training = len(ROWS) * images * image / job.processes
    starting = (took - inside) * STARTS * len(ROWS)
    minutes, cores = (drawing + training + starting) / 60, os.cpu_count() or 1
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    busy = f"; other programs use this machine now (load {load:.1f} on {cores} cores)" if load > cores + 1 else ""
    return (
        f"about {minutes:.0f} minutes here: a training step of 64 images takes {64 * image / job.processes:.2f} s, "
        f"drawing a photo {photo:.3f} s, starting Python with PyTorch {took - inside:.0f} s{busy}"
    )


STARTS = 6.0  # starts of a process that a row costs, with its files, figures and records


def measure() -> None:
    """Prints the seconds of one drawn photo, of one image in a training step, and of this measurement, as JSON."""
    import torch

    from pipeline.benchmark.sizes import SIZES, batch, build
    from pipeline.benchmark.step import Step
    from shards.sources.miniature.photograph import Studio
    from shards.sources.miniature.plan import plan_photos

    start = time.monotonic()
    trained = Step(build(SIZES["demo"]), *batch(SIZES["demo"], 32), torch.device("cpu"))
    trained()
    times, photos = [time.monotonic()], 0
    for _ in range(3):
        trained()
        times.append(time.monotonic())
    for place in plan_photos(0, (3, 0, 0)):
        studio = Studio(place.town, place.seed)
        for photo in place.photos:
            studio.photograph(photo, (320, 240))
            photos += 1
    end = time.monotonic()
    image = sorted(b - a for a, b in pairwise(times))[1] / 32
    print(json.dumps({"photo": (end - times[-1]) / photos, "image": image, "inside": end - start}))


def pictures(out: Path, test_set: str) -> None:
    """Two small pictures for a page, `images/retrieval.jpg` and `images/recall.png`: single photos, all rows."""
    import numpy as np
    from PIL import Image

    from pipeline.config import EvaluationConfig
    from pipeline.evaluation.evaluate import Result
    from pipeline.evaluation.predictions import load_predictions
    from pipeline.evaluation.report import figures
    from pipeline.evaluation.sets.load import load_set

    evaluated, folder = load_set(test_set, EvaluationConfig()), out / "images"
    curves = {}
    for row in ROWS:
        (file,) = (out / row.run / "evaluation" / "predictions").glob(f"{SET}.single*.parquet")
        kept = load_predictions(file)
        recalls = {1: 100.0 * float(np.mean(kept.ranks == 0))}
        answers = (len(evaluated.queries), len(evaluated.database), 0, kept.rows, kept.distances)
        result = Result(SET, kept.protocol, recalls, *answers)
        curves[row.what] = figures.curve_of(evaluated, result)
    below = f"{len(evaluated.queries)} queries of places never seen, each photo described alone"
    figures.recall_curves(curves, folder / "recall.png", "One photo: recall@N", below)
    chosen = figures.choose(evaluated, result, "correct", 2) + figures.choose(evaluated, result, "failures", 1)
    grid = folder / "retrieval.jpg"
    figures.retrieval_grid(evaluated, result, chosen, grid, "Where was this photo taken?", answers=4)
    with Image.open(grid) as image:
        image.thumbnail((960, 960))
        image.save(grid, quality=72)


def ending(out: Path, seconds: float) -> None:
    """One table of what came out, then the figures and the way to the MLflow page."""
    found: dict[str, dict[str, dict[str, float]]] = {}
    for row in ROWS:
        results = json.loads((out / row.run / "evaluation" / "results.json").read_text())["results"]
        found[row.run] = {result["protocol_name"]: result["recalls"] for result in results}
    protocols = list(dict.fromkeys(name for recalls in found.values() for name in recalls))
    alone = next(name for name in protocols if name.startswith("single"))  # what every row has; its size follows
    cells, marked = [], []
    for row in ROWS:
        state = json.loads((out / row.run / "checkpoints" / "last" / "state.json").read_text())["state"]
        name = next(name for name in state["start"] if name.endswith("recall_at_5"))
        added = f"{state['start'][name]:.0f} -> {state['validated'][name]:.0f}"
        known = [found[row.run].get(protocol) for protocol in protocols]
        cells.append([row.run, row.what, *(f"{r['1']:.1f} / {r['5']:.1f}" if r else "as single" for r in known), added])
    for column, protocol in enumerate(protocols):
        values = [found[row.run].get(protocol, found[row.run][alone])["1"] for row in ROWS]
        marked += [
            (k, column + 2) for k, value in enumerate(values) if value == max(values) and protocol in found[ROWS[k].run]
        ]
    head = ["run", "model", *protocols, "training, val R@5"]
    print(f"\nDone in {seconds / 60:.1f} minutes. R@1 / R@5 in percent, on places that no model has seen:\n")
    Table(head, cells, left=(0, 1), marked=marked).print()
    print()
    for group, meaning in GROUPS.items():
        print(f"  {group:<9} {meaning}")
    print("\nLook at:")
    reports = [out / row.run / "evaluation" / "report.html" for row in ROWS]
    for path in [*sorted((out / "images").glob("*")), *sorted(out.glob("comparison/*.png")), *reports]:
        print(f"  {path}")
    print("\nEvery run, curve and checkpoint in MLflow:")
    from pipeline.training.records.tracking import how_to_open

    where = how_to_open(f"sqlite:///{out}/mlflow.db")
    print("  " + where.replace(" mlflow ui", " .venv/bin/mlflow ui"))


if __name__ == "__main__":
    run_job(main)
