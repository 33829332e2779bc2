"""What goes wrong on one rank of two ends both, soon, with the same code and one line that names the rank.

The faults share one gloo group, as far as they leave it usable, and real trainings on different data a rank; what ends
processes has processes of its own. Each prints its time to the end of all ranks (`pytest -s`).
"""

from __future__ import annotations

import dataclasses
import errno
import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from full_disk import small_files
from job_process import JobProcess
from launched import Launched
from processes import alive, run_ranks
from safetensors.torch import load_file
from tiny import prepare, run_settings
from tiny_checkpoint import save_tiny

from pipeline.common.errors import UsageError, UserError
from pipeline.config import EvaluationConfig, ModelConfig, RunConfig, from_dict
from pipeline.distributed import rank
from pipeline.evaluation.describe import encode
from pipeline.training import checkpoint
from pipeline.training.launch import asked_processes, stop_signals
from pipeline.training.records import run_folder
from shards.index import read_index


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepare(tmp_path_factory.mktemp("faults"))


def settings(root: Path, name: str, **train: Any) -> dict[str, Any]:
    """Six steps of four places without validation, each step's samples logged."""
    plain = run_settings(root)
    plain["name"] = name
    plain["train"] |= {"epochs": 1, "validate_first": False, "save_every": 2, **train}
    plain["validate"]["sets"] = []
    return plain


def written(root: Path, name: str, **train: Any) -> Path:
    path = root / f"{name}.yaml"
    path.write_text(yaml.safe_dump(settings(root, name, **train)))
    return path


def broken_copy(root: Path, name: str, part: int) -> tuple[Path, dict[str, Any]]:
    """The shards with a broken JPEG in the first step's batch, in the part of rank `part` of two; and its row."""
    from pipeline.data.plan import plan

    index = read_index(str(root / "shards"))
    row = int(plan(index, 0, 0, 4, "city", 8).batches[0][2 * part])
    found = index.table.slice(row, 1).to_pylist()[0]
    shutil.copytree(root / "shards", root / name)
    with (root / name / found["shard"]).open("r+b") as file:
        file.seek(found["offsets"][2])
        file.write(b"\x00" * 64)
    return root / name, found


def ended(config: RunConfig, fault: Callable[[], Any] | None = None) -> tuple[int, str, float]:
    """A training in the group that is there: (code, message, seconds)."""
    from accelerate import Accelerator

    from pipeline.training.records.run_folder import working_in
    from pipeline.training.trainer import Trainer

    # what a launcher sets; the group itself is there already
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29500", "LOCAL_WORLD_SIZE": "2"}
    start = time.perf_counter()
    code, message = 0, ""
    with (fault or _nothing)():
        try:
            with working_in(Path(config.output) / config.name):
                Trainer(config, Accelerator(cpu=True)).fit()
        except UserError as error:
            code, message = error.exit_code, str(error)
        except ZeroDivisionError as error:
            code, message = 1, str(error)
    return code, message, time.perf_counter() - start


@contextmanager
def _nothing() -> Iterator[None]:
    yield


def run_config(plain: dict[str, Any], **places: str) -> RunConfig:
    config = from_dict(RunConfig, plain)
    data = {key.removeprefix("data_"): value for key, value in places.items() if key.startswith("data_")}
    own = {key: value for key, value in places.items() if not key.startswith("data_")}
    return dataclasses.replace(config, data=dataclasses.replace(config.data, **data), **own)  # type: ignore[arg-type]


