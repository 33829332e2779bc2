"""A storm of SIGKILLs at random moments: what is lost, repeated or left over when the same command is started again.

    python -m pytest -s -m slow tests/storm/test_kills.py                        60 kills and more, and a table
    python -m pytest -s tests/storm/test_kills.py                                a few, in the default tests

Each job (prepare, training on one and two ranks, `evaluate --store`, `locate --build`) runs once undisturbed. The same
work is then started again and again and killed at a moment drawn from the seed, between its start and the time it
took; at last it is left alone, and what it made is compared with the undisturbed run's. Parts and files that only
large sets have (descriptors in several parts, regions in a file, shared memory of loader workers) are made here, too.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
import torch
import yaml
from launched import Launched
from safetensors.torch import load_file
from tiny import make_evaluation, make_gsv, prepare, run_settings

from pipeline.data.plan import plan
from pipeline.evaluation.describe import encode, sides
from pipeline.locate import descriptor_cache
from pipeline.training.records.run_folder import state_of
from shards.index import read_index

PART = 20_000  # bytes of descriptors in a part, instead of 64 MB
SOON = 15.0  # seconds in which every process of a killed job is gone


@dataclass
class Tally:
    """One line of the table."""

    kills: int = 0
    ended_before: int = 0
    slowest_end: float = 0.0
    """Seconds from a kill until the last process of the job is gone, the ranks that were not killed included."""
    slowest_said: str = ""
    lost: int = 0
    repeated: int = 0
    left_over: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return (
            f"{self.kills:5} kills, {self.ended_before:2} too late, lost {self.lost}, repeated {self.repeated}, left "
            f"over {len(self.left_over)} {self.left_over[:3]}, all gone within {self.slowest_end:.1f} s"
        )


class Work:
    """A job that is killed and started again: `arguments(ranks, workers)` of a module, its outputs in `folder`."""

    def __init__(self, module: str, arguments: list[str], folder: Path, ranks: tuple[int, ...] = (1,)) -> None:
        self.module, self.arguments, self.folder, self.ranks = module, arguments, folder, ranks
        self.tally, self.took = Tally(), 0.0
        folder.mkdir(parents=True, exist_ok=True)

    def run(self, ranks: int, extra: list[str] | None = None) -> None:
        """To its end."""
        job = Launched("ddp", ranks, self.module, [*self.arguments, *(extra or [])], self.folder / "log")
        start = time.monotonic()
        job.done()
        self.took = time.monotonic() - start

    def kill(self, chance: random.Random, extra: list[str] | None = None) -> None:
        """Starts it and kills one rank, or all, at a random moment; then waits until none is left."""
        ranks = chance.choice(self.ranks)
        job = Launched("ddp", ranks, self.module, [*self.arguments, *(extra or [])], self.folder / "log")
        group = [process._process.pid or 0 for process in job.ranks]
        time.sleep(chance.random() * self.took)
        doomed = job.ranks if chance.random() < 0.5 else [chance.choice(job.ranks)]
        struck = [process for process in doomed if process.alive()]
        for process in struck:
            process.send(signal.SIGKILL)
        killed = time.monotonic()
        if struck:
            self.tally.kills += 1
        else:
            self.tally.ended_before += 1
        time.sleep(0.1)  # a launcher looks ten times a second, and ends the other ranks of a job that lost one
        for process in job.ranks:
            if struck and process.alive():
                process.send(signal.SIGTERM)
        for process in job.ranks:
            try:
                process.wait(60)
            except AssertionError:
                self.tally.left_over.append(f"rank that did not end:\n{process.text()[-2000:]}")
        while (left := of_groups(group)) and time.monotonic() < killed + 60:
            time.sleep(0.05)
        if (took := time.monotonic() - killed) > self.tally.slowest_end:
            self.tally.slowest_end = took
            self.tally.slowest_said = "\n".join(process.text()[-2000:] for process in job.ranks)
        self.tally.left_over += [f"process {pid}" for pid in left]
        for pid in left:
            os.kill(pid, signal.SIGKILL)


def of_groups(groups: list[int]) -> list[int]:
    """Living processes of these process groups: a rank leads one, its loader workers and writers belong to it."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, group = stat.read_text().rsplit(")", 1)[1].split()[:3]
        except OSError:
            continue
        if int(group) in groups and state != "Z":
            found.append(int(stat.parent.name))
    return found


def debris(folder: Path) -> list[str]:
    """Files that only a run at work has."""
    names = (
        "*.tmp",
        "*.part",
        ".writing-*",
        ".removing-*",
        ".replaced-*",
        ".status-*",
        ".*.partial",
        "scratch",
        "regions.*",
    )
    return sorted({str(path) for name in names for path in folder.rglob(name)})


