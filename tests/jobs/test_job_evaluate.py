"""`jobs.evaluate` as a person starts it: one process, two processes, and what it says when something is missing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from launched import Launched
from PIL import Image
from processes import run_ranks

from pipeline.common.errors import DataError, UserError
from pipeline.config import (
    AdapterConfig,
    BackboneConfig,
    CrossImageConfig,
    EvaluationConfig,
    ModelConfig,
    PoolingConfig,
)
from pipeline.distributed import rank
from pipeline.model.vpr import build_model
from pipeline.model.weights.files import save_model


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with a small random model, and a set of nine photos an aisle with `@utm` names."""
    folder = tmp_path_factory.mktemp("house")
    config = ModelConfig(
        backbone=BackboneConfig(name="custom", dim=16, depth=1, heads=2, patch=14, pretrain_grid=4),
        adapter=AdapterConfig(reduced=2),
        pooling=PoolingConfig(levels=(1, 2)),
        cross_image=CrossImageConfig(layers=1, heads=2, feedforward=16),
    )
    torch.manual_seed(0)
    best = folder / "run" / "checkpoints" / "best"
    best.mkdir(parents=True)
    save_model(build_model(config, 56), best / "model.safetensors", config, 56, everything=True)
    rng = np.random.Generator(np.random.PCG64(0))
    for split in ("test", "train"):
        for i in range(21):
            field = rng.integers(0, 256, (5, 5, 3))
            for side, noise in (("database", 0), ("queries", 25)):
                if side == "queries" and i >= 9:
                    continue
                image = (field + noise * rng.normal(size=field.shape)).clip(0, 255).astype(np.uint8)
                path = folder / f"data/aisle/images/{split}/{side}/@{500000 + 100 * i:010.2f}@{4000000:010.2f}@@.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                Image.fromarray(image).resize((60, 50), Image.Resampling.BICUBIC).save(path)
    return folder


def start(folder: Path, *options: str, processes: int = 1, code: int = 0) -> str:
    """What rank 0 printed."""
    words = ["--root", str(folder / "data"), "--workers", "0", *options]
    job = Launched("ddp", processes, "jobs.evaluate", words, folder / "log")
    assert job.wait() == [code] * processes, "\n".join(rank.text() for rank in job.ranks)
    return job.ranks[0].text()


def test_one_process_and_two_write_the_same_figures(run_folder: Path) -> None:
    common = ("--checkpoint", str(run_folder / "run"), "--group-size", "4", "--recalls", "1,5")
    told = start(
        run_folder, *common, "--sets", "aisle,pitts30k", "--pca", "6", "--pca-from", "aisle", "--store", "fp32"
    )
    assert "left out: pitts30k" in told
    assert all(
        name in told
        for name in (
            "single_pca6_from-aisle_56px",
            "shuffled4_pca6_from-aisle_56px",
            "ordered4_pca6_from-aisle_56px",
            "report.html",
        )
    )
    out = run_folder / "run" / "evaluation"
    results = json.loads((out / "results.json").read_text())
    assert [r["database"] for r in results["results"]] == [21] * 3 and results["left_out"][0].startswith("pitts30k")
    assert results["model"]["backbone"]["dim"] == 16 and len(results["fingerprint"]) == 16
    assert (out / "report.html").stat().st_size > 50_000 and (out / "figures" / "aisle.curves.png").is_file()
    assert (out / "descriptors/aisle/single_56px/database/part-00000.parquet").is_file()
    kept = sorted((run_folder / "run/checkpoints/best").glob("pca.aisle.*.safetensors"))
    assert len(kept) == 3
    changed = [f.stat().st_mtime_ns for f in kept]

    options = ("--pca", "6", "--pca-from", "aisle", "--output", str(run_folder / "two"), "--figures", "false")
    start(run_folder, *common, "--sets", "aisle", *options, processes=2)
    assert [f.stat().st_mtime_ns for f in kept] == changed  # read, not fitted again
    again = json.loads((run_folder / "two" / "results.json").read_text())["results"]
    assert [r["recalls"] for r in again] == [r["recalls"] for r in results["results"]]
    for file in (out / "predictions").glob("*.parquet"):
        mine, theirs = pq.read_table(file), pq.read_table(run_folder / "two" / "predictions" / file.name)
        assert mine["rows"] == theirs["rows"]
        near = np.array(mine["distances"].to_pylist()), np.array(theirs["distances"].to_pylist())
        np.testing.assert_allclose(*near, atol=1e-5)  # a store hands over other blocks, so sums round otherwise


