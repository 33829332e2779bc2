"""Tables of the paper: their rows and figures, what they share and cost; one filled for real, continued and found in
MLflow; all of them in the slow suite."""

from __future__ import annotations

import csv
import dataclasses
import json
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from job_process import JobProcess
from PIL import Image
from tiny import prepare, run_settings

from pipeline.common.errors import UsageError
from pipeline.config import CrossImageConfig, EvaluationConfig, ModelConfig, RunConfig, from_dict
from pipeline.config.model import BackboneConfig
from pipeline.evaluation.protocol import Protocol
from pipeline.evaluation.report import paper_numbers
from pipeline.model.variants import VARIANTS, variant
from pipeline.paper import plan, study, table_report, values
from pipeline.paper.rows import EVERY_GROUPING, TABLES, Row, table, with_rows
from pipeline.paper.runner import Runner

ASKED = (
    "ablation_crica", "ablation_adaptation", "dimensions", "epochs", "encoder_layers", "train_batch",
    "inference_batch", "kernels", "spm", "same_data",
)  # fmt: skip


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = prepare(tmp_path_factory.mktemp("experiment"))
    blur_queries(made)
    return made


def blur_queries(root: Path) -> None:
    """Queries that are mostly noise: recalls between chance and all, so that a wrong figure is seen."""
    for number, path in enumerate(sorted((root / "evaluation").rglob("queries/*.jpg"))):
        photo = np.asarray(Image.open(path), np.float32)
        noise = np.random.default_rng(number).normal(size=photo.shape)
        Image.fromarray(np.clip(128 + 0.2 * (photo - 128) + 50 * noise, 0, 255).astype(np.uint8)).save(path, quality=90)


def settings(root: Path, **train: Any) -> Path:
    """A base configuration for the tiny data."""
    base = run_settings(root)
    base["train"] |= {"epochs": 1, "validate_first": False, "log_samples": False} | train
    base["validate"]["sets"] = []
    base["tracking"] = {"enabled": True}
    base["model"]["backbone"]["resnet"] = {"stages": [1, 1, 1, 1], "width": 8}
    base["model"]["pooling"] = {
        "netvlad": {"clusters": 4}, "cosplace": {"dim": 32}, "mixvpr": {"channels": 16},
        "salad": {"clusters": 4, "channels": 8, "token": 8, "hidden": 16},
        "boq": {"channels": 64, "queries": 4, "rows": 4},
    }  # fmt: skip
    path = root / "base.yaml"
    path.write_text(yaml.safe_dump(base))
    return path


def job(root: Path, name: str, *options: str) -> JobProcess:
    arguments = ["--table", name, "--config", str(root / "base.yaml"), "--sets", str(root / "evaluation")]
    arguments += ["--evaluate.split", "val", "--evaluate.workers", "0", *options]
    return JobProcess("jobs.experiment", arguments, root / f"{name}.log")


def run(root: Path, name: str, *options: str, code: int = 0) -> str:
    started = job(root, name, *options)
    assert started.wait(1200) == code, started.text()[-4000:]
    return started.text()


def built(root: Path, name: str, seeds: tuple[int, ...] = (0,), **evaluate: Any) -> study.Study:
    base = from_dict(RunConfig, yaml.safe_load(settings(root).read_text()))
    wanted = EvaluationConfig(
        sets=(str(root / "evaluation"),), split="val", workers=0, **{"recalls": (1, 5, 10), **evaluate}
    )
    return study.build(name, table(name), base, wanted, seeds, Runner(root / "outputs"))


