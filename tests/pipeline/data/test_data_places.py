"""The loader on real shards and real worker processes: its pixels, its errors, and how its workers live and die."""

from __future__ import annotations

import dataclasses
import io
import json
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import tarfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pipeline.common.errors import DataError
from pipeline.config import DataConfig
from pipeline.data.images import decode, shrink
from pipeline.data.places import Batch, Places, build_loader, members
from pipeline.data.plan import plan
from shards.index import ShardIndex, read_index
from shards.sources.street_view import read_folders
from shards.writer import WriteRule, write_shards

Make = Callable[..., ShardIndex]
CONFIG = DataConfig(places_per_batch=4, image_size=28, workers=0)


def epoch(
    index: ShardIndex, config: DataConfig, epoch: int = 0, start: int = 0, world: int = 1
) -> list[tuple[list[str], torch.Tensor, torch.Tensor]]:
    """All global batches from `start` on, the ranks' parts joined: (keys, labels, images)."""
    parts: list[list[Batch]] = [list(build_loader(index, config, 0, epoch, start, r, world)) for r in range(world)]
    return [
        (
            [key for b in ranks for key in b.keys],
            torch.cat([b.labels for b in ranks]),
            torch.cat([b.images for b in ranks]),
        )
        for ranks in zip(*parts, strict=True)
    ]


def equal(
    a: list[tuple[list[str], torch.Tensor, torch.Tensor]], b: list[tuple[list[str], torch.Tensor, torch.Tensor]]
) -> bool:
    return len(a) == len(b) > 0 and all(
        x[0] == y[0] and torch.equal(x[1], y[1]) and torch.equal(x[2], y[2]) for x, y in zip(a, b, strict=True)
    )


def test_batches_hold_what_the_shards_hold(small_set: ShardIndex) -> None:
    """Against tarfile and Pillow, which know nothing of offsets or of our resize."""
    found: dict[str, np.ndarray] = {}
    for shard in small_set.manifest["shards"]:
        with tarfile.open(Path(small_set.root) / shard["name"]) as tar:
            for member in tar:
                image = Image.open(io.BytesIO(tar.extractfile(member).read()))  # type: ignore[union-attr]
                found[member.name] = np.asarray(image.resize((28, 28), Image.Resampling.BILINEAR)).astype(int)
    rows = small_set.table.to_pylist()
    place = {row["sample"]: row["place"] for row in rows}
    seen = []
    for keys, labels, images in epoch(small_set, dataclasses.replace(CONFIG, augment="off")):
        assert images.shape == (16, 3, 28, 28) and images.dtype == torch.uint8 and labels.dtype == torch.int64
        assert labels.tolist() == [place[key] for key in keys for _ in range(4)]
        for number, key in enumerate(keys):
            for view in range(4):
                given = images[4 * number + view].permute(1, 2, 0).numpy()
                assert np.abs(given - found[f"{key}.{view}.jpg"]).max() <= 3  # two JPEG decoders, two resizes
        seen += keys
    assert len(set(seen)) == len(seen) == 24 and set(seen) <= set(place)


@pytest.mark.parametrize("workers", [1, 3])
@pytest.mark.filterwarnings("ignore:This DataLoader will create")
def test_workers_world_size_and_resuming_change_no_pixel(small_set: ShardIndex, workers: int) -> None:
    alone = epoch(small_set, CONFIG)
    many = dataclasses.replace(CONFIG, workers=workers)
    assert equal(epoch(small_set, CONFIG, world=4), alone)
    assert equal(epoch(small_set, many), alone)
    assert equal(epoch(small_set, many, start=2, world=2), alone[2:])
    assert epoch(small_set, CONFIG, start=6) == []
    assert not equal(epoch(small_set, CONFIG, epoch=1), alone)


def test_the_trainers_random_state_is_left_alone(small_set: ShardIndex) -> None:
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    epoch(small_set, CONFIG)
    assert torch.equal(torch.rand(3), expected)


