"""The whole way on real photos, in short: shards, two processes, Gardens Point in all three groupings."""

from __future__ import annotations

import json
from pathlib import Path

from launched import Launched


def test_indoor_photos_to_gardens_point(shared_dir: Path, tmp_path: Path) -> None:
    data = shared_dir / "data"
    shards = tmp_path / "shards"

    def run(world: int, module: str, *words: str) -> str:
        return Launched("ddp", world, module, list(words), tmp_path / "log").done()

    out = run(1, "jobs.prepare", "--source", str(data / "ie_tower_gsv"), "--out", str(shards), "--rounds", "2")
    assert "336" in out
    assert "2,016" in out
    manifest = json.loads((shards / "manifest.json").read_text())
    assert sum(shard["samples"] for shard in manifest["shards"]) == 672
    run(1, "jobs.prepare", "--verify", str(shards))
    run(
        2, "jobs.train", "--config", "jobs/configs/demo.yaml", "--name", "indoor", "--output", str(tmp_path),
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