@pytest.mark.timeout(900)  # starts interpreters: half a minute, minutes on a busy machine
def test_a_table_is_filled_continued_and_found_in_mlflow(root: Path) -> None:
    """Five rows of one training; the figures are those of the library asked directly; nothing is done twice."""
    settings(root)
    first = run(root, "inference_batch")
    filled = built(root, "inference_batch", resize="published")
    assert [filled.runner.status(each) for each in filled.trainings] == ["finished"]
    assert first.count("-m jobs.train") == 1 and first.count("--measure") == 1
    rows = list(csv.DictReader((root / "outputs/tables/inference_batch/table.csv").open()))
    ours = {(r["row"], r["protocol"], r["n"]): float(r["mean"]) for r in rows}
    assert {r["row"] for r in rows} == {"1", "4", "8", "16", "32"}
    from pipeline.evaluation.evaluate import evaluate
    from pipeline.evaluation.sets.load import load_set
    from pipeline.model.weights.files import load_model

    (run_folder,) = (root / "outputs").glob("CricaVPR-*-seed0")
    asked = EvaluationConfig(
        split="val", groups=("ordered",), group_size=4, recalls=(1, 5), resize="published", workers=0
    )
    (truth,) = evaluate(load_model(run_folder), [load_set(str(root / "evaluation"), asked)], asked, "cpu")
    assert 0 < truth.recalls[1] < 100
    assert {k: ours["4", "ordered4_published_28px", str(k)] for k in (1, 5)} == truth.recalls
    # the paper's figure for the same row, named with its set
    assert {r["paper"] for r in rows if r["row"] == "4" and r["n"] == "1"} == {"93.9"}
    assert {r["paper_set"] for r in rows} == {"pitts30k"}
    kept = (root / "outputs/tables/inference_batch/table.md").read_text()
    assert (root / "outputs/tables/inference_batch/table.png").stat().st_size > 10_000

    shutil.rmtree(run_folder)  # another machine: only MLflow knows
    again = built(root, "inference_batch", resize="published")
    assert again.measured_speed() and [again.runner.status(each) for each in again.trainings] == ["to do"]
    again.fill(run=False)
    assert table_report.markdown(again, ()) == kept


def test_every_table_asked_for_is_there_with_the_papers_rows() -> None:
    assert set(ASKED) <= set(TABLES)
    for name in ASKED:
        if name != "same_data":
            assert list(TABLES[name].rows) == list(paper_numbers.TABLES[name][1])
        for row in TABLES[name].rows.values():
            assert row.variant in VARIANTS
    with pytest.raises(UsageError, match="did you mean 'kernels'"):
        table("kernel")


def test_rows_at_the_papers_size_are_the_papers() -> None:
    """Nothing is rescaled when the base is the paper's; in proportion when it is not."""
    assert [plan.places(72, n) for n in (16, 32, 64, 72)] == [16, 32, 64, 72]
    assert [plan.places(16, n) for n in (16, 32, 64, 72)] == [4, 8, 14, 16]
    assert [plan.dimensions(10752, n) for n in (512, 4096)] == [512, 4096]
    assert plan.dimensions(1344, 512) == 64
    assert [plan.last_blocks(depth, 4) for depth in (12, 4, 2)] == [4, 1, 1]
    small = RunConfig(model=ModelConfig(BackboneConfig(name="custom", depth=2)))
    for base, trained in ((RunConfig(), 4), (small, 1)):
        found = plan.training(base, TABLES["same_data"].rows["SALAD"], 0, lambda _: 900)
        assert found.config.model.last_blocks == trained
        told = plan.own_settings(TABLES["same_data"].rows["SALAD"], found, base, None)
        assert told == ("" if trained == 4 else "last 1 of 2 blocks trained")
    steps = [plan.training(RunConfig(), row, 0, lambda _: 900).steps for row in TABLES["epochs"].rows.values()]
    assert steps == [9000, 4500, 900, 90]
    for n in range(4):
        row = TABLES["encoder_layers"].rows[str(n)]
        assert plan.training(RunConfig(), row, 0, lambda _: 1).config.model.cross_image.layers == n


def test_a_row_changes_only_what_it_says() -> None:
    """Sizes and weights of the base stay, and the model is that of the variant."""
    base = RunConfig(model=ModelConfig(cross_image=CrossImageConfig(feedforward=77)))
    for name in ASKED:
        for row in TABLES[name].rows.values():
            found = plan.training(base, row, 3, lambda _: 10).config
            assert found.model.cross_image.feedforward == 77 and found.seed == 3
            assert (found.loss, found.validate, found.train.lr) == (base.loss, base.validate, base.train.lr)
            if not row.changes:
                assert found.model == variant(row.variant, base.model)


