"""The demo: its last table says what was measured, and the whole of it runs at a small size."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from jobs.demo import ROWS, ending


def test_the_last_table_shows_each_row_under_each_protocol(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The best of a column is marked, also where two rows share it; a row without groups says so."""
    recalls = {"no-encoder": [31.5], "published": [26.5, 42.0, 38.0], "ours": [33.5, 42.0, 41.0]}
    for row in ROWS:
        names = ("single", "shuffled16", "ordered16")[: len(row.groups)]
        results = [
            {"protocol_name": name, "recalls": {"1": value, "5": value + 20}}
            for name, value in zip(names, recalls[row.run], strict=True)
        ]
        for file, content in (
            ("evaluation/results.json", {"results": results}),
            (
                "checkpoints/last/state.json",
                {"state": {"start": {"v.recall_at_5": 30.0}, "validated": {"v.recall_at_5": 59.0}}},
            ),
        ):
            path = tmp_path / row.run / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(content))
    ending(tmp_path, 252.0)
    said = capsys.readouterr().out
    lines = {line.split()[0]: " ".join(line.split()) for line in said.splitlines() if line.strip()}
    assert "4.2 minutes" in lines["Done"]
    assert lines["no-encoder"].endswith("31.5 / 51.5 as single as single 30 -> 59")
    assert lines["published"].endswith("26.5 / 46.5 42.0 / 62.0* 38.0 / 58.0 30 -> 59")
    assert lines["ours"].endswith("33.5 / 53.5* 42.0 / 62.0* 41.0 / 61.0* 30 -> 59")
    assert f"sqlite:///{tmp_path}/mlflow.db" in said


@pytest.mark.slow
def test_the_demo_runs_and_leaves_two_small_pictures(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "jobs.demo", "--output", str(tmp_path / "demo"), "--places", "24", "--epochs", "1"]
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert "The demo takes about" in done.stdout.splitlines()[1]
    found = sorted((tmp_path / "demo" / "images").iterdir())
    assert [path.name for path in found] == ["recall.png", "retrieval.jpg"]
    assert sum(path.stat().st_size for path in found) < 150_000
