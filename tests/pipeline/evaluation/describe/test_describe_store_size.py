"""Stores larger than memory: queries in batches, names compared in batches, and peaks that do not grow with rows."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from pipeline.benchmark.own_process import alone
from pipeline.benchmark.store import Numbered, find, fit, project, protocol, read, recalls, write
from pipeline.config import EvaluationConfig
from pipeline.evaluation.describe.store import DescriptorStore
from pipeline.evaluation.describe.stored import evaluate_stores
from pipeline.evaluation.evaluate import answer_queries
from pipeline.evaluation.predictions import load_predictions, save_predictions
from pipeline.evaluation.search import approximate, exact
from pipeline.evaluation.sets.evaluation_set import EvaluationSet

CONFIG = EvaluationConfig(recalls=(1, 4), groups=("single",))


@pytest.mark.parametrize("search", ["exact", "parts", "hnsw"])
def test_queries_in_batches_are_answered_as_all_at_once(monkeypatch: pytest.MonkeyPatch, search: str) -> None:
    rng = np.random.Generator(np.random.PCG64(0))
    database, queries = rng.normal(size=(300, 12)).astype(np.float32), rng.normal(size=(90, 12)).astype(np.float32)
    shuffled = rng.permutation(90)  # a store of shuffled groups gives its rows in any order
    numbers = [shuffled[first : first + 7] for first in range(0, 90, 7)]
    described = {
        "database": lambda: exact.slices(database, 64),
        "queries": lambda: ((part, queries[part]) for part in numbers),
    }
    part, of_query = np.arange(300) % 3, np.arange(90) % 3
    photos = [Path(f"{i}.jpg") for i in range(300)]
    evaluated = EvaluationSet("made", photos, photos[:90], [np.array([0])] * 90, "")
    if search == "parts":
        evaluated = dataclasses.replace(evaluated, database_part=part, query_part=of_query)
    used = dataclasses.replace(protocol("fp32"), search="hnsw" if search == "hnsw" else "exact")
    far = np.square(queries[:, None].astype(np.float64) - database[None]).sum(-1)
    far[(part[None] != of_query[:, None]) & (search == "parts")] = np.inf
    whole = answer_queries(evaluated, used, CONFIG, described)  # type: ignore[arg-type]
    monkeypatch.setattr(exact, "QUERY_BYTES", 600)  # 14 queries at a time
    assert [len(rows) for rows, _ in exact.batches(described["queries"])] == [14] * 6 + [6]  # type: ignore[arg-type]
    found = answer_queries(evaluated, used, CONFIG, described)  # type: ignore[arg-type]
    if search != "hnsw":
        assert (found.rows == np.argsort(far, 1)[:, :4]).all()
    assert (found.rows == whole.rows).all() and found.remarks == whole.remarks
    np.testing.assert_allclose(found.distances, np.take_along_axis(far, found.rows, 1), rtol=1e-4)


def test_made_stores_are_what_they_say(tmp_path: Path) -> None:
    """Rows do not depend on the part they are in, queries find theirs, names are told apart."""
    write(tmp_path, 900, 8, 24, "fp16")
    store = DescriptorStore(tmp_path / "descriptors/made/single_fp16store/database")
    assert np.allclose(np.linalg.norm(store.array().astype(np.float32), axis=1), 1, atol=1e-2)
    _, (whole, reduced) = recalls(tmp_path, 20, 5)
    assert whole == 100 and reduced > 50
    names = [Numbered("database", 900)[i] for i in range(900)]
    assert store.holds(names) and store.holds([path.absolute() for path in names])
    assert not store.holds(names[:-1]) and not store.holds([*names[:-1], names[0]]) and not store.holds(names[::-1])
    assert store.keys() == [str(name) for name in names]


def test_predictions_keep_lists_of_any_length(tmp_path: Path) -> None:
    write(tmp_path, 900, 8, 24, "fp32")
    positives = [np.arange(i % 3, dtype=np.int64) for i in range(8)]
    files = [list(Numbered("database", 900)), list(Numbered("queries", 8))]
    evaluated = EvaluationSet("made", *files, positives, "pairs")
    (result,) = evaluate_stores(tmp_path, [evaluated], CONFIG)
    loaded = load_predictions(save_predictions(result, evaluated, tmp_path / "predictions"))
    assert (loaded.rows == result.predictions).all() and (loaded.distances == result.distances).all()
    assert [p.tolist() for p in loaded.positives] == [p.tolist() for p in positives]


@pytest.mark.slow
def test_no_step_needs_more_memory_for_four_times_the_rows(tmp_path: Path) -> None:
    """25,000 and 100,000 x 1,344, two parts and nine: 403 MB more in float32, which would be seen."""
    peaks: dict[int, dict[str, float]] = {}
    for rows in (25_000, 100_000):
        folder = tmp_path / str(rows)
        steps = {
            "write": (write, (folder, rows, 64, 1_344, "fp16")),
            "read": (read, (folder,)),
            "search": (find, (folder, 10)),
            "fit": (fit, (folder, 32, True)),
            "project": (project, (folder, 32)),
            "recalls": (recalls, (folder, 32, 10)),
        }
        got = {name: alone(work, 600, *arguments) for name, (work, arguments) in steps.items()}
        assert not any(m.problem for m in got.values()), got
        assert got["recalls"].answer[1][0] == 100.0
        peaks[rows] = {name: m.peak for name, m in got.items()}
    grown = {name: (peaks[100_000][name] - peaks[25_000][name]) / 1e6 for name in peaks[25_000]}
    assert all(value < 150 for value in grown.values()), grown


@pytest.mark.parametrize("kind", ["exact", "hnsw", "binary"])  # binary: refined by floats
def test_an_opened_index_stays_on_the_disk(tmp_path: Path, kind: str) -> None:
    """The kernel has the file's vectors mapped, all of them, and they answer."""
    vectors = np.random.Generator(np.random.PCG64(0)).random((500, 2_000), np.float32) + 1
    vectors[:3] = np.eye(3, 2_000)
    approximate.save_index(approximate.build_index(partial(exact.slices, vectors), kind, True), tmp_path / "index")
    index = approximate.load_index(tmp_path / "index")
    mapped = [line.split() for line in Path("/proc/self/maps").read_text().splitlines() if str(tmp_path) in line]
    bounds = [[int(end, 16) for end in fields[0].split("-")] for fields in mapped]
    assert sum(end - start for start, end in bounds) >= vectors.nbytes
    assert approximate.search_index(index, np.eye(3, 2_000, dtype=np.float32), 1, 500)[1][:, 0].tolist() == [0, 1, 2]