def test_the_table_of_mined_batches_has_its_controls() -> None:
    """City, mined, permuted and near places ignored, each in both ways; rows differ in nothing else."""
    found = {n: plan.training(RunConfig(), row, 0, lambda _: 10).config for n, row in TABLES["mined"].rows.items()}
    told = [(c.data.order, c.data.mine_from, c.loss.ignore_within, c.train.passes) for c in found.values()]
    assert len(set(told)) == 8 and {way for *_, way in told} == {"group", "joint"}
    assert list(with_rows(TABLES["mined"], ["mined+joint", "city"]).rows) == ["city", "mined+joint"]
    with pytest.raises(UsageError, match="no row 'mind'; it has 'city', 'mined'"):
        with_rows(TABLES["mined"], ["mind"])
    assert {(order, source, near) for order, source, near, _ in told} == {
        ("city", "single", 0.0), ("mined", "single", 0.0), ("mined", "permuted", 0.0), ("mined", "single", 25.0)
    }  # fmt: skip


def test_same_settings_share_a_training_and_others_never_do() -> None:
    """Over all tables: equal names exactly where the configurations are equal."""
    named: dict[str, Any] = {}
    for name in TABLES:
        for row in TABLES[name].rows.values():
            for seed in (0, 1):
                found = plan.training(RunConfig(), row, seed, lambda _: 10)
                if row.needs:
                    continue
                assert named.setdefault(found.name, found.config) == found.config
    assert len(set(map(str, named.values()))) == len(named)
    crica = [plan.training(RunConfig(), TABLES[t].rows[r], 0, lambda _: 10).name for t, r in
             (("ablation_crica", "AdaptSPM+Crica"), ("encoder_layers", "2"), ("kernels", "MulConv"), ("epochs", "10"),
              ("train_batch", "72+Crica"), ("dimensions", "512"), ("inference_batch", "1"))]  # fmt: skip
    assert len(set(crica)) == 1
    # how a run is carried out is no part of its name
    slow = dataclasses.replace(RunConfig(), output="elsewhere", data=dataclasses.replace(RunConfig().data, workers=1))
    assert plan.training(slow, Row(), 0, lambda _: 10).name == crica[0]


def test_values_show_mean_and_spread_over_seeds(root: Path) -> None:
    one = values.Value((50.0, 54.0, 58.0))
    assert (one.mean, one.deviation, str(one)) == (54.0, pytest.approx(np.std([50, 54, 58], ddof=1)), "54.0 ±4.0")
    assert str(values.Value((50.0,))) == "50.0"
    filled = built(root, "kernels", (0, 1))
    name = next(iter(filled.sets.values())).name
    protocol = Protocol(groups="ordered", group_size=16, image_size=28)
    for row in ("5x5", "3x3"):
        filled.protocols[row, str(root / "evaluation")] = {"ordered": protocol}
    filled.values["5x5", name, "ordered16_28px"] = {1: [40.0, 44.0], 5: [80.0, 80.0]}
    filled.values["3x3", name, "ordered16_28px"] = {1: [40.0], 5: [80.0]}
    table = table_report.table(filled, str(root / "evaluation"))
    rows = table.rows
    assert table.head == ["row", "ordered16", "paper: pitts30k, ordered8"]
    assert rows[2] == ["5x5", "42.0 ±2.8 / 80.0 ±0.0", "94.7 / 97.3"]
    assert rows[1][1] == "40.0 / 80.0 (n 1)"
    assert table_report.markdown(filled, ()).count("\n| ") == len(["head", "rule", *rows])


def test_dry_run_tells_rows_trainings_cost_and_what_is_missing(root: Path) -> None:
    settings(root)
    told = run(root, "train_batch", "--dry-run", "--images_per_second", "10", "--seeds", "0,1")
    # 24 places, batches of 4 (72 in proportion); 16 of 72 places is never below two
    assert "8 rows, trainings needed: 8" in told and "6 steps, 96 images" in told
    assert "seed1" in told and "nothing is missing" in told and "at 10 images/s (given" in told
    assert not list((root / "outputs").glob("AdaptSPM*"))
    absent = run(root, "spm", "--dry-run", "--sets", "pitts30k", "--data.shards", str(root / "none"))
    assert "missing: pitts30k is not there" in absent and "unknown until the shards are there" in absent
    assert "no evaluation set of the table is there" in run(root, "spm", "--sets", "pitts30k", code=3)
    assert "did you mean 'spm'" in run(root, "smp", code=2)


