"""`--processes N`: real launches by accelerate; one error line, the ranks' exit code, no traceback of the launcher."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from job_process import JobProcess
from tiny import prepare, run_settings

from jobs.processes import Processes, check_processes
from pipeline.common.errors import UsageError

# a job that imports nothing heavy: what its ranks do stands on the command line, `--rank0 X --rank1 Y`
JOB = """
import os, signal, sys, time
from dataclasses import dataclass
from jobs.cli import parse, run_job
from jobs.processes import Processes, check_processes, spread
from pipeline.common.errors import DataError

@dataclass(frozen=True)
class Job(Processes):
    rank0: str = ""
    rank1: str = ""

def main():
    job = parse(Job, "")
    check_processes(job)
    spread(job, "answers")
    number = os.environ["RANK"]
    end = getattr(job, "rank" + number)
    if end == "data":
        raise DataError(f"rank {number}: a file is broken")
    if end == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    print(f"rank {number} has worked")

if __name__ == "__main__":
    run_job(main)
"""


@pytest.mark.parametrize(
    ("words", "code", "last"),
    [
        (["--rank0", "fine"], 0, "has worked"),
        (["--rank0", "data", "--rank1", "data"], 3, "answers: rank 0: a file is broken"),
        (["--rank1", "killed"], 1, "answers: rank 1 was ended by SIGKILL (out of memory?)"),
    ],
)
def test_the_job_ends_as_its_ranks_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], code: int, last: str
) -> None:
    (tmp_path / "answers.py").write_text(JOB)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "answers", raising=False)
    job = JobProcess("answers", [*words, "--processes", "2"], tmp_path / "log")
    assert job.wait() == code, job.text()
    lines = job.text().splitlines()
    assert lines[-1].endswith(last) and "Traceback" not in job.text(), job.text()
    assert sum("answers:" in line for line in lines) == (code != 0)


@pytest.mark.parametrize(
    ("job", "world", "wanted"),
    [
        (Processes(0), None, "at least 1; it is 0"),
        (Processes(1, "ddp"), None, "goes with --processes"),
        (Processes(2, "ddpp"), None, "--launcher ddpp: neither a file nor one of cpu, ddp, fsdp2"),
        (Processes(4), "2", "--processes 4, but a launcher started 2"),
    ],
)
def test_what_cannot_be_started_is_refused(
    job: Processes, world: str | None, wanted: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if world is None:
        monkeypatch.delenv("WORLD_SIZE", raising=False)
    else:
        monkeypatch.setenv("WORLD_SIZE", world)
    with pytest.raises(UsageError, match=re.escape(wanted)):
        check_processes(job)


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that would go on for long."""
    root = prepare(tmp_path_factory.mktemp("processes"))
    settings = run_settings(root)
    settings["train"] |= {"epochs": 1000, "save_every": 10_000, "validate_first": False}
    settings["validate"]["sets"] = []
    (root / "run.yaml").write_text(yaml.safe_dump(settings))
    return root / "run.yaml"


@pytest.mark.slow  # two launches of a training
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGUSR1])
def test_a_signal_to_the_launching_process_saves_and_ends_with_75(config: Path, number: signal.Signals) -> None:
    command = [sys.executable, "-m", "jobs.train", "--config", str(config), "--processes", "2", "--name", number.name]
    job = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    log = config.parent / "outputs" / number.name / "samples.rank1.jsonl"
    deadline = time.monotonic() + 200
    while not (log.exists() and '"step": 2,' in log.read_text()):
        assert job.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    job.send_signal(number)
    told, _ = job.communicate(timeout=120)
    assert job.returncode == 75, told
    assert re.fullmatch(rf"jobs.train: signal {number.value}: saved step \d+; .*", told.splitlines()[-1]), told
    assert "Traceback" not in told


@pytest.mark.slow  # two launches
@pytest.mark.parametrize("launcher", ["accelerate launch", "torchrun"])
def test_other_launchers_end_with_the_line_of_the_job(config: Path, launcher: str) -> None:
    options = {
        "accelerate launch": ["--config_file", "jobs/accelerate/cpu.yaml"],
        "torchrun": ["--nproc_per_node", "2"],
    }
    program, *rest = launcher.split()
    start = [str(Path(sys.executable).parent / program), *rest, *options[launcher]]
    done = subprocess.run(
        [*start, "-m", "jobs.train", "--config", str(config), "--data.places_per_batch", "400"],
        capture_output=True, text=True, timeout=200,
    )  # fmt: skip
    assert done.returncode == 1
    wanted = "data.places_per_batch is 400, but a pass over"
    assert sum(line.startswith("jobs.train: ") for line in done.stderr.splitlines()) == 1
    assert wanted in done.stderr.splitlines()[-2], done.stderr[-3000:]
