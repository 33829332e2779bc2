"""Several machines and their accidents: two launchers, dead and frozen ranks, runs killed at any moment and resumed."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import yaml
from launched import Launched
from processes import alive, free_port
from safetensors.torch import load_file
from tiny import prepare, run_settings

from pipeline.benchmark.engines import compare
from pipeline.data.plan import plan
from shards.index import read_index

LAUNCHER = [sys.executable, "-m", "accelerate.commands.accelerate_cli", "launch"]
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepare(tmp_path_factory.mktemp("nodes"))


def settings(root: Path, name: str, **train: object) -> Path:
    plain = run_settings(root)
    plain["name"] = name
    plain["train"] |= {"validate_first": False, **train}
    plain["validate"]["sets"] = []
    path = root / f"{name}.yaml"
    path.write_text(yaml.safe_dump(plain))
    return path


def machines(job: list[str], folder: Path) -> list[subprocess.Popen[str]]:
    """Two launchers of one process each that find each other over loopback, as two machines would."""
    port = str(free_port())
    started = []
    for machine in range(2):
        options = ["--config_file", "jobs/accelerate/cpu.yaml", "--num_machines", "2", "--num_processes", "2"]
        options += ["--machine_rank", str(machine), "--main_process_ip", "127.0.0.1", "--main_process_port", port]
        log = (folder / f"machine{machine}.log").open("w")
        started.append(
            subprocess.Popen([*LAUNCHER, *options, "-m", *job], env=ENVIRONMENT, stdout=log, stderr=log, text=True)
        )
    return started


@pytest.mark.slow
def test_two_machines_have_the_gradients_of_one_process(tmp_path: Path) -> None:
    truth, found = tmp_path / "truth.safetensors", tmp_path / "found.safetensors"
    Launched("ddp", 1, "pipeline.benchmark.engines", ["--write", str(truth)], truth).done()
    for process in machines(["pipeline.benchmark.engines", "--write", str(found)], tmp_path):
        assert process.wait(600) == 0, (tmp_path / "machine0.log").read_text()[-3000:]
    difference = compare(load_file(truth), load_file(found))
    assert difference.gradient < 1e-9
    assert difference.weight < 1e-9


@pytest.mark.slow
def test_a_rank_that_dies_on_one_machine_ends_both_and_is_named(root: Path, tmp_path: Path) -> None:
    path = settings(root, "machines", epochs=1000)
    log = root / "outputs/machines/samples.rank1.jsonl"
    started = machines(["jobs.train", "--config", str(path)], tmp_path)
    deadline = time.monotonic() + 400
    while not (log.exists() and '"step": 3,' in log.read_text()):
        assert all(process.poll() is None for process in started)
        assert time.monotonic() < deadline
        time.sleep(0.05)
    worker = int(subprocess.run(["pgrep", "-P", str(started[1].pid)], capture_output=True, text=True).stdout.split()[0])
    os.kill(worker, signal.SIGKILL)
    killed = time.monotonic()
    codes = [process.wait(120) for process in started]
    assert all(codes), "both launchers must report a failure"
    assert time.monotonic() - killed < 90
    told = (tmp_path / "machine1.log").read_text()
    assert "rank      : 1 (local_rank: 0)" in told
    assert "exitcode  : -9" in told


def below(pid: int) -> list[int]:
    """A process's children, theirs, and so on: ranks, fork servers, loader workers."""
    listed = subprocess.run(["pgrep", "-P", str(pid)], capture_output=True, text=True).stdout.split()
    return [found for child in map(int, listed) for found in (child, *below(child))]


@pytest.mark.slow
def test_a_killed_launcher_leaves_no_rank_and_its_run_is_continued(root: Path, tmp_path: Path) -> None:
    """`accelerate launch` itself gets the SIGKILL; its ranks save and end, and the same command goes on at once."""
    path = settings(root, "launcher", epochs=1000, save_every=1000)
    options = ["--config_file", "jobs/accelerate/cpu.yaml", "-m", "jobs.train", "--config", str(path)]
    command, log = [*LAUNCHER, *options, "--data.workers", "1"], root / "outputs/launcher/samples.rank1.jsonl"
    with (tmp_path / "first").open("w") as said:
        process = subprocess.Popen(command, env=ENVIRONMENT, stdout=said, stderr=said)
        deadline = time.monotonic() + 200
        while not (log.exists() and '"step": 3,' in log.read_text()):
            assert process.poll() is None and time.monotonic() < deadline, (tmp_path / "first").read_text()[-3000:]
            time.sleep(0.05)
        started = below(process.pid)
        process.kill()
    killed = time.monotonic()
    process.wait()
    steps = len(log.read_text().splitlines()) + 5
    again = subprocess.Popen(
        [*command, "--train.steps", str(steps)], env=ENVIRONMENT, stderr=subprocess.PIPE, text=True
    )
    while (left := [pid for pid in started if alive(pid)]) and time.monotonic() < killed + 60:
        time.sleep(0.05)
    print(f"accelerate launch killed: {len(started)} processes below it gone after {time.monotonic() - killed:.1f} s")
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    said_again = again.communicate(timeout=200)[1]
    assert not left and len(started) >= 4
    assert again.returncode == 0, said_again[-3000:]
    taken = [int(line.split('"step": ')[1].split(",")[0]) for line in log.read_text().splitlines()]
    assert taken == list(range(1, max(taken) + 1)), "no step lost or repeated"