def test_two_sets_of_one_name_are_refused(root: Path, tmp_path: Path) -> None:
    settings(root)
    (tmp_path / "evaluation").symlink_to(root / "evaluation")
    both = f"{root / 'evaluation'},{tmp_path / 'evaluation'}"
    assert "two sets are called 'evaluation'" in run(root, "spm", "--dry_run", "--sets", both, code=2)
    (tmp_path / "elsewhere").symlink_to(root / "evaluation")
    told = run(
        root, "spm", "--dry_run", "--sets", both.replace(str(tmp_path / "evaluation"), str(tmp_path / "elsewhere"))
    )
    assert "elsewhere: " in told and "evaluation: " in told


def test_pca_beyond_the_database_is_said_and_left_out(root: Path) -> None:
    filled = built(root, "dimensions")  # 14 x 16 = 224 dimensions, 16 database images
    assert [cell.config.pca for cell in filled.cells] == [11, 21, 43, 85, None]
    assert [bool(cell.impossible) for cell in filled.cells] == [False, True, True, True, False]
    assert len(filled.trainings) == 1 and "has a database of 16" in filled.notes["1024"]


def test_one_photo_asks_of_each_row_what_it_can_do(root: Path) -> None:
    filled = built(root, "one_photo", groups=("ordered",))
    asked = {cell.row: cell.config.groups for cell in filled.cells}
    assert asked == {"group": EVERY_GROUPING, "alone": ("single",), "joint": EVERY_GROUPING}
    names = [each.name for each in filled.trainings]
    assert len({name.split("-")[0] for name in names}) == 2 and "-joint-" in names[2] and len(set(names)) == 3
    assert all(pair[0] in asked and pair[1] in asked[pair[0]] for pairs in TABLES["one_photo"].paired for pair in pairs)


@pytest.mark.slow
def test_a_stopped_table_leaves_with_75_and_continues(root: Path) -> None:
    settings(root, epochs=40, save_every=2)
    started = job(root, "spm")
    started.kill_when(
        lambda: bool(list((root / "outputs").glob("FrozenDINOv2-GeM-*/checkpoints/last"))), signal.SIGTERM
    )
    assert started.wait() == 75, started.text()[-3000:]
    (folder,) = (root / "outputs").glob("FrozenDINOv2-GeM-*")
    stopped = json.loads((folder / "checkpoints/last/state.json").read_text())["state"]["step"]
    assert 0 < stopped < 240
    told = run(root, "spm")
    assert "continuing from" in told
    assert json.loads((folder / "checkpoints/last/state.json").read_text())["state"]["step"] == 240


@pytest.mark.slow
@pytest.mark.parametrize("name", [*ASKED, "parts", "mined", "one_photo"])
@pytest.mark.timeout(1800)
def test_every_table_runs_to_its_end(root: Path, name: str) -> None:
    settings(root)
    options = {
        "mined": ["--data.clique", "2", "--train.epochs", "2"],
        "one_photo": ["--seeds", "0,1"],  # a bank of 24 images: fewer than evaluate.bank
    }
    run(root, name, *options.get(name, []))
    rows = list(csv.DictReader((root / f"outputs/tables/{name}/table.csv").open()))
    left_out = {"dimensions": {"1024", "2048", "4096"}, "same_data": {"CricaVPR on Pitts30k"}}.get(name, set())
    assert {row["row"] for row in rows} == set(TABLES[name].rows) - left_out
    assert all(0 <= float(row["mean"]) <= 100 for row in rows)
    if TABLES[name].paired:
        compared = list(csv.DictReader((root / f"outputs/tables/{name}/paired.csv").open()))
        assert len(compared) == 2 * len(TABLES[name].paired) and {row["queries"] for row in compared} == {"8"}
    if name == "one_photo":
        means = {(row["row"], row["protocol"].split("_")[0], row["n"]): float(row["mean"]) for row in rows}
        joint = next(row for row in compared if (row["first"], row["second"]) == ("alone single", "joint single"))
        assert float(joint["recall_second"]) == pytest.approx(means["joint", "single", joint["n"]])
