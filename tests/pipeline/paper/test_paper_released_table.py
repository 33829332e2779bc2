"""Comparisons filled from a folder of released files: what is found, chosen, evaluated, and told to be missing."""

from __future__ import annotations

import csv
import dataclasses
import json
from collections import Counter
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch
from accelerate import Accelerator
from tiny import make_evaluation, run_settings
from tiny_matchers import netvlad, transvpr

from jobs.experiment import ExperimentJob, compare
from pipeline.common.errors import UsageError
from pipeline.config import EvaluationConfig, ModelConfig, PoolingConfig, from_dict
from pipeline.config.baselines import CosPlaceConfig, NetVLADConfig
from pipeline.evaluation.evaluate import evaluate
from pipeline.evaluation.report import paper_numbers
from pipeline.evaluation.sets.load import load_set
from pipeline.model.vpr import PlaceModel, build_model
from pipeline.model.weights.files import load_model, save_model
from pipeline.paper import released_table
from pipeline.paper.measure import measure
from pipeline.paper.released_table import COMPARISONS, METHODS, build, paper_figure
from pipeline.paper.runner import Runner

CONFIG = EvaluationConfig(split="test", recalls=(1, 5, 10), workers=0, resize="published")


class Here(Runner):
    """Evaluates in this process, and counts."""

    carried: ClassVar[Counter[str]] = Counter()

    def carry_out(self, order: Path, what: str) -> None:
        self.carried[what] += len(json.loads(order.read_text())["evaluations"])
        measure(order, Accelerator(cpu=True))


def other(kind: str, **settings: Any) -> PlaceModel:
    """The small NetVLAD's network under another pooling."""
    config = netvlad().config
    torch.manual_seed(1)
    pooling = dataclasses.replace(PoolingConfig(kind=kind), **settings)  # type: ignore[arg-type]
    return build_model(dataclasses.replace(config, pooling=pooling), 96).eval()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two of the paper's sets and one more; eight files, one of them no weights and one of no compared method."""
    root = tmp_path_factory.mktemp("released")
    make_evaluation(root / "data" / "pitts30k", split="test")
    msls = make_evaluation(root / "data" / "msls_val", split="val")
    (msls / "msls_val_queries.txt").write_text("".join(f"p{place}\n" for place in range(8)))
    (root / "files").mkdir()
    tiny = run_settings(root)
    models = {
        "netvlad_vgg": netvlad(),
        "mapillary_WPCA4096": other("netvlad", netvlad=NetVLADConfig(clusters=4, projection=16)),
        "TransVPR_MSLS": transvpr(),
        "TransVPR_Pitts30k": transvpr(),
        "ResNet50_2048_eigenplaces": other("cosplace", cosplace=CosPlaceConfig(dim=24)),
        "unnamed": other("cosplace", cosplace=CosPlaceConfig(dim=24)),
        "CricaVPR": build_model(from_dict(ModelConfig, tiny["model"]), 28).eval(),
    }
    for name, model in models.items():
        save_model(model, root / "files" / f"{name}.safetensors", model.config, model.image_size, everything=True)
    (root / "files" / "page.pth").write_text("<html>sign in</html>")
    return root


def built(world: Path, name: str = "sota", **more: Any) -> released_table.ReleasedTable:
    config = dataclasses.replace(CONFIG, root=str(world / "data"))
    return build(name, world / "files", config, Here(world / "outputs"), **more)


