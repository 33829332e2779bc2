"""PCA against numpy's SVD and scikit-learn, over blocks, in both of its forms."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pipeline.common.errors import DataError, UsageError
from pipeline.evaluation.search.exact import slices
from pipeline.evaluation.search.projection import Prefix, fit_rows, load_projection, projected, sample_rows


def data(n: int, dim: int) -> np.ndarray:
    rng = np.random.Generator(np.random.PCG64(n))
    mixed = rng.normal(size=(n, dim)) * np.geomspace(3, 0.05, dim) @ np.linalg.qr(rng.normal(size=(dim, dim)))[0]
    return (mixed + 0.7).astype(np.float32)


def test_a_prefix_has_unit_length_again() -> None:
    x = data(50, 12).astype(np.float16)
    ((rows, short),) = projected(lambda: slices(x), Prefix(5))()
    cut = x[:, :5].astype(np.float64)
    np.testing.assert_allclose(short, cut / np.linalg.norm(cut, axis=1, keepdims=True), atol=1e-6)
    assert short.dtype == np.float32 and (rows == np.arange(50)).all()
    with pytest.raises(UsageError, match="prefix 13: the descriptors have 12 dimensions"):
        Prefix(13)(x)


@pytest.mark.parametrize(("n", "dim"), [(500, 40), (40, 90)])  # covariance, and Gram matrix
@pytest.mark.parametrize("whiten", [False, True])
def test_equal_to_svd_and_scikit_learn(n: int, dim: int, whiten: bool) -> None:
    from sklearn.decomposition import PCA

    x = data(n, dim)
    projection = fit_rows(lambda: slices(x, 64), np.arange(n), 8, whiten)
    _, values, components = np.linalg.svd(x.astype(np.float64) - x.mean(0, dtype=np.float64), full_matrices=False)
    signs = np.sign(components[np.arange(8), np.abs(components[:8]).argmax(1)])
    np.testing.assert_allclose(projection.components.numpy(), components[:8] * signs[:, None], atol=2e-5)
    np.testing.assert_allclose(projection.variances.numpy(), values[:8] ** 2 / (n - 1), rtol=1e-5)
    assert projection.explained == pytest.approx((values[:8] ** 2).sum() / (values**2).sum(), rel=1e-5)
    theirs = PCA(8, whiten=whiten, svd_solver="full").fit(x.astype(np.float64))
    flip = np.sign((theirs.components_ * projection.components.numpy()).sum(1))
    np.testing.assert_allclose(projection(x), theirs.transform(x.astype(np.float64)) * flip, atol=5e-4)


def test_only_the_given_rows_are_fitted_and_blocks_do_not_matter() -> None:
    x = data(300, 20)
    rows = sample_rows(300, 100, seed=4)
    assert len(rows) == 100 and (np.diff(rows) > 0).all()
    whole = fit_rows(lambda: slices(x[rows].copy()), np.arange(100), 5)
    blocks = [(r[::-1].copy(), b[::-1].copy()) for r, b in slices(x, 37)]  # shuffled stores come so
    np.testing.assert_allclose(
        fit_rows(lambda: blocks, rows, 5).components.numpy(), whole.components.numpy(), atol=1e-6
    )
    assert sample_rows(50, 100).tolist() == list(range(50))


def test_streaming_holds_no_more_than_blocks_and_the_covariance() -> None:
    x = data(64, 100)

    def blocks() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for first in range(0, 64_000, 64):  # 64,000 rows of 100 floats are 25.6 MB
            yield np.arange(first, first + 64), x + np.float32(first % 7)

    tracemalloc.start()
    projection = fit_rows(blocks, np.arange(64_000), 10)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert projection.rows == 64_000 and peak < 5e6


def test_saved_and_loaded(tmp_path: Path) -> None:
    x = data(60, 12)
    projection = fit_rows(lambda: slices(x), np.arange(60), 4, True, "pitts30k database, 60 of 60 images, single")
    projection.save(tmp_path / "pca.safetensors")
    again = load_projection(tmp_path / "pca.safetensors")
    assert (again(x) == projection(x)).all() and again.source == projection.source and again.whiten
    rows, low = next(iter(projected(lambda: slices(x), again)()))
    assert low.shape == (60, 4) and rows.tolist() == list(range(60))
    np.testing.assert_allclose(np.cov(low.T), np.eye(4), atol=1e-4)  # whitened
    (tmp_path / "no.safetensors").write_bytes(b"no")
    with pytest.raises(DataError, match="not a saved PCA"):
        load_projection(tmp_path / "no.safetensors")


def test_too_many_dimensions_are_refused() -> None:
    x = data(30, 50)
    with pytest.raises(UsageError, match="has 30 images"):
        fit_rows(lambda: slices(x), np.arange(30), 31)
    with pytest.raises(UsageError, match="variance of zero"):
        fit_rows(lambda: slices(x), np.arange(30), 30, whiten=True)
