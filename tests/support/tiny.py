"""Tiny real inputs for tests: GSV-Cities folders, an evaluation folder, shards and a config that trains in seconds."""

from __future__ import annotations

import json
import shutil
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from job_process import JobProcess
from PIL import Image

HEADER = "place_id,year,month,northdeg,city_id,lat,lon,panoid\n"


def photo(place: int, view: int, side: int = 40) -> Image.Image:
    """A noisy picture of a place: views of one place resemble each other."""
    pattern = np.random.default_rng(place).normal(size=(5, 5, 3)).repeat(side // 5, 0).repeat(side // 5, 1)
    noise = np.random.default_rng([place, view]).normal(size=pattern.shape)
    return Image.fromarray(np.clip(128 + 40 * pattern + 40 * noise, 0, 255).astype(np.uint8))


def make_gsv(folder: Path, places: int = 24, cities: int = 2, views: int = 5) -> Path:
    """A GSV-Cities folder with `places` places of `views` photos, spread over `cities` cities."""
    for c in range(cities):
        name = f"City{c}"
        (folder / "Images" / name).mkdir(parents=True)
        (folder / "Dataframes").mkdir(exist_ok=True)
        rows = [HEADER]
        for place in range(c, places, cities):
            for view in range(views):
                lat, lon, pano = f"4{c}.0{place:03d}", f"-3.7{view}", f"pano-{place}_{view}"
                rows.append(f"{place},2015,{view + 1},{10 * view},{name},{lat},{lon},{pano}\n")
                file = f"{name}_{place:07d}_2015_{view + 1:02d}_{10 * view:03d}_{lat}_{lon}_{pano}.jpg"
                photo(place, view).save(folder / "Images" / name / file, quality=90)
        (folder / "Dataframes" / f"{name}.csv").write_text("".join(rows))
    return folder


def make_evaluation(folder: Path, places: int = 8, split: str = "val") -> Path:
    """An evaluation folder `<folder>/images/<split>/{database,queries}` with `@utm` names, places 100 m apart."""
    for role, views in (("database", (0, 1)), ("queries", (2,))):
        target = folder / "images" / split / role
        target.mkdir(parents=True)
        for place in range(places):
            for view in views:
                east, north = 500000 + 100 * place + view, 4400000
                name = f"@{east:010.2f}@{north:010.2f}@30@N@40.0@-3.7@p{place}@@0@@@@2015@v{view}@.jpg"
                photo(1000 + place, view).save(target / name, quality=90)
    return folder


def run_settings(root: Path) -> dict[str, Any]:
    """A complete run config as plain values; shards in root/shards, runs in root/outputs."""
    return {
        "name": "tiny",
        "output": str(root / "outputs"),
        "data": {
            "shards": str(root / "shards"), "places_per_batch": 4, "image_size": 28, "augment": "light", "workers": 0,
            "cache": str(root / "cache"),
        },
        "model": {
            "backbone": {"name": "custom", "dim": 16, "depth": 2, "heads": 2, "patch": 7, "pretrain_grid": 4},
            "adapter": {"reduced": 4},
            "cross_image": {"layers": 1, "heads": 2, "feedforward": 16, "dropout": 0.1},
            "trainable": "full",
        },
        "train": {"epochs": 2, "lr": 1e-3, "patience": 0, "save_every": 2, "log_every": 1, "log_samples": True},
        "validate": {"sets": [str(root / "evaluation")], "split": "val", "groups": ["shuffled"], "group_size": 4,
                     "recalls": [1, 5], "workers": 0},
        "tracking": {"enabled": False},
    }  # fmt: skip


@cache
def _prepared(places: int) -> TemporaryDirectory[str]:
    made = TemporaryDirectory(prefix="tiny-")
    root = Path(made.name)
    make_gsv(root / "gsv", places)
    make_evaluation(root / "evaluation")
    arguments = ["--source", str(root / "gsv"), "--out", str(root / "shards"), "--rounds", "2", "--workers", "1"]
    assert JobProcess("jobs.prepare", arguments, root / "prepare.log").wait() == 0
    return made


def prepare(root: Path, places: int = 24) -> Path:
    """Puts drawn photos, shards that the project's own command made of them, and the evaluation folder under `root`."""
    shutil.copytree(_prepared(places).name, root, dirs_exist_ok=True)
    return root


def samples(root: Path, name: str) -> dict[int, list[str]]:
    """Step of a run -> the sample keys of the global batch, the logs of all ranks joined in rank order."""
    steps: dict[int, list[str]] = {}
    for path in sorted((root / "outputs" / name).glob("samples.rank*.jsonl")):
        for line in path.read_text().splitlines():
            entry = json.loads(line)
            steps.setdefault(entry["step"], []).extend(entry["samples"])
    return steps
