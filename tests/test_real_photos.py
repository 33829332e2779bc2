"""The whole way on real photos, in short: shards, two processes, Gardens Point in all three groupings."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def run(*words: str) -> str:
    done = subprocess.run([sys.executable, "-m", *words], cwd=ROOT, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stdout[-1500:] + done.stderr[-2500:]
    return done.stdout + done.stderr


def test_indoor_photos_to_gardens_point(shared_dir: Path, tmp_path: Path) -> None:
    data = shared_dir / "data"
    shards = tmp_path / "shards"
    out = run("jobs.prepare", "--source", str(data / "ie_tower_gsv"), "--out", str(shards), "--rounds", "2")
    assert "336" in out
    assert "2,016" in out
    manifest = json.loads((shards / "manifest.json").read_text())
    assert sum(shard["samples"] for shard in manifest["shards"]) == 672
    run("jobs.prepare", "--verify", str(shards))
    run(
        "accelerate.commands.accelerate_cli", "launch", "--config_file", "jobs/accelerate/cpu.yaml",
        "-m", "jobs.train", "--config", "jobs/configs/demo.yaml", "--name", "indoor", "--output", str(tmp_path),
        "--data.shards", str(shards), "--data.image_size", "56", "--train.steps", "4", "--tracking.enabled", "false",
        "--model.backbone.dim", "48", "--model.backbone.depth", "2", "--validate.sets", "gardens_point",
        "--validate.root", str(data), "--validate.split", "test", "--validate.groups", "single,shuffled,ordered",
    )  # fmt: skip
    state = json.loads((tmp_path / "indoor/checkpoints/last/state.json").read_text())["state"]
    assert state["step"] == 4
    for moment in ("start", "validated"):
        protocols = {name.split(".")[1] for name in state[moment]}
        assert {p.partition("_")[0] for p in protocols} == {"single", "shuffled16", "ordered16"}, (
            "before and after, in all three groupings"
        )
        assert all(0 <= value <= 100 for value in state[moment].values())
    assert state["start"] != state["validated"]
