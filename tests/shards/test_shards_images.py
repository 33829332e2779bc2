"""The check of a JPEG finds what a half-finished download leaves, and resizing and conversion keep the picture."""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np
import pytest
import simplejpeg
from PIL import Image

from shards.images import ImageRule, Refused, admit, check

Photo = Callable[[int], bytes]


def encoded(image: Image.Image, **options: object) -> bytes:
    sink = io.BytesIO()
    image.save(sink, **options)
    return sink.getvalue()


@pytest.fixture(scope="module")
def scene() -> Image.Image:
    """A smooth picture, 200 x 120, dark at the left, so that orientation shows."""
    ramp = np.linspace(0, 255, 200, dtype=np.uint8)
    return Image.fromarray(np.stack([np.tile(ramp, (120, 1))] * 3, axis=-1))


def test_a_whole_jpeg_is_copied_byte_for_byte(photo: Photo) -> None:
    assert admit(photo(1), ImageRule()) == photo(1)


@pytest.mark.parametrize("kind", ["baseline", "progressive", "grey", "cmyk", "tiny", "trailing bytes"])
def test_unusual_but_whole_jpegs_pass(kind: str, scene: Image.Image) -> None:
    data = {
        "baseline": lambda: encoded(scene, format="JPEG"),
        "progressive": lambda: encoded(scene, format="JPEG", progressive=True),
        "grey": lambda: encoded(scene.convert("L"), format="JPEG"),
        "cmyk": lambda: encoded(scene.convert("CMYK"), format="JPEG"),
        "tiny": lambda: encoded(scene.resize((1, 1)), format="JPEG"),
        "trailing bytes": lambda: encoded(scene, format="JPEG") + b"trailing bytes of a phone",
    }[kind]()
    assert check(data) is None
    assert simplejpeg.decode_jpeg(data).ndim == 3  # training's decoder agrees


def test_every_cut_is_found(photo: Photo) -> None:
    """Truncation at each of a few hundred lengths, most of them in the middle of the entropy-coded data."""
    data = photo(2)
    missed = [cut for cut in range(0, len(data), 7) if check(data[:cut]) is None]
    assert not missed


def test_a_hole_of_zeros_is_found(photo: Photo) -> None:
    """What a preallocated, interrupted download leaves: the right size, zeros to the end."""
    data = photo(3)
    half = len(data) // 2
    assert "broken JPEG" in str(check(data[:half] + bytes(len(data) - half)))


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "empty file (0 bytes)"),
        (b"\x89PNG\r\n\x1a\n0000", "not a JPEG (PNG)"),
        (b"<!DOCTYPE html><p>404", "not a JPEG (HTML or XML)"),
        (bytes(500), "not a JPEG (zeros or HEIC)"),
        (b"photo", "not a JPEG (unknown data)"),
    ],
)
def test_what_is_not_a_jpeg_is_named(data: bytes, reason: str) -> None:
    assert admit(data, ImageRule()) == Refused(reason)


def test_the_header_check_sees_the_ends_only(photo: Photo) -> None:
    data = photo(4)
    assert check(data, "header") is None
    assert check(data[:-5], "header") == "broken JPEG: no end marker"
    hollow = data[: len(data) // 2] + data[-2:]
    assert check(hollow, "header") is None and check(hollow, "decode") is not None
    assert check(b"anything", "none") is None


def test_resizing_reduces_the_shorter_side_and_never_enlarges(scene: Image.Image) -> None:
    data = encoded(scene, format="JPEG")
    small = admit(data, ImageRule(resize=30))
    assert isinstance(small, bytes)
    pixels = simplejpeg.decode_jpeg(small)
    assert pixels.shape == (30, 50, 3)
    truth = np.asarray(scene.resize((50, 30), Image.Resampling.BOX), dtype=float)
    assert np.abs(pixels - truth).mean() < 3
    assert admit(data, ImageRule(resize=120)) == data


def test_png_is_converted_only_where_asked(scene: Image.Image) -> None:
    data = encoded(scene, format="PNG")
    assert admit(data, ImageRule()) == Refused("not a JPEG (PNG)")
    made = admit(data, ImageRule(convert=True))
    assert isinstance(made, bytes) and made.startswith(b"\xff\xd8")
    assert np.abs(simplejpeg.decode_jpeg(made) - np.asarray(scene, dtype=float)).mean() < 2
    assert isinstance(admit(data[:100], ImageRule(convert=True)), Refused)


def test_what_is_made_again_stands_upright(scene: Image.Image) -> None:
    """EXIF orientation 6: the camera was turned; the pixels must be turned since the tag is not kept."""
    exif = Image.Exif()
    exif[0x0112] = 6
    small = admit(encoded(scene, format="JPEG", exif=exif), ImageRule(resize=60))
    assert isinstance(small, bytes)
    pixels = simplejpeg.decode_jpeg(small)
    assert pixels.shape == (100, 60, 3)
    assert pixels[:10].mean() < 30 and pixels[-10:].mean() > 220  # the dark left edge is now at the top
