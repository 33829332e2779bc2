"""Memory against the batch: counted exactly, and not growing where it is said not to."""

from __future__ import annotations

import functools
import gc

import pytest
import torch

from pipeline.benchmark.memory import Bytes, Living, count, count_fake
from pipeline.benchmark.sizes import SIZES, Norm, batch, build

TINY = SIZES["tiny"]
TOKENS = 17 * 32 * 4  # bytes of one image's tokens: (1 + 4 x 4) tokens of width 32 in float32
REGIONS = 14 * 32 * 4
BLOCKS = 2


def test_living_counts_making_and_release() -> None:
    before = torch.zeros(1000)
    living = Living()
    living.ignore(before)
    with living:
        a = before + 1
        view = a[:10]
        assert living.now == living.peak == 4000
        b = a * 2
        del a
        assert living.now == 8000  # the view still holds it
        del view, b
        gc.collect()
        assert living.now == 0 and living.peak == 8000


def test_shapes_alone_count_as_the_real_step_does() -> None:
    assert count_fake(TINY, "batch", 8, 4) == real("batch", 8, 4)


@functools.cache
def real(norm: Norm, images: int, chunk: int | None) -> Bytes:
    """Counted on a step that computes."""
    return count(build(TINY, norm), batch(TINY, images)[0], chunk)


def test_what_is_kept_grows_by_the_regions_alone_without_batch_norm() -> None:
    """Per further image: what the encoder across images and the descriptors need, and nothing of the backbone."""
    small, large = (real("group", n, 4) for n in (8, 16))
    whole_small, whole_large = (real("group", n, None) for n in (8, 16))
    each, whole = (large.kept - small.kept) / 8, (whole_large.kept - whole_small.kept) / 8
    with_regions_only = 30 * REGIONS  # of one encoder layer: a few maps [b, R, D] and the wider feed-forward
    assert each < with_regions_only < whole / 2
    assert (large.peak - small.peak) / 8 < with_regions_only


def test_with_batch_norm_two_maps_a_block_are_kept() -> None:
    """And the final norm's input and output; the peak grows with it, far slower than without chunks."""
    regions = (real("group", 16, 4).kept - real("group", 8, 4).kept) / 8
    each = (real("batch", 16, 4).kept - real("batch", 8, 4).kept) / 8
    assert each - regions == pytest.approx((2 * BLOCKS + 2) * TOKENS, rel=0.02)
    assert real("batch", 16, 4).peak < real("batch", 16, None).peak / 2
