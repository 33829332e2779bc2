"""t-SNE against its definition: perplexity, gradient by differences, and scikit-learn's divergence."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.common.errors import UsageError
from pipeline.paper.tsne import affinities, gradient, squared_distances, tsne


@pytest.fixture
def clusters() -> np.ndarray:
    rng = np.random.Generator(np.random.PCG64(0))
    centres = 3 * rng.normal(size=(6, 20))
    return np.concatenate([centre + rng.normal(size=(15, 20)) for centre in centres])


def test_the_gradient_is_that_of_the_divergence(clusters: np.ndarray) -> None:
    joint = affinities(squared_distances(clusters), 10)
    assert joint.sum() == pytest.approx(1) and np.allclose(joint, joint.T) and not joint.diagonal().any()
    y = np.random.Generator(np.random.PCG64(1)).normal(size=(len(clusters), 2))
    slope, _ = gradient(joint, y)
    for point, axis in ((0, 0), (17, 1), (80, 0)):
        step = np.zeros_like(y)
        step[point, axis] = 1e-5
        numeric = (gradient(joint, y + step)[1] - gradient(joint, y - step)[1]) / 2e-5
        assert slope[point, axis] == pytest.approx(numeric, rel=1e-4, abs=1e-9)


def test_the_map_is_as_good_as_scikit_learns_and_always_the_same(clusters: np.ndarray) -> None:
    from sklearn.manifold import TSNE

    found, divergence = tsne(clusters, perplexity=12)
    theirs = TSNE(perplexity=12, method="exact", init="pca", random_state=0).fit(clusters)
    assert divergence < 1.1 * theirs.kl_divergence_ + 0.02
    # both measured by us: their map has the divergence they report, so it is the same quantity
    own = gradient(affinities(squared_distances(clusters), 12), theirs.embedding_.astype(float))[1]
    assert own == pytest.approx(theirs.kl_divergence_, rel=0.02)
    assert np.array_equal(tsne(clusters, 12, steps=30)[0], tsne(clusters, 12, steps=30)[0])
    labels = np.repeat(np.arange(6), 15)
    distances = squared_distances(found)
    np.fill_diagonal(distances, np.inf)
    assert (labels[distances.argmin(1)] == labels).mean() > 0.98


def test_too_few_points_for_the_perplexity(clusters: np.ndarray) -> None:
    with pytest.raises(UsageError, match="perplexity 40 wants at least 120 photos, there are 90"):
        tsne(clusters, perplexity=40)