@pytest.mark.parametrize("workers", [0, 1])
def test_a_broken_member_ends_the_epoch_in_one_line(make_set: Make, tmp_path: Path, workers: int) -> None:
    index = make_set(tmp_path, [6], damage="000003.2.jpg")
    config = dataclasses.replace(CONFIG, places_per_batch=2, workers=workers)
    with pytest.raises(DataError) as caught:
        list(build_loader(index, config, 0, 0, 0, 0, 1))
    message = str(caught.value)
    assert "\n" not in message and caught.value.exit_code == 3
    assert f"{tmp_path}/round0-0000.tar: member 000003.2.jpg of sample 000003 does not decode" in message


def test_missing_and_truncated_shards_are_named(make_set: Make, tmp_path: Path) -> None:
    index = make_set(tmp_path, [8])
    config = dataclasses.replace(CONFIG, places_per_batch=8)
    shard = tmp_path / "round0-0001.tar"
    raw = shard.read_bytes()
    shard.write_bytes(raw[:-1024])
    with pytest.raises(DataError, match=rf"round0-0001.tar: {len(raw) - 1024} bytes, but the manifest says {len(raw)}"):
        list(build_loader(index, config, 0, 0, 0, 0, 1))
    shard.unlink()
    with pytest.raises(DataError, match=r"round0-0001.tar: missing"):
        list(build_loader(index, config, 0, 0, 0, 0, 1))


def test_a_killed_worker_is_told_and_not_waited_for(small_set: ShardIndex) -> None:
    config = dataclasses.replace(CONFIG, workers=1, prefetch=1)
    iterator = iter(build_loader(small_set, config, 0, 0, 0, 0, 1))
    next(iterator)
    (worker,) = multiprocessing.active_children()
    worker.kill()
    with pytest.raises(DataError, match=r"exited unexpectedly: .* Lower data.workers"):
        list(iterator)


def test_descriptors_are_closed_and_never_pickled(small_set: ShardIndex) -> None:
    def opened() -> int:
        """Descriptors of this process that are shards of the set."""
        return sum(os.path.realpath(fd).startswith(small_set.root) for fd in Path("/proc/self/fd").iterdir())

    assert opened() == 0
    loader = build_loader(small_set, CONFIG, 0, 0, 0, 0, 1)
    next(iterator := iter(loader))
    assert opened() > 0
    copy: Places = pickle.loads(pickle.dumps(loader.dataset))
    assert equal_batches(copy.batch([0, 1]), loader.dataset.batch([0, 1]))
    copy.close()
    iterator.close()  # type: ignore[attr-defined]
    assert opened() == 0


def equal_batches(a: Batch, b: Batch) -> bool:
    return torch.equal(a.images, b.images) and torch.equal(a.labels, b.labels) and a.keys == b.keys


def test_rows_of_the_index_are_taken_in_order(small_set: ShardIndex) -> None:
    rows = plan(small_set, 0, 0, 4, "mixed").batches.reshape(-1)
    table = small_set.table.to_pylist()
    found = members(small_set, rows)
    assert found.samples == [table[row]["sample"] for row in rows]
    assert found.offsets.tolist() == [table[row]["offsets"] for row in rows]
    assert found.labels.tolist() == [table[row]["place"] for row in rows]


TRAINER = """
import json, signal, sys, time
from types import SimpleNamespace
import pyarrow as pa
from pipeline.config import DataConfig
from pipeline.data.places import build_loader
from shards.index import ShardIndex
from shards.schema import SCHEMA

def main():
    root, rows, manifest = json.loads(sys.stdin.readline())
    index = ShardIndex(root, pa.Table.from_pylist(rows, schema=SCHEMA), manifest, "0" * 64)
    asked = []
    for number in (signal.SIGTERM, signal.SIGUSR1):
        signal.signal(number, lambda *_: asked.append(1))
    count = 0
    config = DataConfig(places_per_batch=2, image_size=28, workers=2, prefetch=1)
    for batch in build_loader(index, config, 0, 0, 0, 0, 1):
        count += 1
        print(count, flush=True)
        if count == 2:
            while len(asked) < 2:
                time.sleep(0.05)
            time.sleep(6)  # longer than torch's workers wait before they look whether their parent is there
        if count == 8:
            time.sleep(60)  # with workers that have work to come

if __name__ == "__main__":
    main()
"""


