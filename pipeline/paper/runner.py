"""Runs what a table still lacks: trainings through the launcher, then the evaluations of each.

Invariant: a table that was interrupted continues where it was. A training that ended well is never started again, one
that was cut short resumes from its checkpoint, and an evaluation that is on disk or in MLflow is not repeated. Each
child process gets the signals that this one gets, so that a scheduler's warning reaches the training.
"""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from pipeline.common.errors import Diverged, Preempted, UserError
from pipeline.common.files import write_atomically
from pipeline.config import recorded
from pipeline.evaluation.protocol import Protocol, read_protocol
from pipeline.evaluation.report import tables
from pipeline.paper.measure import folder, results_file, write_order
from pipeline.paper.plan import Cell, Training
from pipeline.training.records.tracking import store_uri

Recalls = dict[tuple[str, Protocol], dict[int, float]]
"""(set, protocol) -> N -> Recall@N in percent."""


class StepFailed(UserError):
    """A training or an evaluation ended with an error that it has told itself."""

    def __init__(self, what: str, code: int) -> None:
        super().__init__(f"{what} ended with exit code {code}; mend it and start the table again: it continues here")
        self.exit_code = code


@dataclass(frozen=True)
class Runner:
    """Starts trainings and evaluations.

    Attributes:
        output: folder of the runs.
        launch: the launcher's words, `accelerate launch --config_file FILE`; empty: one plain process.
    """

    output: Path
    launch: str = ""

    def run_folder(self, training: Training) -> Path:
        """Where a training lies."""
        return self.output / training.name

    def status(self, training: Training) -> str:
        """finished, interrupted at a step, ended with an error, or not begun."""
        run = self.run_folder(training)
        try:
            ended: dict[str, Any] = json.loads((run / "status.json").read_text())
        except FileNotFoundError:
            ended = {}
        if ended.get("exit_code") == 0:
            return "finished"
        state = run / "checkpoints" / "last" / "state.json"
        if state.is_file():
            return f"interrupted at step {json.loads(state.read_text())['state']['step']:,}"
        return "ended with an error" if ended.get("exit_code") else "to do"  # none yet: killed before a checkpoint

    def train(self, training: Training) -> None:
        """Trains to the end, or continues, unless finished.

        Raises:
            Diverged: the loss was not finite. Preempted: stopped by a signal. StepFailed: any other error.
        """
        if self.status(training) == "finished":
            return
        run = self.run_folder(training)
        run.mkdir(parents=True, exist_ok=True)
        import yaml

        store_uri(training.config.tracking.uri, str(self.output))  # a password goes on by the environment
        settings = run / "training.yaml"
        write_atomically(settings, yaml.safe_dump(recorded(training.config), sort_keys=False))
        (run / "status.json").unlink(missing_ok=True)  # of an earlier attempt
        code = self._start("jobs.train", "--config", str(settings))
        if code == 0:
            return
        try:  # accelerate's launcher makes 1 of every code but 0; the job's own is here
            told = json.loads((run / "status.json").read_text())
            code = told["exit_code"] or code
        except FileNotFoundError:
            told = {"message": ""}
        if code == Diverged.exit_code:
            raise Diverged(told["message"])
        if code == Preempted.exit_code:
            raise Preempted(f"{training.name} is saved; start the table again to continue")
        raise StepFailed(f"the training {training.name}", code)

    def measure(self, training: Training, cells: Sequence[Cell]) -> None:
        """Evaluates what is not on disk yet. Raises `Preempted` or `StepFailed`."""
        missing = [cell for cell in cells if not results_file(self.run_folder(training), cell).is_file()]
        if not missing:
            return
        run = self.run_folder(training)
        order = write_order(folder(run), run, {cell.key: cell.config for cell in missing}, run)
        self.carry_out(order, f"the evaluation of {training.name}")

    def carry_out(self, order: Path, what: str) -> None:
        """The evaluations of `write_order`. Raises `Preempted` or `StepFailed`, which says `what` failed."""
        code = self._start("jobs.experiment", "--measure", str(order))
        if code:
            raise StepFailed(what, code)

    def results(self, cell: Cell) -> Recalls | None:
        """An evaluation's recalls from disk, None where it has not been done."""
        path = results_file(self.run_folder(cell.training), cell)
        if not path.is_file():
            return None
        found: Recalls = {}
        for entry in tables.read_json(path)["results"]:
            protocol = read_protocol(entry["protocol"], str(path))
            found[entry["set"], protocol] = {int(k): float(v) for k, v in entry["recalls"].items()}
        return found

    def _start(self, module: str, *arguments: str) -> int:
        """Runs a job to its end; its exit code. A signal is handed on, waited for, and raised as `Preempted`."""
        words = shlex.split(self.launch) or [sys.executable]
        if words[0] == "accelerate":  # the one beside this Python, whatever PATH says
            words[0] = str(Path(sys.executable).with_name("accelerate"))
        command = [*words, "-m", module, *arguments]
        print(f"\n$ {shlex.join(command)}", file=sys.stderr, flush=True)
        start, received = time.monotonic(), list[int]()
        # what the job prints (its settings, its own table) is not this job's answer: all of it goes to stderr
        child = subprocess.Popen(command, stdout=sys.stderr.fileno(), start_new_session=True)

        def hand_on(number: int, frame: FrameType | None) -> None:
            received.append(number)
            if child.poll() is None:
                os.killpg(child.pid, signal.SIGTERM)

        signals = (signal.SIGTERM, signal.SIGUSR1, signal.SIGINT)
        before = {number: signal.signal(number, hand_on) for number in signals}
        try:
            code = child.wait()
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
        if received:
            raise Preempted(f"signal {received[0]}: {module} was told to save; start the table again to continue")
        print(f"({time.monotonic() - start:.0f} s)", file=sys.stderr, flush=True)
        return code