def contents(folder: Path) -> dict[str, bytes]:
    return {str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


def temporary_files(folder: Path) -> list[str]:
    """Files with content in the folder for temporary files, and in shared memory those of processes that are gone
    (`torch_<process>_...`; a living one may belong to a test beside this one); a killed process cannot remove the empty
    folders and sockets of Python's `multiprocessing`."""
    shared = [file for file in Path("/dev/shm").glob("torch_*") if not Path("/proc", file.name.split("_")[1]).exists()]
    shared += Path("/dev/shm").glob("sem.mp-*")
    return sorted(str(file) for file in [*folder.rglob("*"), *shared] if file.is_file() and file.stat().st_size)


def storm(root: Path, seed: int, kills: dict[str, int], patch: pytest.MonkeyPatch) -> dict[str, Tally]:
    """All of it; the table, by kind of work."""
    chance = random.Random(seed)
    (root / "temporary").mkdir()
    patch.setattr(tempfile, "tempdir", str(root / "temporary"))  # the forked jobs inherit these
    patch.setattr(sides, "blocks_of", partial(encode.blocks_of, limit=PART))
    patch.setattr(encode, "REGIONS_IN_MEMORY", 0)
    patch.setattr(sides, "IN_MEMORY", 0)
    patch.setattr(descriptor_cache, "PART_BYTES", PART)
    patch.setattr(descriptor_cache, "IN_MEMORY", 0)
    prepare(root, places=48)
    kinds = {"prepare": kill_prepare, "training": kill_training, "evaluate --store": kill_evaluate,
             "locate --build": kill_locate}  # fmt: skip
    found = {}
    for name, kill in kinds.items():
        if name in kills:
            before = set(temporary_files(root / "temporary"))
            found[name] = kill(root, chance, kills[name])
            found[name].left_over += sorted(set(temporary_files(root / "temporary")) - before)
    print(f"\nstorm of kills, seed {seed}")
    for name, tally in found.items():
        print(f"  {name:<18} {tally}")
    return found


def again(work: Work, chance: random.Random, kills: int, extra: Callable[[], list[str]] = list) -> None:
    """Kills until so many kills have struck, or the job has ended by itself as often."""
    while work.tally.kills < kills and work.tally.ended_before < kills:
        before = work.tally.ended_before
        work.kill(chance, extra())
        if work.tally.ended_before > before and work.module != "jobs.train":
            shutil.rmtree(work.folder / "out", ignore_errors=True)  # finished: nothing left to kill


def kill_prepare(root: Path, chance: random.Random, kills: int) -> Tally:
    make_gsv(root / "storm-gsv", places=240)
    words = ["--source", str(root / "storm-gsv"), "--rounds", "2", "--shard_mb", "0.05", "--workers", "2", "--out"]
    whole = Work("jobs.prepare", [*words, str(root / "whole/out")], root / "whole")
    whole.run(1)
    work = Work("jobs.prepare", [*words, str(root / "killed/out")], root / "killed")
    work.took = whole.took
    again(work, chance, kills)
    work.run(1)
    a, b = contents(root / "whole/out"), contents(root / "killed/out")
    work.tally.lost = sum(b.get(name) != data for name, data in a.items())
    work.tally.left_over += [name for name in b if name not in a]
    return work.tally


def kill_training(root: Path, chance: random.Random, kills: int) -> Tally:
    settings = run_settings(root)
    epochs = 2 + kills // 2
    settings["train"] |= {"epochs": epochs, "validate_first": False, "save_every": 3, "keep": 2}
    settings["validate"]["sets"] = []
    path = root / "storm.yaml"
    path.write_text(yaml.safe_dump({**settings, "name": "storm", "output": str(root / "training/out")}))
    work = Work("jobs.train", ["--config", str(path)], root / "training", ranks=(1, 2))
    work.took = 4.0  # start, some steps and saves: the run itself is longer than any of them
    again(work, chance, kills, lambda: ["--data.workers", str(chance.randrange(2))])
    run = root / "training/out/storm"
    assert state_of(run) in ("killed", "failed", "preempted", "done")
    work.run(2)
    taken: dict[int, list[str]] = {}
    for log in sorted(run.glob("samples.rank*.jsonl")):
        for line in log.read_text().splitlines():
            entry = json.loads(line)
            taken.setdefault(entry["step"], []).extend(entry["samples"])
    index = read_index(str(root / "shards"))
    keys = index.table.column("sample").to_pylist()
    planned = [batch for epoch in range(epochs) for batch in plan(index, 0, epoch, 4, "city", 8).batches]
    for step, batch in enumerate(planned, start=1):
        wanted, had = sorted(keys[row] for row in batch), sorted(taken.get(step, []))
        work.tally.lost += sum(key not in had for key in wanted)
        work.tally.repeated += len(had) - len(set(had))
    work.tally.repeated += sum(step > len(planned) for step in taken)
    work.tally.left_over += debris(run)
    weights = load_file(run / "checkpoints/last/model.safetensors")
    assert all(torch.isfinite(t).all() for t in weights.values() if t.is_floating_point())
    assert state_of(run) == "done"
    return work.tally


def described(folder: Path) -> dict[str, list[Any]]:
    """Every image's descriptor in a folder of Parquet parts, by its path."""
    rows: dict[str, list[Any]] = {}
    for part in sorted(folder.rglob("part-*.parquet")):
        table = pq.read_table(part, columns=["key", "descriptor"])
        for key, values in zip(table["key"].to_pylist(), table["descriptor"].to_pylist(), strict=True):
            rows.setdefault(f"{part.parent} {key}".split("/out/")[1], []).append(values)
    return rows


def kill_evaluate(root: Path, chance: random.Random, kills: int) -> Tally:
    make_evaluation(root / "storm-evaluation", places=150)
    words = ["--checkpoint", str(root / "training/out/storm"), "--sets", str(root / "storm-evaluation"), "--split"]
    words += ["val", "--groups", "shuffled", "--group_size", "4", "--store", "fp32", "--figures", "false"]
    words += ["--batch", "4", "--workers", "1", "--track", "false", "--output"]
    whole = Work("jobs.evaluate", [*words, str(root / "evaluated/out")], root / "evaluated")
    whole.run(1)
    work = Work("jobs.evaluate", [*words, str(root / "evaluating/out")], root / "evaluating", ranks=(1, 2))
    work.took = whole.took
    again(work, chance, kills, lambda: ["--store", chance.choice(["fp32", "fp32", "none"])])
    work.run(2)
    a, b = described(root / "evaluated"), described(root / "evaluating")
    assert len(list((root / "evaluating/out").rglob("part-*.parquet"))) > 20
    work.tally.lost = sum(key not in b or b[key][0] != values[0] for key, values in a.items())
    work.tally.repeated = sum(len(values) - 1 for values in b.values())
    work.tally.left_over += [key for key in b if key not in a] + debris(root / "evaluating/out")
    results = [json.loads((root / f / "out/results.json").read_text())["results"] for f in ("evaluated", "evaluating")]
    assert results[0] == results[1]
    return work.tally


def kill_locate(root: Path, chance: random.Random, kills: int) -> Tally:
    photos = str(root / "storm-evaluation/images/val/database")
    words = ["--checkpoint", str(root / "training/out/storm"), "--build", photos, "--workers", "1", "--device", "cpu"]
    whole = Work("jobs.locate", [*words, "--index", str(root / "located/out")], root / "located")
    whole.run(1)
    work = Work("jobs.locate", [*words, "--index", str(root / "locating/out")], root / "locating")
    work.took = whole.took
    again(work, chance, kills)
    work.run(1)
    (a,), (b,) = ([contents(p) for p in (root / f / "out").glob("index-*")] for f in ("located", "locating"))
    work.tally.lost = sum(b.get(name) != data for name, data in a.items())
    assert len(list((root / "locating/out/described").glob("*.parquet"))) > 10
    rows = [photo for part in (root / "locating/out/described").glob("*.parquet")
            for photo in pq.read_table(part, columns=["photo"])["photo"].to_pylist()]  # fmt: skip
    work.tally.repeated = len(rows) - len(set(rows))
    work.tally.left_over += debris(root / "locating/out")
    return work.tally


def judge(found: dict[str, Tally], least: int) -> None:
    assert sum(tally.kills for tally in found.values()) >= least
    for name, tally in found.items():
        assert (tally.lost, tally.repeated, tally.left_over) == (0, 0, []), f"{name}: {tally}"
        assert tally.slowest_end < SOON, f"{name}: {tally}\n{tally.slowest_said}"


def test_a_few_kills(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    judge(storm(tmp_path, 0, {"prepare": 1, "training": 2}, monkeypatch), 2)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_sixty_kills(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kills = {"prepare": 15, "training": 24, "evaluate --store": 15, "locate --build": 12}
    judge(storm(tmp_path, 1, kills, monkeypatch), 60)
