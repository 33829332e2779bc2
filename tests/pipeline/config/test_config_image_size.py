"""Sizes of input: how they are written, and what a photo becomes."""

from __future__ import annotations

import dataclasses

import pytest

from jobs.cli import parse
from jobs.evaluate import EvaluateJob
from pipeline.common.errors import UsageError
from pipeline.config import RunConfig, from_dict, to_dict
from pipeline.config.image_size import ImageSize, for_patch


@pytest.mark.parametrize(
    ("written", "setting", "largest"),
    [
        (224, 224, (224, 224)), ("224", 224, (224, 224)), ("224x224", 224, (224, 224)),
        ("480x640", "480x640", (480, 640)), ("native", "native640", (640, 640)), ("native800", "native800", (800, 800)),
    ],
)  # fmt: skip
def test_a_size_has_one_form(written: int | str, setting: int | str, largest: tuple[int, int]) -> None:
    size = ImageSize.of(written)
    assert (size.setting, size.largest) == (setting, largest)
    assert ImageSize.of(size.setting) == size


def test_a_photo_keeps_its_aspect_and_is_never_enlarged() -> None:
    native = for_patch(ImageSize.of("native"), 14, "dinov2_vitb14")
    native = dataclasses.replace(native, least=42)
    assert native.of_photo(480, 640) == (476, 630)  # the bound holds after rounding
    assert native.of_photo(3000, 4000) == (476, 630)
    assert native.of_photo(640, 480) == (630, 476)
    assert native.of_photo(300, 400) == (294, 406)
    assert native.of_photo(20, 4000) == (42, 630)  # as small as the regions of the model allow
    assert ImageSize.of("native").of_photo(481, 640) == (481, 640)  # a network without patches takes any size
    assert all(native.takes(*native.of_photo(h, w)) for h in range(1, 900, 37) for w in range(1, 900, 41))
    assert not native.takes(480, 630) and not native.takes(476, 644) and not native.takes(28, 630)
    assert ImageSize.of("480x640").of_photo(10, 20) == (480, 640)


@pytest.mark.parametrize(
    ("size", "nearest"), [(225, "224"), ("480x640", "476x644"), ("224x5", "224x14"), ("native13", "14")]
)
def test_a_size_that_is_no_multiple_of_the_patch_names_the_nearest(size: int | str, nearest: str) -> None:
    with pytest.raises(UsageError, match=rf"image_size {size} is not .* the nearest is {nearest}$"):
        for_patch(ImageSize.of(size), 14, "dinov2_vitb14")


def test_a_config_holds_the_one_form() -> None:
    """So that a square stays the number that older files and digests have."""
    plain = from_dict(RunConfig, {"data": {"image_size": 224}})
    assert from_dict(RunConfig, {"data": {"image_size": "224x224"}}) == plain
    assert to_dict(plain)["data"]["image_size"] == 224
    with pytest.raises(UsageError, match=r"data\.image_size must be a side .* height x width .* it is 'native'"):
        from_dict(RunConfig, {"data": {"image_size": "native"}})


def test_jobs_take_sizes_as_options_and_refuse_others_in_one_line() -> None:
    assert parse(EvaluateJob, "", ["--image_size", "480x640"]).image_size == "480x640"
    assert parse(EvaluateJob, "", ["--image_size", "native"]).image_size == "native640"
    assert parse(EvaluateJob, "", ["--image_size", "322"]).image_size == 322
    assert parse(EvaluateJob, "", []).image_size is None
    with pytest.raises(UsageError, match=r"image_size must be a side .* or native.* it is 'original'"):
        parse(EvaluateJob, "", ["--image_size", "original"])