def test_what_is_there_is_evaluated_once_and_stands_beside_the_papers(world: Path) -> None:
    table = built(world)
    Here.carried.clear()
    table.fill()
    assert sum(Here.carried.values()) == len(table.cells) == 9  # MSLS' file alone for Patch-NetVLAD, else two sets
    built(world).fill()
    assert sum(Here.carried.values()) == 9
    chosen = {(cell.release.method, cell.set_name): cell.release.path.stem for cell in table.cells}
    assert chosen["TransVPR", "pitts30k"] == "TransVPR_Pitts30k" and chosen["TransVPR", "msls_val"] == "TransVPR_MSLS"
    assert ("Patch-NetVLAD", "pitts30k") not in chosen and ("CosPlace", "pitts30k") not in chosen
    released_table.write(table, world / "written")
    rows = list(csv.DictReader((world / "written" / "table.csv").open()))
    found = {(r["method"], r["set"], r["n"]): r for r in rows}
    assert len(found) == len(rows) == 9 * 3
    for method, protocol in (("TransVPR", "_rerank100-transvpr"), ("EigenPlaces", "")):
        assert found[method, "msls_val", "1"]["protocol"] == f"single_published_96px{protocol}"
    assert found["CricaVPR", "pitts30k", "1"]["protocol"] == "ordered8_published_28px"
    assert found["CricaVPR", "msls_val", "1"]["protocol"] == "ordered16_published_28px"
    assert found["Patch-NetVLAD", "msls_val", "5"]["paper"] == "86.2"
    assert found["CricaVPR", "msls_val", "1"]["paper"] == "90.0"
    # the figures are those of the library asked directly
    asked = dataclasses.replace(CONFIG, root=str(world / "data"), groups=("single",), rerank=100, rerank_by="transvpr")
    model = load_model(world / "files" / "TransVPR_MSLS.safetensors")
    (truth,) = evaluate(model, [load_set("msls_val", asked)], asked, "cpu", progress=False)
    assert {k: float(found["TransVPR", "msls_val", str(k)]["recall"]) for k in (1, 5, 10)} == truth.recalls
    told = (world / "written" / "table.md").read_text()
    for line in (
        "re-ranking takes", "missing: Patch-NetVLAD on pitts30k: no file whose name says that it was trained on pitts",
        "missing: SFRS: no released file", "missing: tokyo247 is not there",
        "page.pth: a web page", "unnamed.safetensors: CosPlace or EigenPlaces, which no tensor says",
        "EigenPlaces: ResNet50_2048_eigenplaces.safetensors gives 24 numbers, the paper's 2,048",
        "CricaVPR: PCA is fitted on each set's own database",
        "CricaVPR on pitts30k: without PCA, which needs 85 images and has 16 of pitts30k",
    ):  # fmt: skip
        assert line.replace("_", "") in told.replace("\\", "").replace("_", ""), line
    assert not list((world / "files").glob("*pca*"))  # a folder of others' files is left as it is


def test_a_dry_run_tells_the_cost_and_writes_nothing(world: Path, capsys: pytest.CaptureFixture[str]) -> None:
    job = ExperimentJob(
        output=str(world / "nothing"), table="sota", released=str(world / "files"), dry_run=True, evaluate=CONFIG,
        sets=("pitts30k",), root=str(world / "data"), images_per_second=2.0,
    )  # fmt: skip
    compare(job)
    told = capsys.readouterr().out
    assert "TransVPR on pitts30k  [to do]  24 images of 96 px, 800 pairs to match; TransVPR_Pitts30k" in told
    assert "still to describe: 96 images; still to match: 800 pairs" in told  # four methods
    assert "about 0.0 hours at 2 images/s (given)" in told and "missing: MixVPR: no released file" in told
    assert not (world / "nothing").exists()
    compare(dataclasses.replace(job, rows=("EigenPlaces",), table="challenging"))
    assert "still to describe: 24 images; still to match: 0 pairs" in capsys.readouterr().out


def test_what_cannot_be_asked_is_one_line(world: Path) -> None:
    job = ExperimentJob(table="sota", released=str(world / "files"))
    (world / "empty").mkdir()
    for changes, told in (
        ({"released": ""}, "--table sota needs --released"),
        ({"released": str(world / "none")}, "none: there is no such folder"),
        ({"released": str(world / "empty")}, "empty: no released file there"),
        ({"rows": ("NetVLA",)}, "the table has no row 'NetVLA'"),
    ):
        with pytest.raises(UsageError, match=told):
            compare(dataclasses.replace(job, **changes))  # type: ignore[arg-type]


def test_rows_and_sets_are_the_papers(world: Path) -> None:
    """Every figure of the two tables of the paper has its row and set, and none is without."""
    assert tuple(paper_numbers.TABLES["sota"][1]) == COMPARISONS["sota"].methods
    for name, label in (("sota", "tab:compare_SOTA"), ("challenging", "suptab:compare_SOTA")):
        whole = COMPARISONS[name]
        sets = {(s, m) for (t, s, m) in paper_numbers.OTHERS if t == label}
        assert sets <= {(s, m) for s in whole.sets for m in whole.methods}
        loaded = load_set("pitts30k", dataclasses.replace(CONFIG, root=str(world / "data")))
        for set_name in whole.sets:
            for method in whole.methods:
                figure = paper_figure(method, dataclasses.replace(loaded, name=set_name))
                assert figure is not None and None not in figure.recalls and figure.table == label
    assert METHODS["Patch-NetVLAD"].settings["rerank"] == METHODS["TransVPR"].settings["rerank"] == 100
