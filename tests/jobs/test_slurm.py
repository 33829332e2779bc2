"""The slurm scripts under a stand-in for slurm: real ranks, a real signal, exit code 75, the job requeued."""

from __future__ import annotations

import json
import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from processes import free_port
from tiny import prepare, run_settings

SCRIPTS = Path("jobs/slurm")
SRUN = """#!/bin/bash
# two tasks on one machine; USR1 and TERM go to them, as slurm sends them; the largest exit code comes back
shift
for task in 0 1; do
    SLURM_PROCID=$task SLURM_LOCALID=$task SLURM_NTASKS=2 SLURM_NTASKS_PER_NODE=2 "$@" &
    tasks="$tasks $!"
done
echo $tasks > "$STANDIN/tasks"
code=0
for task in $tasks; do wait $task; c=$?; [ $c -gt $code ] && code=$c; done
exit $code
"""
SCONTROL = """#!/bin/bash
if [ "$1" = show ]; then echo 127.0.0.1; else echo "$@" >> "$STANDIN/scontrol"; fi
"""


@pytest.mark.parametrize("script", ["one_node.sbatch", "many_nodes.sbatch"])
def test_scripts_are_bash_and_ask_for_what_they_need(script: str) -> None:
    subprocess.run(["bash", "-n", str(SCRIPTS / script)], check=True)
    subprocess.run(["bash", "-n", str(SCRIPTS / "train.sh")], check=True)
    text = (SCRIPTS / script).read_text()
    assert "#SBATCH --requeue" in text
    assert "#SBATCH --signal=USR1@120" in text, "without B: the signal goes to the tasks"
    assert "--partition" not in text and "--account" not in text, "names of a site do not belong here"


@pytest.mark.slow
def test_a_signal_ends_with_75_and_requeues(tmp_path: Path) -> None:
    root = prepare(tmp_path)
    settings = run_settings(root)
    settings["train"] |= {"epochs": 1000, "save_every": 10_000, "validate_first": False}
    settings["validate"]["sets"] = []
    (root / "run.yaml").write_text(yaml.safe_dump(settings))
    bin_folder = tmp_path / "bin"
    bin_folder.mkdir()
    for name, text in (("srun", SRUN), ("scontrol", SCONTROL)):
        (bin_folder / name).write_text(text)
        (bin_folder / name).chmod(stat.S_IRWXU)
    environment = {
        **os.environ, "PATH": f"{bin_folder}:{os.environ['PATH']}", "STANDIN": str(tmp_path), "PYTHON": sys.executable,
        "SLURM_JOB_ID": "41", "SLURM_JOB_NODELIST": "here", "SLURM_SUBMIT_DIR": str(Path.cwd()), "PRECISION": "no",
        "OMP_NUM_THREADS": "1", "PORT": str(free_port()),
    }  # fmt: skip
    job = subprocess.Popen(
        ["bash", str(SCRIPTS / "one_node.sbatch"), "--config", str(root / "run.yaml")],
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    log = root / "outputs/tiny/samples.rank1.jsonl"
    deadline = time.monotonic() + 200
    while not (log.exists() and '"step": 2,' in log.read_text()):
        assert job.poll() is None, job.communicate()[0][-3000:]
        assert time.monotonic() < deadline
        time.sleep(0.02)
    for task in (tmp_path / "tasks").read_text().split():
        os.kill(int(task), signal.SIGUSR1)
    out, _ = job.communicate(timeout=120)
    assert job.returncode == 75, out[-3000:]
    assert (tmp_path / "scontrol").read_text() == "requeue 41\n"
    state = json.loads((root / "outputs/tiny/checkpoints/last/state.json").read_text())["state"]
    assert state["step"] >= 2 and state["world_size"] == 2
