"""Decoding, resizing and normalising against Pillow and against their definitions in numpy."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pipeline.common.errors import DataError
from pipeline.data import images
from pipeline.data.images import MEAN, STD, decode, load_image, normalise, shrink, to_input

Photo = Callable[..., bytes]


def encoded(image: Image.Image, kind: str, **options: object) -> bytes:
    target = io.BytesIO()
    image.save(target, kind, **options)
    return target.getvalue()


@pytest.mark.parametrize(
    ("mode", "kind"),
    [("RGB", "JPEG"), ("L", "JPEG"), ("CMYK", "JPEG"), ("RGB", "PNG"), ("L", "PNG"), ("P", "PNG"), ("RGBA", "WEBP")],
)
def test_every_kind_of_image_becomes_rgb(make_photo: Photo, mode: str, kind: str) -> None:
    data = encoded(Image.open(io.BytesIO(make_photo(1))).convert(mode), kind)
    expected = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
    assert decode(data).shape == expected.shape == (72, 96, 3)
    assert np.abs(decode(data).astype(int) - expected).max() <= 2  # two JPEG decoders may round differently
    assert load_image(data).mode == "RGB"


def test_without_simplejpeg_the_pixels_are_the_same(make_photo: Photo, monkeypatch: pytest.MonkeyPatch) -> None:
    fast = decode(make_photo(2)).astype(int)
    monkeypatch.setattr(images, "simplejpeg", None)
    assert np.abs(fast - decode(make_photo(2))).max() <= 2


@pytest.mark.parametrize(("orientation", "quarter_turns"), [(1, 0), (3, 2), (6, 3), (8, 1)])
def test_exif_orientation_is_applied(make_photo: Photo, tmp_path: Path, orientation: int, quarter_turns: int) -> None:
    image = Image.open(io.BytesIO(make_photo(3)))
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / "turned.jpg"
    path.write_bytes(encoded(image, "JPEG", exif=exif.tobytes(), quality=95, subsampling=0))
    expected = np.rot90(np.asarray(image).astype(int), quarter_turns)
    assert np.asarray(load_image(path)).shape == expected.shape
    assert np.abs(np.asarray(load_image(path)) - expected).mean() < 3
    assert (decode(path.read_bytes()) == np.asarray(load_image(path))).all()


def test_broken_files_are_named(make_photo: Photo, tmp_path: Path) -> None:
    whole = make_photo(4)
    for name, data in {"cut.jpg": whole[: len(whole) // 2], "text.jpg": b"not an image", "empty.png": b""}.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(DataError, match=rf"{name}: does not decode") as caught:
            load_image(tmp_path / name)
        assert "\n" not in str(caught.value)
    with pytest.raises(DataError, match=r"absent.jpg: cannot be read \(No such file"):
        load_image(tmp_path / "absent.jpg")


@pytest.mark.parametrize(("width", "height", "size"), [(400, 300, 224), (96, 72, 224), (300, 500, 84), (224, 224, 224)])
def test_training_resize_is_pillows_to_one_grey_level(make_photo: Photo, width: int, height: int, size: int) -> None:
    pixels = decode(make_photo(5, width, height))
    noise = np.random.default_rng(0).integers(0, 256, pixels.shape, dtype=np.uint8)
    for source in (pixels, noise):
        expected = np.asarray(Image.fromarray(source).resize((size, size), Image.Resampling.BILINEAR)).astype(int)
        difference = np.abs(shrink(source, size) - expected)
        assert difference.max() <= 1 and difference.mean() < 0.02
        given = to_input(Image.fromarray(source), size)
        assert given.shape == (3, size, size) and given.dtype == torch.uint8 and given.is_contiguous()
        assert (given.permute(1, 2, 0).numpy() == shrink(source, size)).all()


def test_published_input_is_normalised_and_then_sampled_without_antialias(make_photo: Photo) -> None:
    image = load_image(make_photo(6, 130, 90))
    size = 56
    pixels = (np.asarray(image, np.float64) / 255 - MEAN) / STD

    def corners(length: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        centre = np.clip((np.arange(size) + 0.5) * length / size - 0.5, 0, None)
        low = np.floor(centre).astype(int)
        return low, np.minimum(low + 1, length - 1), centre - low

    top, bottom, down = corners(90)
    left, right, across = corners(130)
    down, across = down[:, None, None], across[None, :, None]
    upper = pixels[top][:, left] * (1 - across) + pixels[top][:, right] * across
    lower = pixels[bottom][:, left] * (1 - across) + pixels[bottom][:, right] * across
    expected = upper * (1 - down) + lower * down
    given = to_input(image, size, "published")
    assert given.shape == (3, size, size) and given.dtype == torch.float32
    np.testing.assert_allclose(given.permute(1, 2, 0).numpy(), expected, atol=2e-5)


def test_normalise_is_imagenets() -> None:
    levels = torch.arange(256, dtype=torch.uint8).repeat(2, 3, 1).reshape(2, 3, 16, 16)
    expected = (np.arange(256).reshape(16, 16) / 255 - np.array(MEAN)[:, None, None]) / np.array(STD)[:, None, None]
    for dtype, tolerance in ((torch.float32, 1e-6), (torch.float64, 1e-12), (torch.bfloat16, 2e-2)):
        found = normalise(levels, dtype)
        assert found.dtype == dtype and found.shape == levels.shape
        np.testing.assert_allclose(found[1].double().numpy(), expected, atol=tolerance)
