"""`jobs.evaluate --from_store` as a person starts it: recalls and PCA tables, model and pictures gone."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from job_process import JobProcess
from tiny import make_evaluation
from tiny_checkpoint import save_tiny


def finished(module: str, log: Path, *options: str, code: int = 0) -> str:
    job = JobProcess(module, list(options), log)
    assert job.wait() == code, job.text()
    assert "Traceback" not in job.text()
    return job.text()


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An evaluation with a store; afterwards the model is gone, and every photo empty."""
    home = tmp_path_factory.mktemp("home")
    make_evaluation(home / "data" / "town", 12, "test")
    save_tiny(home / "run", 0)
    common = ["--checkpoint", str(home / "run"), "--root", str(home / "data"), "--workers", "0", "--group-size", "4"]
    options = ["--store", "fp32", "--figures", "false", "--recalls", "1,3", "--groups", "single,ordered"]
    finished("jobs.evaluate", home / "log", *common, *options)
    shutil.rmtree(home / "run" / "checkpoints")
    for path in (home / "data").rglob("*.jpg"):
        path.write_bytes(b"")
    return home


def described(home: Path, grouping: str, side: str) -> tuple[np.ndarray, np.ndarray]:
    """(Positions, descriptors) by a plain Parquet reader."""
    folder = home / "run/evaluation/descriptors/town" / grouping / side
    table = pa.concat_tables(pq.read_table(f) for f in sorted(folder.glob("*.parquet"))).sort_by("row")
    places = np.stack([table["utm_east"].to_numpy(), table["utm_north"].to_numpy()], 1)
    return places, np.array(table["descriptor"].to_pylist())


def plainly(home: Path, grouping: str, dims: int | None, radius: float) -> dict[str, float]:
    """Recalls by numpy alone."""
    (where, base), (asked_at, asked) = (described(home, grouping, side) for side in ("database", "queries"))
    if dims is not None:
        middle = base.mean(0)
        axes = np.linalg.svd(base - middle, full_matrices=False)[2][:dims]
        base, asked = (base - middle) @ axes.T, (asked - middle) @ axes.T
    order = np.argsort(np.linalg.norm(asked[:, None] - base[None], axis=-1), axis=1, kind="stable")
    right = np.linalg.norm(asked_at[:, None] - where[None], axis=-1) <= radius
    found = np.take_along_axis(right, order, 1)
    return {str(k): 100.0 * float(found[:, :k].any(1).mean()) for k in (1, 3)}


@pytest.mark.parametrize("radius", [25.0, 150.0])
def test_dimensions_and_radius_from_the_store_alone(home: Path, radius: float) -> None:
    out = home / f"radius {radius}"
    options = ["--dimensions", "8,2,1", "--recalls", "1,3", "--radius", str(radius), "--output", str(out)]
    stores = ["--from_store", str(home / "run" / "evaluation"), "--root", str(home / "data")]
    text = finished("jobs.evaluate", home / "log", *stores, *options)
    assert "single_pca2_28px" in text and "ordered4_pca8_28px" in text
    results = json.loads((out / "results.json").read_text())["results"]
    assert len(results) == 8
    for result in results:
        protocol = result["protocol"]
        grouping = "single_28px" if protocol["groups"] == "single" else "ordered4_28px"
        assert result["recalls"] == pytest.approx(plainly(home, grouping, protocol["pca"], radius)), result
        assert protocol["rule"] == f"{radius:g} m"
        assert (out / "predictions" / f"town.{result['protocol_name']}.parquet").is_file()
    assert len({r["recalls"]["1"] for r in results}) > 2  # a table with something to see in it


