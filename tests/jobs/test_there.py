"""A missing file, a wrong name: told by every job before anything heavy is imported."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

CASES = [
    ("train", ["--data.shards", "nowhere"], "nowhere: there is no such folder of shards"),
    ("train", ["--data.shards", "here", "--model.backbone.weights", "data/dino"], "write hub:data/dino"),
    ("train", ["--data.shards", "here", "--validate.sets", "pits30k"], "pits30k: neither a path"),
    ("train", ["--data.shards", "here", "--validate.sets", "pitts30k"], "pitts30k: it is looked up in the folder data"),
    ("locate", ["--checkpoint", "nowhere", "--index", "i", "--photos", "here"], "nowhere: no model there"),
    ("locate", ["--checkpoint", "m.pth", "--index", "i", "--photos", "q.jpg"], "q.jpg: no such photo"),
    ("locate", ["--checkpoint", "m.pth", "--index", "i", "--photos", "here"], "i: no finished index there"),
    ("weights", ["--source", "nowhere.pth"], "nowhere.pth: there is no such weights file"),
    ("figures", ["--kind", "attention", "--checkpoint", "nowhere", "--to", "x.png"], "nowhere: there is no such"),
    ("figures", ["--kind", "tsne", "--checkpoint", "m.pth", "--to", "x.png", "--places_from", "p"], "--places_from p:"),
    ("evaluate", ["--checkpoint", "nowhere", "--sets", "pitts30k"], "nowhere: no model there"),
    ("evaluate", ["--checkpoint", "m.pth", "--sets", "town"], "town: neither a path"),
    ("mine", ["--checkpoint", "nowhere", "--out", "x"], "nowhere: no model there"),
    ("experiment", ["--table", "spn"], "unknown table 'spn'"),
]
PROGRAM = """
import importlib, json, sys
HEAVY = {"torch", "transformers", "scipy"}
for job, words in json.loads(sys.argv[1]):
    sys.argv = [job, *words]
    try:
        importlib.import_module(f"jobs.{job}").main()
    except Exception as error:
        print(json.dumps([type(error).__name__, str(error), sorted(HEAVY & set(sys.modules))]))
    else:
        print("null")
"""


def test_missing_files_are_told_before_heavy_imports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here").mkdir()
    (tmp_path / "m.pth").write_bytes(b"")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).resolve().parents[2]))
    cases = json.dumps([case[:2] for case in CASES])
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, cases], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    for (job, words, expected), line in zip(CASES, done.stdout.splitlines(), strict=True):
        kind, text, heavy = json.loads(line)
        assert kind in ("UsageError", "DataError") and expected in text, (job, words, text)
        assert heavy == [], (job, words)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["here", "m.pth"], "nothing was made"