def test_what_is_missing_is_said_in_one_line(run_folder: Path) -> None:
    nothing = start(run_folder, "--checkpoint", str(run_folder / "run"), "--sets", "pitts30k", code=3)
    assert "pitts30k is not there" in nothing and "Traceback" not in nothing
    assert "--checkpoint is missing" in start(run_folder, code=2)


def test_the_challenge_is_written_in_the_line_format_of_its_server(run_folder: Path) -> None:
    """No ground truth: no recall, but a line a query, `query_key key1 key2 ...`, nearest first, within its city."""
    root = run_folder / "cities"
    for city in ("athens", "miami"):
        for side, count in (("database", 3), ("query", 2)):
            base = root / "msls" / "test" / city / side
            (base / "images").mkdir(parents=True)
            for i in range(count):
                field = np.random.default_rng([city == "miami", i]).integers(0, 256, (4, 4, 3), np.uint8)
                photo = Image.fromarray(field).resize((60, 50), Image.Resampling.NEAREST)
                photo.save(base / "images" / f"{city}_{side[0]}{i}.jpg", quality=95)
            keys = "".join(f"{i},{city}_{side[0]}{i},True\n" for i in range(count))
            (base / "subtask_index.csv").write_text(",key,all\n" + keys)
    options = ["--checkpoint", str(run_folder / "run"), "--sets", "msls_challenge", "--root", str(root)]
    options += ["--groups", "single", "--recalls", "1,2", "--output", str(run_folder / "challenge")]
    assert "single" in start(run_folder, *options, "--figures", "false")
    (written,) = (run_folder / "challenge/predictions").glob("msls_challenge.single_56px*.txt")
    lines = written.read_text().splitlines()
    assert sorted(line.split()[:2] for line in lines) == sorted(
        [f"{city}_q{i}", f"{city}_d{i}"] for city in ("athens", "miami") for i in range(2)
    )
    assert all(key.startswith(line.split("_")[0]) for line in lines for key in line.split()) and len(lines) == 4


def test_what_fails_on_one_rank_ends_both_alike(run_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The model or a set that only rank 1 cannot read, a list of sets that is shorter there, a full disk on rank 0."""
    from accelerate import Accelerator

    import jobs.evaluate as job
    from pipeline.evaluation import predictions
    from pipeline.evaluation.sets import load
    from pipeline.model.weights import load as weights

    (run_folder / "data" / "twin").symlink_to(run_folder / "data" / "aisle")
    asked = {"groups": ("single",), "sets": ("aisle", "twin"), "root": str(run_folder / "data"), "workers": 0}
    config = EvaluationConfig(**asked, recalls=(1,))
    read_sets, write_all = load.load_sets, predictions.save_results

    def broken(*_: object) -> None:
        raise DataError("this disk is broken")

    def fewer(*arguments: object) -> object:
        sets, left_out = read_sets(*arguments)  # type: ignore[arg-type]
        return sets[:1], left_out

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    faults = {
        "model": (1, weights, "load_any", broken, "rank 1: this disk is broken"),
        "sets": (1, load, "load_sets", broken, "rank 1: this disk is broken"),
        "fewer sets": (1, load, "load_sets", fewer, "rank 1: the list of sets is aisle here and aisle, twin on rank"),
        "full disk": (0, predictions, "save_results", full, f"rank 0: writing the results into {run_folder}"),
    }

    def ends() -> list[str]:
        found = []
        for where, module, name, fault, _ in faults.values():
            whole = getattr(module, name)
            if rank() == where:
                setattr(module, name, fault)
            try:
                words = job.EvaluateJob(checkpoint=str(run_folder / "run"), output=str(run_folder / "alike"), **asked)
                job.run(words, config, Accelerator(cpu=True))
                found.append("no error")
            except UserError as error:
                found.append(f"{error.exit_code} {error}")
            setattr(module, name, whole)
        return found

    for name, value in {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29500", "LOCAL_WORLD_SIZE": "2"}.items():
        monkeypatch.setenv(name, value)
    zero, one = run_ranks(ends, 2)
    for (name, (_, _, _, _, wanted)), first, second in zip(faults.items(), zero, one, strict=True):
        print(f"{name}: {first}")
        assert first == second and first.startswith("2 " if name == "fewer sets" else "3 ") and wanted in first
    assert predictions.save_results is write_all
