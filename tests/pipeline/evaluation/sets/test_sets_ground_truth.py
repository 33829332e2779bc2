"""Ground truth rules against brute force, and against the published lists at full size."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.common.errors import DataError
from pipeline.evaluation.sets import ground_truth
from pipeline.evaluation.sets.ground_truth import paired, within_frames, within_radius
from pipeline.evaluation.sets.layouts import by_frame
from pipeline.evaluation.sets.npy_lists import read_indices, read_ragged, read_strings


def brute_force(database: np.ndarray, queries: np.ndarray, radius: float) -> list[list[int]]:
    return [
        [i for i, p in enumerate(database) if (p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 <= radius**2] for q in queries
    ]


# multiples of 5 m put many points at exactly 25 m (3-4-5 and along the axes), where an off-by-one cell would show
points = st.lists(st.tuples(st.integers(-30, 30), st.integers(-30, 30)), min_size=1, max_size=40)


@settings(max_examples=150, deadline=None)
@given(points, points, st.sampled_from([0.0, 5.0, 25.0, 40.0]), st.sampled_from([(0.0, 0.0), (583_405.0, 4_477_100.0)]))
def test_radius_is_exact_and_inclusive(
    database: list, queries: list, radius: float, origin: tuple[float, float]
) -> None:
    near, asked = (5.0 * np.array(p, np.float64) + origin for p in (database, queries))
    found = within_radius(near, asked, radius)
    assert [rows.tolist() for rows in found] == brute_force(near, asked, radius)


def test_blocks_of_any_size_give_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(1)
    database, queries = random.uniform(0, 500, (700, 2)), random.uniform(-100, 600, (150, 2))
    whole = within_radius(database, queries, 25.0)
    monkeypatch.setattr(ground_truth, "QUERIES_AT_A_TIME", 7)
    assert all(np.array_equal(a, b) for a, b in zip(whole, within_radius(database, queries, 25.0), strict=True))
    assert [rows.tolist() for rows in whole] == brute_force(database, queries, 25.0)


def test_parts_keep_to_themselves() -> None:
    here = np.zeros((3, 2))
    found = within_radius(here, here[:2], 25.0, (np.array([0, 1, 0]), np.array([0, 1])))
    assert [rows.tolist() for rows in found] == [[0, 2], [1]]


def test_far_queries_and_empty_sides_find_nothing() -> None:
    database = np.array([[0.0, 0.0], [10.0, 0.0]])
    assert [len(r) for r in within_radius(database, np.array([[1e9, -1e9], [0, 25.0], [-25.0, 0]]), 25.0)] == [0, 1, 1]
    assert within_radius(np.zeros((0, 2)), database, 25.0)[1].size == 0


def test_frames_need_not_be_in_order() -> None:
    assert [rows.tolist() for rows in within_frames(5, np.array([0, 2, 9]), 1)] == [[0, 1], [1, 2, 3], []]
    assert within_frames(np.array([30, 10, 20]), np.array([15]), 5)[0].tolist() == [1, 2]


def test_pairs_refuse_the_unpaired() -> None:
    assert [rows.tolist() for rows in paired(["a", "b"], ["b", "a"], "set")] == [[1], [0]]
    with pytest.raises(DataError, match="no partner of the same name, the first is 'b'"):
        paired(["a", "b"], ["a", "c"], "set")
    with pytest.raises(DataError, match="same name"):
        paired(["a", "a"], ["a", "a"], "set")


@pytest.mark.parametrize(("name", "database", "queries"), [("pitts30k_test", 10_000, 6_816), ("tokyo247", 75_984, 315)])
def test_published_positions_at_full_size(shared_dir: Path, name: str, database: int, queries: int) -> None:
    neighbors = pytest.importorskip("sklearn.neighbors")
    positions = np.load(shared_dir / "data" / "ground_truth" / "patch_netvlad" / f"{name}.npz")
    assert (len(positions["utmDb"]), len(positions["utmQ"])) == (database, queries)
    found = within_radius(positions["utmDb"], positions["utmQ"], float(positions["posDistThr"]))
    tree = neighbors.KDTree(positions["utmDb"])
    wanted = tree.query_radius(positions["utmQ"], float(positions["posDistThr"]))
    assert all(np.array_equal(np.sort(a), b) for a, b in zip(wanted, found, strict=True))
    assert sum(len(rows) == 0 for rows in found) == 0  # DATA.md: none of their queries is without a positive


def test_pittsburgh_lists_have_the_published_counts(shared_dir: Path) -> None:
    folder = shared_dir / "data" / "ground_truth" / "Pittsburgh"
    sizes = {split: [len(read_strings(folder / f"pitts30k_{split}_{side}Images.npy")) for side in ("db", "q")]
             for split in ("test", "val")}  # fmt: skip
    assert sizes == {"test": [10_000, 6_816], "val": [10_000, 7_608]}


def test_both_nordland_protocols_at_full_size(shared_dir: Path) -> None:
    folder = shared_dir / "data" / "ground_truth"
    frames = [Path(f"{i:07d}.jpg") for i in range(27_592)]
    dense = by_frame("nordland_2star", frames, frames, 10)
    given_frames = np.load(folder / "patch_netvlad" / "nordland.npz")
    assert len(dense.database) == len(given_frames["utmDb"]) and len(dense.queries) == len(given_frames["utmQ"])
    sparse = by_frame("nordland_star", frames, frames[::10], 1, stride=10)
    assert len(sparse.queries) == 2_760
    published = read_ragged(folder / "Nordland" / "Nordland_gt.npy")
    assert all(np.array_equal(np.sort(a), b) for a, b in zip(published, sparse.positives, strict=True))
    sizes = [len(read_strings(folder / "Nordland" / f"Nordland_{side}Images.npy")) for side in ("db", "q")]
    assert sizes == [len(sparse.database), len(sparse.queries)] == [27_592, 2_760]


def test_msls_lists_have_the_published_counts(shared_dir: Path) -> None:
    folder = shared_dir / "data" / "ground_truth"
    positives = read_ragged(folder / "msls_val" / "msls_val_pIdx.npy")
    kept = read_indices(folder / "msls_val" / "msls_val_qIdx.npy")
    names = read_strings(folder / "msls_val" / "msls_val_qImages.npy")
    assert (len(names), len(kept), len(positives)) == (747, 740, 740)
    assert all(len(rows) for rows in positives) and max(rows.max() for rows in positives) < 18_871
    listed = {side: sum(len(gzip.decompress((folder / "patch_netvlad" / f"mapillary{city}_imageNames_{side}.txt.gz")
              .read_bytes()).split()) for city in ("cph", "sf")) for side in ("index", "query")}  # fmt: skip
    assert listed == {"index": 18_871, "query": 740}
