"""The slurm scripts under a stand-in for slurm: real ranks, a real signal, exit code 75, the job requeued; evaluations,
and shards by an array of tasks. The pods of a Kubernetes job, as two launchers of torchrun."""

from __future__ import annotations

import json
import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import yaml
from processes import free_port
from tiny import make_gsv, prepare, run_settings

from shards.index import read_index, verify

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


def allocation(folder: Path) -> dict[str, str]:
    """The environment of a job under the stand-in, which it writes into `folder`."""
    (folder / "bin").mkdir()
    for name, text in (("srun", SRUN), ("scontrol", SCONTROL)):
        (folder / "bin" / name).write_text(text)
        (folder / "bin" / name).chmod(stat.S_IRWXU)
    return {
        **os.environ, "PATH": f"{folder / 'bin'}:{os.environ['PATH']}", "STANDIN": str(folder),
        "PYTHON": sys.executable, "SLURM_JOB_ID": "41", "SLURM_JOB_NODELIST": "here",
        "SLURM_SUBMIT_DIR": str(Path.cwd()), "PRECISION": "no", "OMP_NUM_THREADS": "1", "PORT": str(free_port()),
    }  # fmt: skip


@pytest.mark.parametrize("script", ["one_node.sbatch", "many_nodes.sbatch"])
def test_scripts_are_bash_and_ask_for_what_they_need(script: str) -> None:
    subprocess.run(["bash", "-n", str(SCRIPTS / script)], check=True)
    subprocess.run(["bash", "-n", str(SCRIPTS / "job.sh")], check=True)
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
    environment = allocation(tmp_path)
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


@pytest.mark.slow
def test_an_evaluation_on_two_tasks(tmp_path: Path) -> None:
    root = prepare(tmp_path)
    settings = run_settings(root)
    settings["train"] |= {"steps": 1, "validate_first": False}
    settings["validate"]["sets"] = []
    (root / "run.yaml").write_text(yaml.safe_dump(settings))
    subprocess.run([sys.executable, "-m", "jobs.train", "--config", str(root / "run.yaml")], check=True)
    words = ["evaluate", "--checkpoint", root / "outputs/tiny", "--sets", root / "evaluation", "--split", "val"]
    done = subprocess.run(
        ["bash", str(SCRIPTS / "one_node.sbatch"), *map(str, words), "--group_size", "4", "--figures", "false"],
        env=allocation(tmp_path), capture_output=True, text=True, timeout=200,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 processes" in done.stderr and "jobs.evaluate ended with 0" in done.stdout
    assert (root / "outputs/tiny/evaluation/results.json").is_file()


def test_a_word_that_is_no_job_is_refused(tmp_path: Path) -> None:
    done = subprocess.run(
        ["bash", str(SCRIPTS / "one_node.sbatch"), "evalute", "--sets", "x"],
        env=allocation(tmp_path), capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 2 and "'evalute' is not one of train, evaluate, mine" in done.stderr


def test_shards_by_an_array_of_tasks_and_their_index(tmp_path: Path) -> None:
    """Two tasks at the same time, then the job without an array."""
    make_gsv(tmp_path / "gsv", places=40)
    words = ["--source", str(tmp_path / "gsv"), "--out", str(tmp_path / "shards"), "--rounds", "2"]
    command = ["bash", str(SCRIPTS / "prepare.sbatch"), *words]
    whole = allocation(tmp_path)
    tasks = [
        subprocess.Popen(command, env={**whole, "SLURM_ARRAY_TASK_ID": number, "SLURM_ARRAY_TASK_COUNT": "2"})
        for number in ("1", "2")
    ]
    assert [task.wait(60) for task in tasks] == [0, 0]
    assert not (tmp_path / "shards/manifest.json").exists()
    subprocess.run(command, env=whole, check=True, timeout=60)
    assert not verify(str(tmp_path / "shards")) and read_index(str(tmp_path / "shards")).places == 40


def pod() -> tuple[dict[str, Any], dict[str, Any]]:
    """The Kubernetes job, and the container of its pods."""
    job = yaml.safe_load(Path("jobs/kubernetes/pytorchjob.yaml").read_text())
    master, worker = (job["spec"]["pytorchReplicaSpecs"][kind] for kind in ("Master", "Worker"))
    assert (master["replicas"], worker["replicas"]) == (1, 1)
    (container,) = master["template"]["spec"]["containers"]
    assert worker["template"]["spec"]["containers"] == [container]
    return job, container


def test_the_kubernetes_job_is_what_the_operator_takes() -> None:
    job, container = pod()
    assert (job["apiVersion"], job["kind"], container["name"]) == ("kubeflow.org/v1", "PyTorchJob", "pytorch")
    mounted = {mount["name"] for mount in container["volumeMounts"]}
    spec = job["spec"]["pytorchReplicaSpecs"]["Master"]["template"]["spec"]
    assert mounted == {volume["name"] for volume in spec["volumes"]}
    gpus = next(variable["value"] for variable in container["env"] if variable["name"] == "GPUS")
    assert container["resources"]["limits"]["nvidia.com/gpu"] == int(gpus)
    assert spec["securityContext"]["runAsNonRoot"]


@pytest.mark.slow
def test_the_pods_of_the_kubernetes_job_train_together(tmp_path: Path) -> None:
    """Its command as it stands there, in two pods of one process each, with the variables that the operator sets."""
    root = prepare(tmp_path)
    settings = run_settings(root)
    settings["train"] |= {"epochs": 1, "validate_first": False}
    settings["validate"]["sets"] = []
    (root / "run.yaml").write_text(yaml.safe_dump(settings))
    _, container = pod()
    (line,) = container["args"]
    command = [*container["command"], line.replace("jobs/configs/cricavpr.yaml", str(root / "run.yaml"))]
    told = {variable["name"]: variable["value"] for variable in container["env"]}
    del told["MLFLOW_TRACKING_URI"]
    environment = {
        **os.environ, **told, "GPUS": "1", "ACCELERATE_MIXED_PRECISION": "no", "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(free_port()), "WORLD_SIZE": "2", "OMP_NUM_THREADS": "1",
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
    }  # fmt: skip
    pods = [
        subprocess.Popen(command, env={**environment, "RANK": str(number)}, stderr=subprocess.PIPE, text=True)
        for number in (0, 1)
    ]
    said = [running.communicate(timeout=200)[1] for running in pods]
    assert [running.returncode for running in pods] == [0, 0], said
    assert "2 processes" in said[0]
    assert all((root / f"outputs/tiny/samples.rank{r}.jsonl").stat().st_size for r in (0, 1))