def test_faults_on_one_rank_end_both_alike(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shards, row = broken_copy(root, "broken-shards", 1)
    netvlad = settings(root, "netvlad")
    netvlad["data"]["shards"] = str(broken_copy(root, "broken-first", 0)[0])
    netvlad["model"] = {"backbone": netvlad["model"]["backbone"], "pooling": {"kind": "netvlad"},
                        "adapter": {"kind": "none"}, "cross_image": {"layers": 0}, "trainable": "full"}  # fmt: skip
    (root / "a-file").write_text("")

    def faults() -> dict[str, tuple[int, str, float]]:
        one = rank() == 1
        found: dict[str, tuple[int, str, float]] = {}

        def plain(name: str, **train: Any) -> dict[str, Any]:
            return settings(root, name, **train)

        found["member does not decode"] = ended(run_config(plain("member"), data_shards=str(shards)))
        full = small_files(300) if one else _nothing()
        found["sample log on a full disk"] = ended(run_config(plain("log")), lambda: full)
        full = small_files(20_000) if not one else _nothing()
        ended(run_config(plain("save", steps=2)))  # a whole checkpoint first
        found["checkpoint on a full disk"] = ended(run_config(plain("save", steps=6)), lambda: full)
        own = str(root / "a-file" / "x") if one else str(root / "outputs")
        found["output folder"] = ended(run_config(plain("output"), output=own))
        where = str(root / "nowhere") if one else str(root / "shards")
        found["shards are missing"] = ended(run_config(plain("missing"), data_shards=where))
        where = str(root / "broken-shards") if one else str(root / "shards")
        found["other settings"] = ended(run_config(plain("other", lr=0.5 if one else 0.1)))
        found["clustering (rank 0)"] = ended(from_dict(RunConfig, netvlad))

        from pipeline.data.places import Places

        whole = Places.batch

        def bug(self: Places, positions: list[int]) -> Any:
            if one and positions[0] >= 4:
                raise ZeroDivisionError("a bug")
            return whole(self, positions)

        Places.batch = bug  # type: ignore[method-assign]
        found["a bug"] = ended(run_config(plain("bug")))
        Places.batch = whole  # type: ignore[method-assign]
        found["none"] = ended(run_config(plain("none")))  # the group is as good as new
        return found

    zero, second = run_ranks(faults, 2, timeout=240)
    for name, (code, message, seconds) in zero.items():
        print(f"{name}: codes [{code}, {second[name][0]}], {max(seconds, second[name][2]):.2f} s: {message}")
        if name != "a bug":
            assert second[name][:2] == (code, message), name
    codes = {name: code for name, (code, _, _) in zero.items()}
    assert codes == {
        "member does not decode": 3, "sample log on a full disk": 3, "checkpoint on a full disk": 3, "output folder": 3,
        "shards are missing": 3, "other settings": 2, "clustering (rank 0)": 3, "a bug": 1, "none": 0,
    }  # fmt: skip
    said = {name: message for name, (_, message, _) in zero.items()}
    assert said["member does not decode"].startswith("rank 1: ")
    assert f"{row['shard']}: member {row['sample']}.2.jpg of sample {row['sample']}" in said["member does not decode"]
    assert said["sample log on a full disk"].startswith(f"rank 1: {root}/outputs/log/samples.rank1.jsonl: ")
    assert said["checkpoint on a full disk"].startswith(f"rank 0: writing a checkpoint under {root}/outputs/save: ")
    assert said["output folder"].startswith("rank 1: opening the sample log in ")
    assert said["shards are missing"].startswith("rank 1: ") and "nowhere" in said["shards are missing"]
    assert said["other settings"].startswith("rank 1: the digest of the settings is ")
    assert said["clustering (rank 0)"].startswith("rank 0: ") and ".2.jpg" in said["clustering (rank 0)"]
    assert said["a bug"].startswith("rank 1: ZeroDivisionError: a bug") and second["a bug"][:2] == (1, "a bug")
    for name, run in (("member does not decode", "member"), ("checkpoint on a full disk", "save"), ("a bug", "bug")):
        status = run_folder.read_status(root / "outputs" / run)
        assert (status["exit_code"], status["message"]) == (codes[name], said[name]) and status["state"] == "failed"
    left = root / "outputs" / "save" / "checkpoints"
    assert (left / "last").resolve().name == "step-00000002" and not list(left.glob(".writing-*"))
    assert all(torch.isfinite(t).all() for t in load_file(left / "last/model.safetensors").values())


def test_faults_of_an_evaluation_end_both_alike(root: Path, tmp_path: Path) -> None:
    """A full disk under the descriptor store (rank 0) and under the regions' file (rank 1), a broken photo (rank 1)."""
    photos = tmp_path / "broken"
    shutil.copytree(root / "evaluation", photos)
    broken = sorted((photos / "images/val/database").iterdir())[5]  # batches of four: the second is rank 1's
    broken.write_bytes(broken.read_bytes()[:200])

    def faults() -> dict[str, tuple[int, str, float]]:
        from pipeline.evaluation.evaluate import evaluate
        from pipeline.evaluation.sets.load import load_set
        from pipeline.model.vpr import build_model

        config = EvaluationConfig(groups=("shuffled",), group_size=4, batch=4, workers=0, split="val", store="fp32")
        model = build_model(from_dict(ModelConfig, run_settings(root)["model"]), 28)
        found: dict[str, tuple[int, str, float]] = {}

        def attempt(name: str, folder: Path, limited: bool) -> None:
            start = time.perf_counter()
            code, message = 0, ""
            with small_files(100) if limited else _nothing():
                try:
                    evaluate(model, [load_set(str(folder), config)], config, "cpu", tmp_path / name, progress=False)
                except UserError as error:
                    code, message = error.exit_code, str(error)
            found[name] = (code, message, time.perf_counter() - start)

        attempt("store", root / "evaluation", rank() == 0)
        kept, encode.REGIONS_IN_MEMORY = encode.REGIONS_IN_MEMORY, 0
        attempt("regions", root / "evaluation", rank() == 1)
        encode.REGIONS_IN_MEMORY = kept
        attempt("photo", photos, False)
        attempt("none", root / "evaluation", False)
        return found

    zero, one = run_ranks(faults, 2)
    for name, (code, message, seconds) in zero.items():
        print(f"evaluation, {name}: codes [{code}, {one[name][0]}], {max(seconds, one[name][2]):.2f} s: {message}")
        assert one[name][:2] == (code, message)
    assert [zero[name][0] for name in ("store", "regions", "photo", "none")] == [3, 3, 3, 0]
    assert zero["store"][1].startswith("rank 0: evaluation database: ") and "too large" in zero["store"][1]
    assert f" {tmp_path}/store/descriptors/" in zero["store"][1]
    assert not list((tmp_path / "store").rglob("*.partial"))
    assert zero["regions"][1].startswith("rank 1: ") and "regions.1.bin" in zero["regions"][1]
    assert broken.name in zero["photo"][1]


def test_disks_of_two_machines(root: Path) -> None:
    """Rank 1 sees another output folder, as on a disk of its own machine: rank 0 reads the checkpoint and sends it."""

    def halves(shared: bool) -> tuple[int, list[float]]:
        from accelerate import Accelerator

        from pipeline.training.trainer import Trainer

        os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29500", "LOCAL_WORLD_SIZE": "2"}
        name = "shared" if shared else "apart"
        own = str(root / ("machine1" if rank() == 1 and not shared else "outputs"))
        starts = []
        for steps in (3, 6):
            trainer = Trainer(run_config(settings(root, name, steps=steps), output=own), Accelerator(cpu=True))
            starts.append(trainer.state.step)
            trainer.fit()
        total = sum(float(p.detach().double().abs().sum()) for p in trainer.engine.model.parameters())
        return starts[1], [total]

    apart, together = run_ranks(halves, 2, False), run_ranks(halves, 2, True)
    assert apart == together and apart[0] == apart[1], "the same weights as with one disk, on both ranks"
    assert apart[0][0] == 3
    assert sorted(p.name for p in (root / "machine1/apart").iterdir()) == ["samples.rank1.jsonl"]
    a, b = (load_file(root / f"outputs/{n}/checkpoints/last/model.safetensors") for n in ("apart", "shared"))
    assert all(torch.equal(a[name], b[name]) for name in a)


def test_a_broken_member_ends_both_processes_of_the_job(root: Path) -> None:
    shards, row = broken_copy(root, "broken-job", 1)
    path = written(root, "broken-job")
    start = time.monotonic()
    job = Launched(
        "ddp", 2, "jobs.train", ["--config", str(path), "--data.shards", str(shards)], root / "broken-job.log"
    )
    codes, said = job.wait(), [process.text() for process in job.ranks]
    print(f"member in the job: codes {codes}, {time.monotonic() - start:.1f} s from the start")
    assert codes == [3, 3], said
    (line,) = [line for text in said for line in text.splitlines() if line.startswith("jobs.train:")]
    assert line.startswith("jobs.train: rank 1: ") and f"{row['sample']}.2.jpg" in line and row["shard"] in line
    assert "Traceback" not in "".join(said)
    status = run_folder.read_status(root / "outputs/broken-job")
    assert status["exit_code"] == 3 and status["message"] in line


def test_dry_run_on_two_processes(root: Path) -> None:
    job = Launched("ddp", 2, "jobs.train", ["--config", str(written(root, "dry")), "--dry-run"], root / "dry.log")
    said = job.done()
    assert "2, 8 images each" in said and "memory a process" in said and "time an epoch" in said
    assert "memory a process" not in job.ranks[1].text()
    assert not (root / "outputs/dry").exists()


def test_a_trial_on_two_processes_writes_everything_and_touches_no_run(root: Path) -> None:
    """It replaces what a former trial left."""
    trial = root / "outputs" / "tried-fast-dev-run"
    (trial / "checkpoints" / "step-00000007").mkdir(parents=True)
    words = ["--config", str(written(root, "tried", epochs=50, schedule="cosine")), "--fast_dev_run"]
    words += ["--tracking.enabled", "true", "--validate.sets", str(root / "evaluation"), "--validate.groups", "bank"]
    job = Launched("ddp", 2, "jobs.train", words, root / "tried.log")
    assert "steps: step 2" in job.done()
    files = {str(file.relative_to(trial)) for file in trial.rglob("*")}
    last = "checkpoints/step-00000002"
    assert {f"{last}/model.safetensors", f"{last}/bank.safetensors", "curves.png", "mlflow_run_id"} <= files
    assert "checkpoints/step-00000007" not in files
    steps = [json.loads(line) for line in (trial / "samples.rank1.jsonl").read_text().splitlines()]
    assert [len(step["samples"]) for step in steps] == [2, 2], "places of this rank"
    assert "validation/evaluation_first8.bank8_28px.recall_at_5 " in (trial / "train.log").read_text()
    assert not (root / "outputs" / "tried").exists()


def test_a_second_training_in_a_folder_is_refused(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And what its status says while it runs, after a SIGKILL, and after Ctrl-C."""
    monkeypatch.setattr(run_folder, "ENDING", 0.3)  # inherited by the forked jobs
    run = root / "outputs/twice"
    path = written(root, "twice", epochs=1000)
    first = JobProcess("jobs.train", ["--config", str(path)], root / "twice.log")
    log = run / "samples.rank0.jsonl"
    deadline = time.monotonic() + 120
    while not (log.exists() and '"step": 3,' in log.read_text()):
        assert first.alive() and time.monotonic() < deadline, first.text()
        time.sleep(0.01)
    running = run_folder.read_status(run)
    assert (running["state"], running["exit_code"]) == ("running", None) and run_folder.state_of(run) == "running"
    second = JobProcess("jobs.train", ["--config", str(path)], root / "twice2.log")
    assert second.wait() == 2
    assert f"jobs.train: {run}: another training works in this folder" in second.text()
    assert run_folder.read_status(run) == running, "the refused one leaves the other's status alone"
    first.send(signal.SIGKILL)
    first.wait()
    assert run_folder.read_status(run) == running and run_folder.state_of(run) == "killed"
    step = max(int(line.split('"step": ')[1].split(",")[0]) for line in log.read_text().splitlines())
    third = JobProcess("jobs.train", ["--config", str(path)], root / "twice3.log")
    third.kill_when(lambda: f'"step": {step + 3},' in log.read_text(), signal.SIGINT)
    assert third.wait() == 130, third.text()
    assert "Traceback" not in third.text() and "interrupted: saved step" in third.text()
    status = run_folder.read_status(run)
    assert (status["state"], status["exit_code"]) == ("interrupted", 130)
    saved = json.loads((run / "checkpoints/last/state.json").read_text())["state"]["step"]
    assert saved >= step + 3 and f"saved step {saved}" in status["message"]
    fourth = JobProcess("jobs.train", ["--config", str(path), "--train.steps", str(saved + 1)], root / "twice4.log")
    assert fourth.wait() == 0 and run_folder.read_status(run)["state"] == "done"


def test_a_second_ctrl_c_ends_at_once() -> None:
    with stop_signals() as received:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)  # a launcher hands on what the terminal sent already
        assert received == [signal.SIGINT] * 2
        time.sleep(1.05)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_ranks_do_not_train_on_without_their_launcher(root: Path) -> None:
    """The launcher is killed by SIGKILL: its ranks save and leave, and their loader workers with them."""
    run = root / "outputs/orphans"
    path = written(root, "orphans", epochs=1000, save_every=1000)
    pids = root / "orphans.pids"

    def launcher() -> None:
        os.environ["TORCHELASTIC_RUN_ID"] = "as under a launcher"
        job = Launched("ddp", 2, "jobs.train", ["--config", str(path)], root / "orphans.log")
        pids.write_text(" ".join(str(process._process.pid) for process in job.ranks))
        job.wait()

    process = multiprocessing.get_context("fork").Process(target=launcher)
    process.start()
    log = run / "samples.rank1.jsonl"
    deadline = time.monotonic() + 120
    while not (log.exists() and '"step": 3,' in log.read_text()):
        assert process.is_alive() and time.monotonic() < deadline, (root / "orphans.log.0").read_text()[-3000:]
        time.sleep(0.02)
    process.kill()
    killed = time.monotonic()
    process.join()
    ranks = [int(pid) for pid in pids.read_text().split()]
    while any(alive(pid) for pid in ranks) and time.monotonic() < killed + 60:
        time.sleep(0.05)
    print(f"launcher killed: ranks gone after {time.monotonic() - killed:.1f} s")
    left = [pid for pid in ranks if alive(pid)]
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    assert not left
    status = run_folder.read_status(run)
    assert (status["state"], status["exit_code"]) == ("preempted", 75), status
    assert checkpoint.pointed(run, "last") is not None


SMALL_SHM = """
import sys
from pathlib import Path
import torch
from pipeline.common.errors import DataError
from pipeline.config import DataConfig, EvaluationConfig
from pipeline.data import workers
from pipeline.data.places import build_loader
from pipeline.evaluation.describe.encode import _Batches, _loader
from shards.index import read_index

if __name__ == "__main__":
    index = read_index(sys.argv[1] + "/shards")
    data = DataConfig(places_per_batch=4, image_size=280, workers=1, cache=sys.argv[1] + "/cache")
    photos = sorted(Path(sys.argv[1] + "/evaluation").rglob("*.jpg"))[:4]
    evaluated = _Batches(photos, [torch.arange(2).numpy(), torch.arange(2, 4).numpy()], 504, EvaluationConfig().resize)
    for batches in (build_loader(index, data, 0, 0, 0, 0, 1), _loader(evaluated, 1)):
        try:
            for batch in batches:
                pass
            print("no error")
        except DataError as error:
            print(error)
"""


def test_too_little_shared_memory_is_one_line(root: Path) -> None:
    """Docker gives 64 MB of /dev/shm; here 1 MB, and batches of 3.8 MB, in training's loader and in evaluation's."""
    script = root / "small_shm.py"
    script.write_text(SMALL_SHM)
    mount = "mount -t tmpfs -o size=1m tmpfs /dev/shm"
    if subprocess.run(["unshare", "--mount", "sh", "-c", mount], capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount a small /dev/shm")
    command = f"{mount} && exec {sys.executable} {script} {root}"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(["", *sys.path]).lstrip(os.pathsep) + f":{Path.cwd()}"}
    start = time.monotonic()
    done = subprocess.run(
        ["unshare", "--mount", "sh", "-c", command], capture_output=True, text=True, timeout=120, env=environment,
        check=False,
    )  # fmt: skip
    print(f"small /dev/shm, twice: {time.monotonic() - start:.1f} s")
    lines = done.stdout.splitlines()
    assert len(lines) == 2 and all(line.startswith("/dev/shm, through which") for line in lines), (lines, done.stderr)


def test_without_symbolic_links_last_and_best_are_text(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: Path, target: str, target_is_directory: bool = False) -> None:
        raise OSError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(Path, "symlink_to", refuse)
    from pipeline.model.weights.files import checkpoint_file

    def weights(path: Path) -> None:
        path.write_bytes(b"")

    config = from_dict(RunConfig, settings(root, "links"))
    for step in (1, 2, 3):
        checkpoint.write(tmp_path, checkpoint.RunState(step=step), config, weights, {})
        checkpoint.point(tmp_path, "best", checkpoint.folder(tmp_path, 1))
        checkpoint.prune(tmp_path, 1)
    assert (tmp_path / "checkpoints/last").read_text() == "step-00000003\n"
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == [
        "best", "last", "step-00000001", "step-00000003",
    ]  # fmt: skip
    found = checkpoint.find(tmp_path, "auto")
    assert found == checkpoint.pointed(tmp_path, "last") == tmp_path / "checkpoints/step-00000003"
    assert checkpoint.find(tmp_path / "other", str(tmp_path / "checkpoints/best")) == checkpoint.folder(tmp_path, 1)
    assert checkpoint_file(tmp_path).parent.name == "step-00000001"
    with pytest.raises(UsageError, match="already holds a run"):
        checkpoint.find(tmp_path, "never")


def test_two_evaluations_in_one_folder(root: Path, tmp_path: Path) -> None:
    """Each on two processes, with a store: the second is refused in one line, and the first never knows of it."""
    run, out = save_tiny(tmp_path / "run", 0), tmp_path / "out"
    words = ["--checkpoint", str(run), "--sets", str(root / "evaluation"), "--split", "val", "--groups", "single"]
    words += ["--store", "fp32", "--figures", "false", "--track", "false", "--workers", "0", "--output", str(out)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(encode, "encode_batch", partial(held, tmp_path / "go", encode.encode_batch))
        first = Launched("ddp", 2, "jobs.evaluate", words, tmp_path / "first")  # forked: its work waits for "go"
    first.ranks[0].until(lambda: (out / ".lock").exists())
    start = time.monotonic()
    second = Launched("ddp", 2, "jobs.evaluate", words, tmp_path / "second")
    codes = second.wait()
    print(f"second evaluation in a folder: codes {codes}, {time.monotonic() - start:.1f} s from the start")
    assert codes == [2, 2]
    (line,) = [line for rank in second.ranks for line in rank.text().splitlines() if line.startswith("jobs.evaluate:")]
    assert line.endswith(f"{out}: another evaluation works in it; wait for that, or give another --output")
    (tmp_path / "go").touch()
    first.done()
    assert (out / "results.json").exists()


def held(until: Path, work: Callable[..., Any], *arguments: Any) -> Any:
    while not until.exists():
        time.sleep(0.01)
    return work(*arguments)


def test_what_a_launcher_was_asked_for() -> None:
    line = "python -m accelerate.commands.accelerate_cli launch --num_processes 2 -m jobs.train --num_processes 9"
    assert asked_processes(line.split()) == 2
    assert asked_processes(line.replace("num_processes 2", "num-processes=4").split()) == 4
    assert asked_processes(["accelerate", "launch", "-m", "jobs.train", "--num_processes", "9"]) is None
    assert asked_processes(["bash", "-c", "x", "--num_processes", "2"]) is None


def test_status_tells_the_end_on_a_full_disk(tmp_path: Path) -> None:
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(tmp_path)], check=False).returncode:
        pytest.skip("needs the right to mount a small disk")
    try:
        with (
            pytest.raises(OSError, match="No space left"),
            run_folder.working_in(tmp_path / "run"),
            (tmp_path / "fill").open("wb", buffering=0) as file,
        ):
            while True:
                file.write(bytes(4096))
        status = run_folder.read_status(tmp_path / "run")
        assert (status["state"], status["exit_code"]) == ("failed", 3) and "No space left" in status["message"]
    finally:
        subprocess.run(["umount", str(tmp_path)], check=True)
