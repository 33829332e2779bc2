"""The search on devices against faiss and brute force: on CPU tensors, on one process and sharded over two."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from processes import run_ranks
from tiny import make_evaluation

from pipeline.benchmark.sizes import SIZES, build
from pipeline.common.errors import DataError
from pipeline.config import EvaluationConfig
from pipeline.distributed import rank
from pipeline.evaluation import evaluate
from pipeline.evaluation.search import on_device
from pipeline.evaluation.search.exact import search, slices
from pipeline.evaluation.search.on_device import Nearest, search_on_devices
from pipeline.evaluation.sets.load import load_set


def descriptors(n: int, seed: int, dim: int = 24) -> np.ndarray:
    x = np.random.Generator(np.random.PCG64(seed)).normal(size=(n, dim))
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


def on_ranks(queries: np.ndarray, database: np.ndarray, k: int, rows: int) -> tuple[Any, Any]:
    """As an evaluation calls it: rank 0 alone has descriptors."""
    first = rank() == 0

    def blocks() -> Any:
        return ((numbers[::-1].copy(), block[::-1].copy()) for numbers, block in slices(database, rows))

    return search_on_devices(queries if first else None, blocks if first else None, k, torch.device("cpu"))


@pytest.mark.parametrize("kind", [np.float32, np.float16])
def test_equal_to_faiss_on_one_process_and_sharded_over_two(kind: type) -> None:
    """Copies of rows in other blocks tie exactly, and are ordered by row; the last block has one row for two ranks."""
    database, queries = descriptors(301, 0).astype(kind), descriptors(20, 1)
    database[150:200] = database[50:100]
    database[7] = database[260] = queries[3].astype(kind)
    distances, rows = search(queries, slices(database, 50), 12)
    truth = ((queries[:, None].astype(np.float64) - database[None].astype(np.float64)) ** 2).sum(-1)
    assert (rows == np.argsort(truth, 1, kind="stable")[:, :12]).all(), "this test would compare with a rounding"
    alone = on_ranks(queries, database, 12, 50)
    assert (alone[1] == rows).all()
    np.testing.assert_allclose(alone[0], distances, atol=2e-6)
    np.testing.assert_array_equal(alone[0], np.sort(truth, 1)[:, :12].astype(np.float32))
    for found in run_ranks(on_ranks, 2, queries, database, 12, 50):
        assert (found[1] == rows).all()
        np.testing.assert_array_equal(found[0], alone[0])  # to the bit


def test_more_copies_than_candidates_and_fewer_rows_than_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(on_device, "MARGIN", 2)
    monkeypatch.setattr(on_device, "QUERIES", 4)
    monkeypatch.setattr(on_device, "PAIRS_BYTES", 1)
    one, queries = descriptors(1, 3), descriptors(9, 4)
    database = np.concatenate([descriptors(30, 5), np.repeat(one, 40, 0), descriptors(30, 6)])
    queries[2] = one[0]
    distances, rows = on_ranks(queries, database, 5, 64)
    truth = ((queries[:, None].astype(np.float64) - database[None]) ** 2).sum(-1)
    assert (rows == np.argsort(truth, 1, kind="stable")[:, :5]).all() and rows[2].tolist() == [30, 31, 32, 33, 34]
    distances, rows = on_ranks(queries, database[:3], 5, 64)
    assert (
        (rows[:, 3:] == -1).all() and np.isinf(distances[:, 3:]).all() and (np.sort(rows[:, :3], 1) == range(3)).all()
    )


def test_rounding_of_products_does_not_choose(monkeypatch: pytest.MonkeyPatch) -> None:
    """Far from the origin float32 products cannot tell these rows apart; their differences can."""
    rng = np.random.Generator(np.random.PCG64(7))
    database = (100 + 1e-2 * rng.normal(size=(400, 16))).astype(np.float32)
    queries = (100 + 1e-2 * rng.normal(size=(6, 16))).astype(np.float32)
    truth = ((queries[:, None].astype(np.float64) - database[None]) ** 2).sum(-1)
    nearest = Nearest(torch.from_numpy(queries), 4)
    nearest.add(torch.arange(400), torch.from_numpy(database))
    assert (nearest.rows.numpy() == np.argsort(truth, 1, kind="stable")[:, :4]).all()


def broken(queries: np.ndarray, database: np.ndarray) -> str:
    try:
        on_ranks(queries, database, 3, 16)
    except (DataError, MemoryError) as error:
        return f"{type(error).__name__}: {error}"
    return "nothing"


def test_what_fails_on_one_rank_ends_all_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    database = descriptors(64, 0)
    database[40, 2] = np.nan
    told = run_ranks(broken, 2, descriptors(4, 1), database)
    assert told[0] == told[1] and "database descriptor 7 is not finite" in told[0]

    def full(self: Nearest, *_: Any) -> None:
        if rank() == 1:
            raise DataError("no room")

    monkeypatch.setattr(Nearest, "add", full)
    assert run_ranks(broken, 2, descriptors(4, 1), descriptors(64, 0)) == ["DataError: rank 1: no room"] * 2


def evaluated_by_devices(root: Path, devices: bool) -> list[Any]:
    """An evaluation, its search on this rank's (CPU) device or by faiss."""
    evaluate.on_devices = lambda *_: devices  # type: ignore[assignment]
    sets = [load_set(str(root), EvaluationConfig())]
    config = EvaluationConfig(groups=("single",), workers=0, recalls=(1, 3), prefix=24)
    torch.manual_seed(0)
    found = evaluate.evaluate(build(SIZES["tiny"]), sets, config, "cpu", progress=False)
    return [(r.recalls, r.predictions, r.distances) for r in found]


@pytest.mark.slow
def test_an_evaluation_answers_as_with_faiss(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluate, "on_devices", evaluate.on_devices)  # restored at the end
    make_evaluation(tmp_path / "town", 6, "test")
    (truth,) = evaluated_by_devices(tmp_path / "town", False)
    ranks = run_ranks(evaluated_by_devices, 2, tmp_path / "town", True)
    for (found,) in (evaluated_by_devices(tmp_path / "town", True), *ranks):
        assert found[0] == truth[0] and (found[1] == truth[1]).all()
        np.testing.assert_allclose(found[2], truth[2], atol=1e-5)
