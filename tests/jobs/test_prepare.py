"""jobs.prepare as a person runs it: real processes, real kills, exit codes."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import simplejpeg

ROOT = Path(__file__).resolve().parents[2]


def job(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(words), cwd=ROOT, capture_output=True, text=True, timeout=120)


def command(words: Sequence[object]) -> list[str]:
    return [sys.executable, "-m", "jobs.prepare", *map(str, words)]


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """120 places in sub-folders, four to six photos each, of about 3 kB."""
    root = tmp_path_factory.mktemp("places")
    noise = np.random.default_rng(0).integers(0, 256, (64, 1024, 3), dtype=np.uint8)
    for place in range(120):
        (root / f"{place:03d}").mkdir()
        for view in range(4 + place % 3):
            crop = np.ascontiguousarray(noise[:, 8 * place : 8 * place + 48] // (view + 1))
            (root / f"{place:03d}" / f"{view}.jpg").write_bytes(simplejpeg.encode_jpeg(crop))
    return root


@pytest.fixture(scope="module")
def whole(source: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of an uninterrupted run with one process."""
    out = tmp_path_factory.mktemp("whole") / "out"
    done = job("--source", source, "--out", out, "--rounds", 2, "--shard-mb", 0.06, "--workers", 1)
    assert done.returncode == 0, done.stderr
    assert "places" in done.stdout and "images/s" in done.stdout and "120" in done.stdout
    return contents(out)


