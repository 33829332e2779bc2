"""A disk that fills while a job writes: one line that names the file, code 3, nothing half-written under its name."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from job_process import JobProcess
from tiny import make_evaluation, prepare
from tiny_checkpoint import save_tiny

UNFINISHED = ("*.tmp", ".*.partial", ".part-*", ".writing-*")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model and 180 photos."""
    folder = tmp_path_factory.mktemp("full")
    save_tiny(folder / "run", 0)
    make_evaluation(folder / "photos", places=60)
    return folder


@pytest.fixture(scope="module")
def more(root: Path) -> Path:
    """Shards, too, and an index of the photos."""
    folder = prepare(root)
    words = ["--checkpoint", str(folder / "run"), "--build", str(folder / "photos"), "--workers", "0"]
    JobProcess("jobs.locate", [*words, "--device", "cpu", "--index", str(folder / "index")], folder / "log").wait()
    return folder


@contextmanager
def small_disk(folder: Path, kilobytes: int) -> Iterator[Path]:
    folder.mkdir(exist_ok=True)
    mount = ["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", str(folder)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount a small disk")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def words(job: str, root: Path, out: Path) -> list[str]:
    model, photos = ["--checkpoint", str(root / "run")], str(root / "photos")
    evaluate = [*model, "--sets", photos, "--split", "val", "--groups", "single", "--track", "false", "--workers", "0"]
    return {
        "prepare": ["--source", str(root / "gsv"), "--out", str(out), "--workers", "1", "--resize", "30"],
        "miniature": ["--out", str(out), "--places", "8"],
        "evaluate": [*evaluate, "--output", str(out)],
        "evaluate --store": [*evaluate, "--store", "fp32", "--output", str(out)],
        "locate --build": [*model, "--build", photos, "--index", str(out), "--device", "cpu", "--workers", "0"],
        "locate": [*model, "--index", str(root / "index"), "--photos", photos, "--output", str(out), "--device", "cpu"],
        "mine": [*model, "--shards", str(root / "shards"), "--out", str(out / "mined.safetensors")],
        "weights .pth": ["--source", str(root / "run"), "--to", str(out / "x.pth")],
        "weights .safetensors": ["--source", str(root / "run"), "--to", str(out / "x.safetensors")],
        "weights .onnx": ["--source", str(root / "run"), "--to", str(out / "x.onnx")],
    }[job]  # fmt: skip


SIZES = {
    "prepare": 40, "miniature": 60, "evaluate": 60, "evaluate --store": 60, "locate --build": 100, "locate": 16,
    "mine": 4, "weights .pth": 16, "weights .safetensors": 16, "weights .onnx": 100,
}  # fmt: skip


def fill(job: str, root: Path, kilobytes: int) -> None:
    with small_disk(root / "disk", kilobytes) as disk:
        process = JobProcess(f"jobs.{job.split()[0]}", words(job, root, disk / "out"), root / "said")
        code, said = process.wait(), process.text()
        line = said.strip().splitlines()[-1]
        print(f"{job}, {kilobytes} kB: code {code}: {line}")
        assert "Traceback" not in said, said
        left = [str(file) for name in UNFINISHED for file in disk.rglob(name)]
        assert code == 0 or not left, left
        assert (code, line) == (0, line) or (
            code == 3 and line.startswith(f"jobs.{job.split()[0]}: ") and str(disk) in line and "No space left" in line
        )
        assert code == 3 or kilobytes != SIZES[job], "the disk was not full"


@pytest.mark.parametrize("job", ["evaluate --store", "locate --build", "weights .pth"])
def test_a_full_disk_is_one_line(root: Path, job: str) -> None:
    fill(job, root, SIZES[job])


@pytest.mark.slow
@pytest.mark.parametrize("job", SIZES)
def test_a_disk_that_fills_anywhere_is_one_line(more: Path, job: str) -> None:
    for kilobytes in (SIZES[job], 24, 32, 48, 80, 120, 180, 260, 400):
        fill(job, more, kilobytes)
