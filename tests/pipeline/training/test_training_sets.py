"""Real runs over two shard sets: 2 ranks against 1, killed and resumed."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import yaml
from launched import Launched
from safetensors.torch import load_file
from tiny import make_gsv, prepare, run_settings, samples

from jobs.prepare import main as prepare_job


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Shards of 24 places and 2 rounds, and others of 10 places and 1 round, cities and places spelt alike."""
    root = prepare(tmp_path_factory.mktemp("sets"))
    make_gsv(root / "gsv2", 10, views=4)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["prepare", "--source", str(root / "gsv2"), "--out", str(root / "shards2")])
        prepare_job()
    return root


def config(root: Path, name: str, **data: Any) -> Path:
    settings = {**run_settings(root), "name": name}
    settings["data"] |= {"shards": [str(root / "shards"), str(root / "shards2")], **data}
    settings["validate"]["sets"] = []
    path = root / f"{name}.yaml"
    path.write_text(yaml.safe_dump(settings))
    return path


def run(path: Path, world: int = 1, code: int = 0) -> str:
    job = Launched("ddp", world, "jobs.train", ["--config", str(path)], path.with_suffix(".log"))
    assert job.wait() == [code] * world, job.ranks[0].text()[-3000:]
    return job.ranks[0].text()


def test_two_sets_on_two_ranks_killed_and_resumed(root: Path) -> None:
    weights = {"shard_weights": [0.5, 2.0]}
    run(config(root, "whole", **weights), 2)
    run(config(root, "one", **weights))
    assert samples(root, "one") == samples(root, "whole")
    # an epoch is two passes, each of 6 of the first set's places and the 10 of the other
    epoch = Counter(key.split("/")[0] for step in range(1, 9) for key in samples(root, "one")[step])
    assert epoch == {"0": 12, "1": 20}

    path = config(root, "killed", **weights)
    log = root / "outputs/killed/samples.rank1.jsonl"
    job = Launched("ddp", 2, "jobs.train", ["--config", str(path)], path.with_suffix(".log"))
    job.kill_when(lambda: log.exists() and '"step": 5,' in log.read_text())
    run(path, 2)
    assert samples(root, "killed") == samples(root, "whole")
    folders = [root / "outputs" / name / "checkpoints/last" for name in ("killed", "whole")]
    killed, whole = (load_file(folder / "model.safetensors") for folder in folders)
    assert all((killed[name] == whole[name]).all() for name in whole)
    digests = [json.loads((root / s / "manifest.json").read_text())["index_sha256"] for s in ("shards", "shards2")]
    assert json.loads((folders[0] / "state.json").read_text())["state"]["index"] == "+".join(digests)

    # the run knows both sets, their order and their weights
    turned = config(root, "killed", shards=[str(root / "shards2"), str(root / "shards")], **weights)
    assert f"was {digests[0][:12]} + {digests[1][:12]}" in run(turned, code=2)
    assert "data.shard_weights was" in run(config(root, "killed", shard_weights=[0.5, 1.0]), code=2)
