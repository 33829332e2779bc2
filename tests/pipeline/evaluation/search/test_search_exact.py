"""Search against brute force in float64, ties, parts, approximations; and real photos against known figures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.common.errors import DataError
from pipeline.evaluation.recall import recall_at
from pipeline.evaluation.search.approximate import (
    CODES,
    agreement,
    build_index,
    bytes_each,
    index_bytes,
    load_index,
    save_index,
    search_index,
)
from pipeline.evaluation.search.exact import search, search_within, slices


def descriptors(n: int, dim: int = 16, seed: int = 0, clusters: int = 20) -> np.ndarray:
    rng = np.random.Generator(np.random.PCG64(seed))
    centres = np.random.Generator(np.random.PCG64(9)).normal(size=(clusters, dim))
    x = centres[rng.integers(0, clusters, n)] + 0.3 * rng.normal(size=(n, dim))
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("rows", [7, 64, 1000])
def test_blocks_do_not_change_the_exact_answer(rows: int) -> None:
    database, queries = descriptors(300), descriptors(40, seed=1)
    distances, found = search(queries, slices(database, rows), 10)
    truth = ((queries[:, None].astype(np.float64) - database[None]) ** 2).sum(-1)
    assert (found == np.argsort(truth, axis=1, kind="stable")[:, :10]).all()
    np.testing.assert_allclose(distances, np.sort(truth, axis=1)[:, :10], atol=2e-6)


def test_blocks_may_come_in_any_order() -> None:
    database, queries = descriptors(300), descriptors(5, seed=1)
    blocks = [(rows[::-1].copy(), block[::-1].copy()) for rows, block in slices(database, 50)][::-1]
    assert (search(queries, blocks, 10)[1] == search(queries, slices(database), 10)[1]).all()


def test_equal_distances_are_ordered_by_row() -> None:
    one = descriptors(1)
    database = np.repeat(one, 9, axis=0)
    for rows in (2, 4, 100):
        assert search(one, slices(database, rows), 4)[1].tolist() == [[0, 1, 2, 3]]


def test_a_small_database_pads() -> None:
    distances, found = search(descriptors(2), slices(descriptors(3)), 5)
    assert (found[:, 3:] == -1).all() and np.isinf(distances[:, 3:]).all() and (found[:, :3] >= 0).all()


def test_not_a_number_is_an_error_and_not_a_rank() -> None:
    bad = descriptors(30)
    bad[17, 3] = np.nan
    with pytest.raises(DataError, match="17 is not finite"):
        search(descriptors(2), slices(bad), 5)


def test_parts() -> None:
    database, queries = descriptors(90), descriptors(10, seed=1)
    part, asked = np.arange(90) % 3, np.arange(10) % 3
    found = search_within(queries, asked, lambda: slices(database, 20), part, 4)[1]
    for q in range(10):
        own = np.flatnonzero(part == asked[q])
        truth = own[np.argsort(((queries[q].astype(np.float64) - database[own]) ** 2).sum(1), kind="stable")[:4]]
        assert (found[q] == truth).all()


@pytest.mark.parametrize(("kind", "least"), [("exact", 100), ("hnsw", 97), ("ivfpq", 30), ("int8", 97), ("binary", 15)])
def test_an_index_agrees_with_exact_as_measured_and_survives_the_disk(kind: str, least: float, tmp_path: Path) -> None:
    database, queries = descriptors(2000, 32), descriptors(50, 32, seed=1)
    exact = search(queries, slices(database), 10)[1]
    shuffled = [(rows[::-1].copy(), block[::-1].copy()) for rows, block in slices(database, 300)]
    index = build_index(lambda: shuffled, kind)
    found = search_index(index, queries, 10)[1]
    assert agreement(found, exact) >= least
    save_index(index, tmp_path / "index.faiss")
    assert (search_index(load_index(tmp_path / "index.faiss"), queries, 10)[1] == found).all()
    assert abs((tmp_path / "index.faiss").stat().st_size - index_bytes(index)) < 200
    assert (search_index(build_index(lambda: shuffled, kind), queries, 10)[1] == found).all()  # seeded
    if kind in CODES:
        assert index_bytes(index) < database.nbytes  # with its tables; far less at scale
    (tmp_path / "broken").write_bytes(b"nothing of the kind")
    with pytest.raises(DataError, match="broken"):
        load_index(tmp_path / "broken")


@pytest.mark.parametrize("kind", CODES)
def test_floats_order_the_candidates_of_codes(kind: str, tmp_path: Path) -> None:
    """With as many candidates as rows that is the exact answer; with few it is exact among what the codes found."""
    database, queries = descriptors(400, 30), descriptors(20, 30, seed=1)  # 30: not a multiple of 8 bits
    exact = search(queries, slices(database), 6)
    shuffled = [(rows[::-1].copy(), block[::-1].copy()) for rows, block in slices(database, 64)]
    codes, both = (build_index(lambda: shuffled, kind, refine) for refine in (False, True))
    if kind != "ivfpq":  # which looks into a part of its lists
        distances, rows = search_index(both, queries, 6, refine=1_000)
        assert (rows == exact[1]).all()
        np.testing.assert_allclose(distances, exact[0], atol=2e-6)
    near = search_index(codes, queries, 12)[1]
    save_index(both, tmp_path / "index.faiss")
    for index in (both, load_index(tmp_path / "index.faiss")):
        distances, rows = search_index(index, queries, 6, refine=12)
        for q, candidates in enumerate(near):
            far = ((queries[q] - database[candidates[candidates >= 0]]) ** 2).sum(1)
            assert (rows[q] == candidates[np.argsort(far, kind="stable")][:6]).all()
    assert agreement(rows, exact[1]) > agreement(near[:, :6], exact[1]) or kind == "int8"
    codes_alone, with_floats = bytes_each(codes), bytes_each(both)
    assert codes_alone == (with_floats[0], 0) and with_floats[1] == 120
    if kind != "ivfpq":
        least = {"int8": 30, "binary": 4}[kind]
        assert least <= codes_alone[0] < least + 4  # and the ranges or means of 30 dimensions


def test_codes_are_what_they_say() -> None:
    """Distances of binary codes count differing sides of the means; those of int8 codes are within half a step."""
    database, queries = descriptors(200, 24), descriptors(9, 24, seed=1)
    middle, low, step = database.mean(0), database.min(0), np.ptp(database, axis=0) / 255
    differing = ((queries > middle)[:, None] != (database > middle)[None]).sum(-1)
    distances, rows = search_index(build_index(lambda: slices(database, 50), "binary"), queries, 200)
    assert (distances == np.take_along_axis(differing, rows, 1)).all()
    assert (np.sort(rows, 1) == np.arange(200)).all()
    coded = low + (np.clip(np.floor((database - low) / step), 0, 254.999) + 0.5) * step  # the middle of each step
    distances, rows = search_index(build_index(lambda: slices(database, 50), "int8"), queries, 200)
    truth = ((queries[:, None] - coded[None]) ** 2).sum(-1)
    np.testing.assert_allclose(distances, np.take_along_axis(truth, rows, 1), atol=0.01)


def test_agreement_counts_found_neighbours() -> None:
    assert agreement(np.array([[1, 2, 3, -1]]), np.array([[3, 2, 8, 9]])) == 50.0


def test_real_photos_give_the_known_figures_of_raw_pixels(shared_dir: Path) -> None:
    """Grey 64x32 pixels, mean removed, unit length, +-2 frames: R@1 37.5 / 9 / 4 on Gardens Point's three pairs."""
    folder = shared_dir / "data" / "gardens_point"
    if not folder.is_dir():
        pytest.skip("the Gardens Point photos are not there")

    def pixels(traverse: str) -> np.ndarray:
        photos = [Image.open(p).convert("L") for p in sorted((folder / traverse).glob("*.jpg"))]
        x = np.stack([np.asarray(p.resize((64, 32), Image.Resampling.BILINEAR), np.float32).ravel() for p in photos])
        x -= x.mean(axis=1, keepdims=True)
        return x / np.linalg.norm(x, axis=1, keepdims=True)

    seen = {name: pixels(name) for name in ("day_left", "day_right", "night_right")}
    positives = [np.arange(max(0, i - 2), min(200, i + 3)) for i in range(200)]
    figures = []
    for query, database in (("day_right", "day_left"), ("day_right", "night_right"), ("day_left", "night_right")):
        predictions = search(seen[query], slices(seen[database]), 5)[1]
        figures.append(recall_at(predictions, positives, (1,))[1])
    assert figures == [37.5, 9.0, 4.0]