def in_group(group: int) -> set[int]:
    """The processes alive in a process group."""
    alive = set()
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, member = path.read_text().rsplit(")", 1)[1].split()[:3]
        except (FileNotFoundError, ProcessLookupError):
            continue
        if int(member) == group and state != "Z":
            alive.add(int(path.parent.name))
    return alive


def test_workers_outlive_a_schedulers_signals_and_never_their_trainer(small_set: ShardIndex, tmp_path: Path) -> None:
    script = tmp_path / "trainer.py"
    script.write_text(TRAINER)
    process = subprocess.Popen(
        [sys.executable, str(script)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[3])},
    )  # fmt: skip
    assert process.stdin is not None and process.stdout is not None
    try:
        given = json.dumps([small_set.root, small_set.table.to_pylist(), small_set.manifest])
        process.stdin.write(given + "\n")
        process.stdin.flush()
        assert [process.stdout.readline().strip() for _ in range(2)] == ["1", "2"]
        assert len(in_group(process.pid)) >= 4  # trainer, fork server, two workers
        os.killpg(process.pid, signal.SIGUSR1)
        os.killpg(process.pid, signal.SIGTERM)
        assert [process.stdout.readline().strip() for _ in range(6)] == ["3", "4", "5", "6", "7", "8"]
        assert len(in_group(process.pid)) >= 4
    finally:
        process.kill()
        process.wait()
    deadline = time.monotonic() + 10
    while in_group(process.pid) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert in_group(process.pid) == set()


SLOW_TORCH = """
import time
from pathlib import Path
Path(__file__).with_name("importing").touch()
time.sleep(100)
"""


def test_the_fork_server_does_not_finish_its_imports_without_its_trainer(tmp_path: Path) -> None:
    (tmp_path / "torch.py").write_text(SLOW_TORCH)
    program = "import sys\nfrom pipeline.data import workers\nworkers.context()\nsys.stdin.read()"
    path = os.pathsep.join([str(tmp_path), str(Path(__file__).resolve().parents[3])])
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, start_new_session=True,
        env={**os.environ, "PYTHONPATH": path},
    )  # fmt: skip
    deadline = time.monotonic() + 30
    while not (tmp_path / "importing").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    process.kill()
    process.wait()
    deadline = time.monotonic() + 10
    while (left := in_group(process.pid)) and time.monotonic() < deadline:
        time.sleep(0.02)
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    assert not left and (tmp_path / "importing").exists()


def test_shards_written_by_this_project_give_back_their_photos(make_photo: Make, tmp_path: Path) -> None:
    """Folders of photos -> jobs.prepare's writer -> read_index -> batches: the source files' pixels, by rounds."""
    source: dict[int, dict[bytes, str]] = {}
    for place in range(9):
        for number in range(8):
            path = tmp_path / "photos" / f"place{place}" / f"{number}.jpg"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(make_photo(100 + place * 8 + number))
            pixels = shrink(decode(path.read_bytes()), (28, 28)).transpose(2, 0, 1)
            source.setdefault(place, {})[pixels.tobytes()] = path.name
    write_shards(read_folders(tmp_path / "photos"), tmp_path / "set", WriteRule(rounds=2, shard_mb=0.02, workers=1))
    index = read_index(str(tmp_path / "set"))
    shown: dict[int, set[str]] = {place: set() for place in range(9)}
    for number in (0, 1):
        for _, labels, images in epoch(index, dataclasses.replace(CONFIG, augment="off", places_per_batch=3), number):
            for label, image in zip(labels.tolist(), images, strict=True):
                shown[label].add(source[label][image.numpy().tobytes()])
    assert all(len(names) == 8 for names in shown.values())  # two rounds of four show all eight photos of each place
