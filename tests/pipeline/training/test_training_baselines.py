"""Baselines through the trainer of the method: each configuration is its variant, and one step moves what it trains."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from tiny import prepare, run_settings

from jobs.cli import parse
from pipeline.config import RunConfig, from_dict
from pipeline.model.variants import variant
from pipeline.training.trainer import Trainer

CONFIGS = Path(__file__).parents[3] / "jobs" / "configs"
TINY_POOLING: dict[str, Any] = {
    "netvlad": {"clusters": 4, "samples": 200, "per_image": 10},
    "cosplace": {"dim": 8},
    "mixvpr": {"channels": 8, "rows": 2, "depth": 1},
    "salad": {"clusters": 3, "channels": 4, "token": 8, "hidden": 16},
    "boq": {"channels": 64, "queries": 4, "layers": 1, "rows": 2},
}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepare(tmp_path_factory.mktemp("baselines"))


@pytest.mark.parametrize("name", ["NetVLAD", "GeM", "CosPlace", "MixVPR", "SALAD", "BoQ"])
def test_configurations_are_the_variants(name: str) -> None:
    config = parse(RunConfig, "", ["--config", str(CONFIGS / f"{name.lower()}.yaml")])
    assert config.model == variant(name)


def settings(root: Path, kind: str, resnet: bool) -> dict[str, Any]:
    values = run_settings(root)
    vit = values["model"]["backbone"]
    custom = {"name": "resnet_custom", "resnet": {"cut": "layer2", "stages": [1, 1], "width": 4}}
    values["name"] = f"{kind}-{resnet}"
    values["data"] = values["data"] | {"image_size": 28}
    values["model"] = {
        "backbone": custom if resnet else vit,
        "adapter": {"kind": "none"},
        "pooling": {"kind": kind, **({kind: TINY_POOLING[kind]} if kind in TINY_POOLING else {})},
        "cross_image": {"layers": 0},
        "trainable": "last",
        "last_blocks": 1,
    }
    values["train"] = {"steps": 1, "lr": 1e-2, "log_every": 1, "optimizer": "sgd"}
    values["validate"] = {"sets": []}
    return values


@pytest.mark.parametrize("resnet", [True, False])
@pytest.mark.parametrize("kind", ["gem", *TINY_POOLING])
def test_one_step_moves_what_is_trained_and_nothing_else(root: Path, kind: str, resnet: bool) -> None:
    from accelerate import Accelerator

    config = from_dict(RunConfig, settings(root, kind, resnet))
    trainer = Trainer(config, Accelerator(cpu=True))
    before = {n: p.detach().clone() for n, p in trainer.engine.model.named_parameters()}
    if kind == "netvlad":  # clustered from the shards: centres of features of unit length
        assert float(before["pooling.centroids"].norm(dim=1).max()) <= 1 + 1e-5
        again = Trainer(config, Accelerator(cpu=True)).engine.model.pooling.centroids
        assert torch.equal(again.detach(), before["pooling.centroids"])
    trainer.fit()
    model = trainer.engine.model
    moved = {n for n, p in model.named_parameters() if not torch.equal(p.detach(), before[n])}
    trained = {n for n, p in model.named_parameters() if p.requires_grad}
    assert moved <= trained
    # the images' mean loss may leave a bias or a query's key where it is, but each module's weights move
    assert {n.split(".")[0] for n in moved} == {n.split(".")[0] for n in trained}
