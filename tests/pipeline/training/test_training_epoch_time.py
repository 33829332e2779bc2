"""What bounds an epoch, from a step's parts."""

from __future__ import annotations

import dataclasses

import pytest

from pipeline.training.epoch_time import StepTime


def test_a_step_waits_for_the_slower_part() -> None:
    step = StepTime(compute=2.0, tried=16, images=64, read=3.0, workers=0)
    assert step.seconds == 5.0, "the process itself reads, then computes"
    with_workers = dataclasses.replace(step, workers=2)
    assert (with_workers.seconds, with_workers.bound) == (2.0, "computation")
    slow = dataclasses.replace(step, workers=1)
    assert slow.seconds == 3.0 and slow.bound.startswith("reading images")
    (_, a_step), (_, an_epoch) = slow.rows(100)
    assert a_step == "about 2 s of computation (measured on 16 of 64 images), 3 s to read its images by 1 worker"
    assert an_epoch.startswith("about 5 min, bound by reading images (raise data.workers); ")
    fetched = dataclasses.replace(with_workers, read=None, tried=64)
    assert fetched.seconds == 2.0 and fetched.rows(1)[0][1].endswith("(measured), fetching shards not measured")


@pytest.mark.parametrize("tried", [4, 64])
def test_the_line_tells_what_was_measured(tried: int) -> None:
    line = StepTime(1.0, tried, 64, 0.5, 4).rows(1)[0][1]
    assert ("measured on 4 of 64 images" in line) == (tried == 4)
