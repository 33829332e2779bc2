"""The whole way on a procedural city, on two CPU processes: draw, shard, train, evaluate, record, compare.

    make demo        (or: python -m jobs.demo)

Every step is a command that a person could type; it is printed before it runs. A demo that was killed continues where
it was when started again.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from jobs.cli import parse, run_job
from pipeline.common.errors import UserError

RUNS = {
    "crica": "adapters, spatial pyramid, cross-image encoder, global batch (the paper's AdaptSPMG+Crica)",
    "no-crica": "the same without the cross-image encoder (AdaptSPMG)",
}


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
    python, city, shards = sys.executable, out / "city", out / "shards"
    test_set = str(city / "eval" / "miniature")
    step("Draw a city", python, "-m", "jobs.miniature", "--out", str(city), "--places", str(job.places))
    step("Write its photos into shards", python, "-m", "jobs.prepare", "--source", str(city / "gsv"),
         "--out", str(shards), "--rounds", "2")  # fmt: skip
    launcher = [str(Path(python).with_name("accelerate")), "launch", "--config_file", "jobs/accelerate/cpu.yaml",
                "--num_processes", str(job.processes)]  # fmt: skip
    for run, what in RUNS.items():
        changes = ["--model.cross_image.layers", "0"] if run == "no-crica" else []
        changes += ["--train.epochs", str(job.epochs)] if job.epochs else []
        step(f"Train '{run}': {what}", *launcher, "-m", "jobs.train", "--config", "jobs/configs/demo.yaml",
             "--name", run, "--output", str(out), "--data.shards", str(shards), "--validate.sets", test_set,
             *changes)  # fmt: skip
        step(f"Evaluate '{run}' on places it has never seen, in the three groupings", *launcher,
             "-m", "jobs.evaluate", "--checkpoint", str(out / run), "--sets", test_set)  # fmt: skip
    step("Compare the two", python, "-m", "jobs.compare", "--output", str(out), "--runs", ",".join(RUNS))
    print(ending(out, time.monotonic() - start))


def ending(out: Path, seconds: float) -> str:
    """What training added, the figures, and the way to the MLflow page."""
    lines = [f"\nDone in {seconds / 60:.1f} minutes.", "", "What training added (validation, shuffled groups):"]
    for run in RUNS:
        state = json.loads((out / run / "checkpoints" / "last" / "state.json").read_text())["state"]
        for name, start in state["start"].items():
            if name.endswith(("recall_at_1", "recall_at_5")):
                short = name.rsplit(".", 1)[1].replace("recall_at_", "R@")
                lines.append(f"  {run:<9} {short}: untrained {start:5.1f} -> trained {state['validated'][name]:5.1f}")
    figures = sorted(out.glob("comparison/*.png")) + sorted(out.glob("*/evaluation/report.html"))
    lines += ["", "Look at:", *[f"  {path}" for path in figures], "", "Every run, curve and checkpoint in MLflow:"]
    lines.append(f"  .venv/bin/mlflow ui --backend-store-uri sqlite:///{out}/mlflow.db     then http://localhost:5000")
    return "\n".join(lines)


if __name__ == "__main__":
    run_job(main)