def test_small_descriptors_beside_the_whole_in_one_table_that_compare_reads(home: Path) -> None:
    """The table's rows against numpy; codes refined among all rows answer as the floats do."""
    out = home / "small"
    stores = ["--from_store", str(home / "run" / "evaluation"), "--root", str(home / "data")]
    ways = ["--prefixes", "8", "--dimensions", "8", "--searches", "int8,binary", "--refine", "24"]
    options = [*ways, "--recalls", "1,3"]
    text = finished("jobs.evaluate", home / "log", *stores, *options, "--output", str(out))
    results = {r["protocol_name"]: r for r in json.loads((out / "results.json").read_text())["results"]}
    assert len(results) == 2 * 3 * 5 and "bytes an image" in text and "R@1 - whole, 95 %" in text
    where, base = described(home, "single_28px", "database")
    asked_at, asked = described(home, "single_28px", "queries")
    for short, dims in (("single", base.shape[1]), ("single_pca8", 8), ("single_prefix8", 8)):
        floats = results[f"{short}_28px"]
        assert floats["cost"]["bytes_each"] == 4 * dims
        for kind, least in (("int8", dims), ("binary", dims / 8)):
            codes, refined = results[f"{short}_28px_{kind}"], results[f"{short}_28px_{kind}_refine24"]
            assert least <= codes["cost"]["bytes_each"] and codes["cost"]["refine_bytes"] == 0
            assert refined["recalls"] == floats["recalls"] and refined["cost"]["refine_bytes"] == 4 * dims
            against, whole = codes["against_whole"], results["single_28px"]
            assert against["recalls"] == pytest.approx([whole["recalls"]["1"], codes["recalls"]["1"]])
            change = 100 * (against["gained"] - against["lost"]) / against["queries"]
            assert change == pytest.approx(against["recalls"][1] - against["recalls"][0])
    cut, asked = (x[:, :8] / np.linalg.norm(x[:, :8], axis=1, keepdims=True) for x in (base, asked))
    near = np.argmax(asked @ cut.T, axis=1)
    found = 100 * float((np.linalg.norm(asked_at - where[near], axis=1) <= 25).mean())
    assert results["single_prefix8_28px"]["recalls"]["1"] == pytest.approx(found)
    assert "against_whole" not in results["single_28px"]
    assert any("single_28px_int8_refine24 " in line and "+0.0 [+0.0, +0.0]" in line for line in text.splitlines())

    again = home / "again"
    shutil.copytree(out, again)
    told = finished("jobs.compare", home / "log", "--evaluations", f"{out},{again}", "--output", str(home))
    assert "single_prefix8_28px_binary_refine24" in told


def test_what_is_missing_is_one_line(home: Path) -> None:
    stores = ("--from_store", str(home / "run" / "evaluation"), "--root", str(home / "data"))
    cases = [
        (("--dimensions", "8"), 2, "--dimensions goes with --from_store"),
        ((*stores, "--group-size", "8"), 2, "--group_size: stored descriptors have their own"),
        ((*stores, "--checkpoint", str(home)), 2, "not both"),
        (("--from_store", str(home / "data")), 3, "no descriptors/ in it"),
        ((*stores, "--sets", "pitts30k"), 3, "pitts30k"),
        ((*stores, "--dimensions", "25"), 2, "PCA to 25 dimensions needs at least as many images"),
        ((*stores, "--dimensions", "0"), 2, "start at 1"),
        ((*stores, "--prefixes", "9999"), 2, "prefix 9999: the descriptors have"),
        ((*stores, "--searches", "int8", "--refine", "5"), 2, "refine 5 orders fewer candidates"),
        (("--searches", "int8"), 2, "--searches goes with --from_store"),
    ]
    for options, code, message in cases:
        assert message in finished("jobs.evaluate", home / "log", *options, code=code)
    (home / "data/town/images/test/database").rename(home / "aside")
    shutil.copytree(home / "aside", home / "data/town/images/test/database", dirs_exist_ok=True)
    next((home / "data/town/images/test/database").glob("*.jpg")).unlink()
    assert "holds other images than town has now" in finished("jobs.evaluate", home / "log", *stores, code=3)