def kill_when(words: Sequence[object], out: Path, parts: int) -> list[int]:
    """Starts the job, kills it once so many groups are finished; returns its children's process ids."""
    process = subprocess.Popen(command(words), cwd=ROOT, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    until = time.monotonic() + 60
    while len(list(out.glob("unfinished/part-*.parquet"))) < parts and process.poll() is None:
        assert time.monotonic() < until
        time.sleep(0.001)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    pids = [int(word) for word in children.read_text().split()] if children.exists() else []
    process.kill()
    assert process.wait() == -signal.SIGKILL, "it was over before it could be killed"
    return pids


@pytest.mark.parametrize(("workers", "parts"), [(1, 9), (2, 3)])
def test_killed_and_started_again_it_ends_with_the_same_bytes(
    workers: int, parts: int, source: Path, whole: dict[str, bytes], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    words = ("--source", source, "--out", out, "--rounds", 2, "--shard-mb", 0.06, "--workers", workers)
    children = kill_when(words, out, parts)
    assert not (out / "manifest.json").exists()
    until = time.monotonic() + 10
    while any(Path(f"/proc/{pid}").exists() and _alive(pid) for pid in children):
        assert time.monotonic() < until, "a worker outlived the killed run"
        time.sleep(0.01)
    first = out / "round-00-00000.tar"
    kept = first.stat().st_mtime_ns if (out / "unfinished" / "part-00000.parquet").exists() else None
    again = job(*words)
    assert again.returncode == 0, again.stderr
    assert contents(out) == whole
    assert kept is None or first.stat().st_mtime_ns == kept
    if workers == 1:
        once_more = job(*words)
        assert once_more.returncode == 0 and "nothing to do" in once_more.stdout


def _alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except OSError:
        return False


@pytest.mark.slow
def test_any_number_of_kills_at_random_moments(source: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
    """SIGKILL after random milliseconds, again and again until a run gets through."""
    out, rng, kills = tmp_path / "out", random.Random(5), 0
    words = ("--source", source, "--out", out, "--rounds", 2, "--shard-mb", 0.06, "--workers", 2)
    for _ in range(25):
        process = subprocess.Popen(command(words), cwd=ROOT, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        time.sleep(rng.uniform(0.2, 2.5))
        if process.poll() is None:
            process.kill()
            kills += 1
        process.wait()
    assert job(*words).returncode == 0 and kills > 5
    assert contents(out) == whole


@pytest.mark.parametrize("name", ["round-01-00003.tar", "manifest.json"])
def test_verify_ends_with_three_on_one_flipped_bit(name: str, whole: dict[str, bytes], tmp_path: Path) -> None:
    for file, data in whole.items():
        flipped = data[:-9] + bytes([data[-9] ^ 4]) + data[-8:] if file == name else data
        (tmp_path / file).write_bytes(flipped)
    done = job("--verify", tmp_path)
    assert done.returncode == 3 and name in done.stdout and "do not train" in done.stderr
    assert len(done.stderr.strip().splitlines()) <= 2 and "Traceback" not in done.stderr


def test_verify_ends_with_zero_on_a_whole_set(whole: dict[str, bytes], tmp_path: Path) -> None:
    for file, data in whole.items():
        (tmp_path / file).write_bytes(data)
    done = job("--verify", tmp_path)
    assert done.returncode == 0 and "all well" in done.stdout


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        ((), 2, "--source DIR and --out DIR"),
        (("--source", "nowhere", "--out", "x"), 2, "no such folder"),
        (("--sorce", "x"), 2, "did you mean 'source'"),
        (("--source", "/", "--out", "/proc/shards"), 2, "/proc/shards: cannot be written"),
    ],
)
def test_wrong_use_is_one_clear_line(words: tuple[str, ...], code: int, told: str, tmp_path: Path) -> None:
    done = job(*(str(tmp_path / word) if word in ("nowhere", "x") else word for word in words))
    assert done.returncode == code and told in done.stderr
    assert "Traceback" not in done.stderr


def test_too_many_bad_images_end_with_three_and_overwrite_starts_again(source: Path, tmp_path: Path) -> None:
    mine, out = tmp_path / "mine", tmp_path / "out"
    shutil.copytree(source, mine, copy_function=os.link)
    broken = mine / "007" / "2.jpg"
    data = broken.read_bytes()
    broken.unlink()
    broken.write_bytes(data[:-100])
    words = ("--source", mine, "--out", out, "--rounds", 1, "--max-bad", 0.001)
    done = job(*words)
    assert done.returncode == 3 and "report.csv: 1 of 600 images" in done.stderr
    assert "007/2.jpg,.,007,broken JPEG: Premature end" in (out / "report.csv").read_text()
    verified = job("--verify", out)
    assert verified.returncode == 3 and "manifest.json is missing; the set is unfinished" in verified.stdout
    broken.write_bytes(data)
    refused = job(*words)
    assert refused.returncode == 2 and "source.digest" in refused.stderr
    mended = job(*words, "--overwrite")
    assert mended.returncode == 0, mended.stderr


def test_real_photos(shared_dir: Path, tmp_path: Path) -> None:
    """Twelve places of one city of the real set, links in place of copies."""
    real = shared_dir / "data" / "ie_tower_gsv"
    if not real.is_dir():
        pytest.skip("no real photos beside this checkout")
    lines = (real / "Dataframes" / "TowerHigh.csv").read_text().splitlines()[: 1 + 12 * 6]
    (tmp_path / "source" / "Dataframes").mkdir(parents=True)
    (tmp_path / "source" / "Images").mkdir()
    (tmp_path / "source" / "Dataframes" / "TowerHigh.csv").write_text("\n".join(lines))
    (tmp_path / "source" / "Images" / "TowerHigh").symlink_to(real / "Images" / "TowerHigh")
    out = tmp_path / "out"
    done = job("--source", tmp_path / "source", "--out", out, "--rounds", 2, "--resize", 128)
    assert done.returncode == 0, done.stderr
    from shards.index import read_index

    opened = read_index(str(out))
    assert (opened.places, opened.rounds, opened.table.num_rows) == (12, 2, 24)
    assert opened.manifest["counts"]["images_used"] == 72 == opened.manifest["counts"]["made_again"]
    row = opened.table.to_pylist()[5]
    data = (out / row["shard"]).read_bytes()
    assert simplejpeg.decode_jpeg(data[row["offsets"][2] :][: row["sizes"][2]]).shape == (128, 228, 3)


def test_parts_written_at_the_same_time_make_the_same_set(
    source: Path, whole: dict[str, bytes], tmp_path: Path
) -> None:
    """Three parts at once, one of them killed and started again; then the index: the bytes of one whole run."""
    words = ["--source", source, "--out", tmp_path / "out", "--rounds", 2, "--shard-mb", 0.06, "--workers", 1]
    parts = [[*words, "--part", part, "--parts", 3] for part in (1, 2, 3)]
    running = [subprocess.Popen(command(part), cwd=ROOT, stdout=subprocess.PIPE, text=True) for part in parts]
    until = time.monotonic() + 60
    while not list(tmp_path.glob("out/unfinished/part-*")) and time.monotonic() < until:
        time.sleep(0.002)
    running[0].kill()
    said = [process.communicate(timeout=60)[0] for process in running]
    assert [process.returncode for process in running[1:]] == [0, 0]
    assert "part 2 of 3 is written" in said[1]
    assert job(*parts[0]).returncode == 0
    assert not (tmp_path / "out" / "manifest.json").exists()
    done = job(*words)
    assert done.returncode == 0 and contents(tmp_path / "out") == whole, done.stderr
    again = job(*parts[1])
    assert again.returncode == 0 and contents(tmp_path / "out") == whole, "a finished set stays as it is"


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["--part", "4", "--parts", "3"], "--part 4: give 1 to 3"),
        (["--part", "1"], "--part and --parts go together"),
        (["--part", "1", "--parts", "3", "--overwrite"], "--overwrite deletes"),
    ],
)
def test_parts_that_cannot_be_are_refused(source: Path, tmp_path: Path, words: list[str], wanted: str) -> None:
    refused = job("--source", source, "--out", tmp_path / "out", *words)
    assert refused.returncode == 2 and wanted in refused.stderr