def test_a_rank_that_dies_ends_the_others_at_once(root: Path) -> None:
    """A connection that closes is noticed without waiting for the timeout of ten minutes."""
    path = settings(root, "dead", epochs=1000)
    job = Launched("ddp", 2, "jobs.train", ["--config", str(path)], root / "dead.log")
    log = root / "outputs/dead/samples.rank1.jsonl"
    job.ranks[1].kill_when(lambda: log.exists() and '"step": 4,' in log.read_text())
    killed = time.monotonic()
    codes = job.wait(60)
    assert codes[1] == -signal.SIGKILL
    assert codes[0] != 0
    assert time.monotonic() - killed < 30
    assert (root / "outputs/dead/checkpoints/last/state.json").exists()


def test_a_frozen_rank_ends_the_others_within_the_timeout(root: Path) -> None:
    path = settings(root, "frozen", epochs=1000, timeout=6.0)
    job = Launched("ddp", 2, "jobs.train", ["--config", str(path)], root / "frozen.log")
    log = root / "outputs/frozen/samples.rank1.jsonl"
    job.ranks[1].kill_when(lambda: log.exists() and '"step": 2,' in log.read_text(), signal.SIGSTOP)
    frozen = time.monotonic()
    try:
        assert job.ranks[0].wait(60) != 0
        assert time.monotonic() - frozen < 45
        assert "imed out" in job.ranks[0].text()
    finally:
        job.ranks[1].send(signal.SIGKILL)
        job.wait()


def kill_somewhere(root: Path, path: Path, world: int, workers: int, how: str, chance: random.Random) -> bool:
    """Runs on `world` ranks and kills all of them; True where the run had ended before."""
    folder = root / "outputs" / path.stem
    job = Launched(
        "ddp", world, "jobs.train", ["--config", str(path), "--data.workers", str(workers)], root / f"{path.stem}.log"
    )
    log = folder / "samples.rank0.jsonl"
    lines = len(log.read_text().splitlines()) if log.exists() else 0
    more = chance.randrange(1, 5)
    pause = chance.random() * 0.05
    deadline = time.monotonic() + 200
    while any(process.alive() for process in job.ranks):
        assert time.monotonic() < deadline
        if how == "saving" and any((folder / "checkpoints").glob(".writing-*")):
            break
        if how == "anywhere" and log.exists() and len(log.read_text().splitlines()) >= lines + more:
            time.sleep(pause)
            break
    ended = not any(process.alive() for process in job.ranks)
    job.kill()
    return ended


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_killed_again_and_again_every_epoch_is_exactly_the_plan(root: Path, seed: int) -> None:
    """SIGKILL at random moments and inside saves, 1 and 2 ranks in turn, 0 to 2 workers: each step once, as planned."""
    import json

    chance = random.Random(seed)
    path = settings(root, f"elastic{seed}", epochs=4, save_every=1 + seed)
    folder = root / "outputs" / path.stem
    for attempt in range(8):
        how = "saving" if attempt % 2 else "anywhere"
        if kill_somewhere(root, path, 1 + attempt % 2, attempt % 3, how, chance):
            break
    Launched("ddp", 2, "jobs.train", ["--config", str(path)], root / f"{path.stem}.log").done()
    taken: dict[int, list[str]] = {}
    for log in sorted(folder.glob("samples.rank*.jsonl")):
        for line in log.read_text().splitlines():
            entry = json.loads(line)
            taken.setdefault(entry["step"], []).extend(entry["samples"])
    index = read_index(str(root / "shards"))
    keys = index.table.column("sample").to_pylist()
    planned = [batch for epoch in range(4) for batch in plan(index, 0, epoch, 4, "city", 8).batches]
    assert sorted(taken) == list(range(1, len(planned) + 1))
    for step, batch in enumerate(planned, start=1):
        assert taken[step] == [keys[row] for row in batch], step
    assert not list((folder / "checkpoints").glob(".writing-*"))
    assert all(torch.isfinite(t).all() for t in load_file(folder / "checkpoints/last/model.safetensors").values())
