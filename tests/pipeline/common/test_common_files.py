"""A folder that cannot be written is told before the work, by every job that writes results."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest
from full_disk import small_files

from pipeline.common.errors import UsageError
from pipeline.common.files import check_writable, unnamed_file


def unwritable(tmp_path: Path) -> dict[str, Path]:
    """Folders that nobody can make or write, not even root: below a file, in the kernel's file system."""
    (tmp_path / "file").touch()
    return {
        "a file in the way": tmp_path / "file" / "out",
        "no such place": Path("/proc/1/nothing"),
        "nul": Path("a\0b"),
    }


def test_what_cannot_be_written_is_a_line(tmp_path: Path) -> None:
    for folder in unwritable(tmp_path).values():
        with pytest.raises(UsageError, match=r"cannot be written \(.*\); give another folder with --output") as caught:
            check_writable(folder, "--output")
        assert str(caught.value).isprintable()
    check_writable(tmp_path / "new" / "folder", "--output")
    assert list((tmp_path / "new" / "folder").iterdir()) == []


@pytest.mark.parametrize("job", ["evaluate", "evaluate-store", "locate-build", "locate", "figures"])
def test_jobs_say_so_before_the_work(tmp_path: Path, job: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The checkpoint is no model and the photos are not there: none of it has been looked at."""
    (tmp_path / "model.safetensors").write_bytes(b"no model")
    (tmp_path / "a.jpg").touch()
    (tmp_path / "file").touch()
    bad, model = str(tmp_path / "file" / "out"), str(tmp_path / "model.safetensors")
    name, options = {
        "evaluate": ("jobs.evaluate", ["--checkpoint", model, "--output", bad]),
        "evaluate-store": ("jobs.evaluate", ["--from_store", str(tmp_path), "--output", bad]),
        "locate-build": ("jobs.locate", ["--checkpoint", model, "--build", str(tmp_path), "--index", bad]),
        "locate": ("jobs.locate", ["--checkpoint", model, "--index", str(tmp_path), "--photos",
                                   str(tmp_path / "a.jpg"), "--output", bad]),
        "figures": ("jobs.figures", ["--kind", "attention", "--checkpoint", model, "--photos",
                                     str(tmp_path / "a.jpg"), "--to", bad + "/x.png"]),
    }[job]  # fmt: skip
    monkeypatch.setattr(sys, "argv", [name, *options])
    with pytest.raises(UsageError, match=r"out: cannot be written \(Not a directory\); give another folder"):
        importlib.import_module(name).main()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.jpg", "file", "model.safetensors"]


def test_a_file_without_a_name_lives_as_long_as_its_mapping(tmp_path: Path) -> None:
    with unnamed_file(4_000, tmp_path) as file:
        values = np.memmap(file, np.float32, "r+", shape=(1_000,))
    values[:] = np.arange(1_000)
    values.flush()
    assert values.sum() == 499_500 and list(tmp_path.iterdir()) == []
    with pytest.raises(OSError, match=f"'{tmp_path}'"), small_files(1_000):
        unnamed_file(4_000, tmp_path)
