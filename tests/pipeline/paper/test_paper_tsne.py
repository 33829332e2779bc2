"""The map of places: clusters stay together, and the same points always give the same map."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.common.errors import UsageError
from pipeline.paper.paper_figures import tsne


@pytest.fixture
def clusters() -> np.ndarray:
    rng = np.random.Generator(np.random.PCG64(0))
    centres = 3 * rng.normal(size=(6, 20))
    return np.concatenate([centre + rng.normal(size=(15, 20)) for centre in centres])


def test_clusters_stay_together_and_nothing_is_left_to_chance(clusters: np.ndarray) -> None:
    found = tsne(clusters, perplexity=12)
    distances = ((found[:, None] - found[None]) ** 2).sum(-1)
    np.fill_diagonal(distances, np.inf)
    labels = np.repeat(np.arange(6), 15)
    assert found.shape == (90, 2) and (labels[distances.argmin(1)] == labels).mean() > 0.98
    assert np.array_equal(found, tsne(clusters, perplexity=12))


def test_too_few_points_for_the_perplexity(clusters: np.ndarray) -> None:
    with pytest.raises(UsageError, match="perplexity 40 wants at least 120 photos, there are 90"):
        tsne(clusters, perplexity=40)
