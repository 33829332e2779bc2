"""What the image is made of: one command for all jobs, a health line, and pins that can be installed together."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from jobs import health
from pipeline.common.errors import UsageError

ROOT = Path(__file__).resolve().parents[2]


def jobs(*words: str) -> subprocess.CompletedProcess[str]:
    """The image's entry point."""
    return subprocess.run([sys.executable, "-m", "jobs", *words], cwd=ROOT, capture_output=True, text=True)


@pytest.mark.parametrize(
    ("words", "code", "wanted"),
    [
        (["--help"], 0, "jobs: benchmark, compare, demo, evaluate"),
        (["train", "--help"], 0, "usage: python -m jobs.train "),
        (["train", "--lr", "1"], 2, "jobs.train: there is no option --lr (did you mean 'train.lr'?)"),
        (["trian"], 2, "jobs: there is no job 'trian' (did you mean 'train'?)"),
    ],
)
def test_a_word_starts_a_job(words: list[str], code: int, wanted: str) -> None:
    done = jobs(*words)
    assert done.returncode == code and wanted in done.stdout + done.stderr and "Traceback" not in done.stderr


def test_the_health_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["jobs.health", "--output", str(tmp_path / "outputs")])
    health.main()
    told = capsys.readouterr().out
    assert re.match(r"ok: torch 2\.\S+, \d+ GPUs, \d+ cores, [\d,]+ MB in /dev/shm", told)
    assert f"writable by user {os.getuid()}" in told
    (tmp_path / "file").write_text("")
    for words, wanted in ((["--output", str(tmp_path / "file")], "--output"), (["--gpus", "99"], "not 99")):
        monkeypatch.setattr(sys, "argv", ["jobs.health", "--output", str(tmp_path), *words])
        with pytest.raises(UsageError, match=wanted):
            health.main()


def test_the_image_runs_as_a_user_and_copies_what_is_there() -> None:
    """That its steps work is told by building it."""
    lines = [line for line in (ROOT / "Dockerfile").read_text().splitlines() if not line.startswith("#")]
    steps = [line.split(maxsplit=1) for line in lines if re.match(r"[A-Z]+ ", line)]
    assert [what for step, what in steps if step == "USER"] == ["$UID"]
    assert [json.loads(what) for step, what in steps if step == "ENTRYPOINT"] == [["python", "-m", "jobs"]]
    for what in (what for step, what in steps if step == "COPY"):
        assert all((ROOT / name).exists() for name in what.split()[:-1]), what


@pytest.mark.slow
def test_the_pins_of_the_cuda_image_resolve(tmp_path: Path) -> None:
    """pip finds versions of everything on PyPI alone, torch's CUDA build with its runtime; nothing is downloaded."""
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PIP_") or name == "PIP_CERT"}
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--quiet", "--report",
               str(tmp_path / "report.json"), "--constraint", "constraints.txt", ".[deepspeed]"]  # fmt: skip
    done = subprocess.run(
        command, cwd=ROOT, env={**clean, "PIP_CONFIG_FILE": os.devnull}, capture_output=True, text=True, timeout=900
    )
    if re.search(r"NewConnectionError|Temporary failure in name resolution|Could not fetch URL", done.stderr):
        pytest.skip("PyPI cannot be reached")
    assert done.returncode == 0, done.stderr[-2000:]
    report = json.loads((tmp_path / "report.json").read_text())
    found = {i["metadata"]["name"].lower(): i["metadata"]["version"] for i in report["install"]}
    pinned = re.search(r"^torch==(\S+)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    assert pinned is not None and found["torch"] == pinned[1]
    assert any(name.startswith("nvidia-") for name in found), "torch's CUDA build brings its runtime"
