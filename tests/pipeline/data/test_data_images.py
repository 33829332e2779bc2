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
        difference = np.abs(shrink(source, (size, size)) - expected)
        assert difference.max() <= 1 and difference.mean() < 0.02
        given = to_input(Image.fromarray(source), size)
        assert given.shape == (3, size, size) and given.dtype == torch.uint8 and given.is_contiguous()
        assert (given.permute(1, 2, 0).numpy() == shrink(source, (size, size))).all()


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


def header_bombs() -> dict[str, bytes]:
    """Files of a few kB whose header promises gigabytes."""
    import struct
    import zlib

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    small = Image.new("L", (64, 64), 128)
    bombs = {}
    for kind, progressive in (("plain", False), ("progressive", True)):
        data = bytearray(encoded(small, "JPEG", progressive=progressive))
        frame = data.index(b"\xff\xc2" if progressive else b"\xff\xc0")
        data[frame + 5 : frame + 9] = struct.pack(">HH", 60_000, 60_000)
        bombs[f"{kind}.jpg"] = bytes(data)
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0))
    body = chunk(b"IDAT", zlib.compress(bytes(1 << 20))) + chunk(b"IEND", b"")
    bombs["rows.png"] = b"\x89PNG\r\n\x1a\n" + header + body
    scans = bytearray(encoded(small, "JPEG", progressive=True))
    frame, scan = scans.index(b"\xff\xc2"), scans.rindex(b"\xff\xda")
    scans[frame + 5 : frame + 9] = struct.pack(">HH", 10_000, 10_000)
    bombs["scans.jpg"] = bytes(scans[:scan] + scans[scan:-2] * 300 + scans[-2:])
    return bombs


@pytest.mark.parametrize("name", ["plain.jpg", "progressive.jpg", "rows.png", "scans.jpg"])
def test_what_would_decode_to_gigabytes_is_refused_by_its_header(name: str, tmp_path: Path) -> None:
    """In preparing, training, evaluation; within the memory that the process has already."""
    import resource

    from shards.images import ImageRule, Refused, admit

    data = header_bombs()[name]
    assert len(data) < 40_000
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    (tmp_path / name).write_bytes(data)
    with pytest.raises(DataError, match=rf"{name}: too large: [0-9,x ]+ pixels"):
        load_image(tmp_path / name)
    with pytest.raises(DataError, match="too large"):
        decode(data)
    for rule in (ImageRule(convert=True), ImageRule(check="header", convert=True), ImageRule("none", 300, True)):
        refused = admit(data, rule)
        assert isinstance(refused, Refused) and "too large" in refused.reason
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


def ramp(kind: str) -> tuple[Image.Image, np.ndarray]:
    """A picture of a mode Pillow knows, 64 x 16, its values over the whole range; and what it shows, uint8 grey."""
    shown = np.tile(np.arange(0, 256, 4, dtype=np.uint8), (16, 1))
    grey = Image.fromarray(shown)
    if kind == "I;16":
        return Image.fromarray(shown.astype(np.uint16) * 257), shown
    if kind == "1":
        return grey.convert("1", dither=Image.Dither.NONE), np.where(shown > 127, 255, 0)
    if kind in ("LA", "RGBA"):
        image = grey.convert(kind)
        image.putalpha(Image.new("L", image.size, 90))
        return image, shown
    return grey.convert(kind), shown


@pytest.mark.parametrize(
    ("mode", "kind"),
    [("I;16", "PNG"), ("I;16", "TIFF"), ("1", "PNG"), ("1", "TIFF"), ("LA", "PNG"), ("RGBA", "PNG"), ("P", "PNG"),
     ("CMYK", "TIFF"), ("YCbCr", "TIFF"), ("P", "GIF"), ("RGBA", "WEBP")],
)  # fmt: skip
def test_no_kind_of_pixels_is_clipped(mode: str, kind: str, tmp_path: Path) -> None:
    """A 16-bit grey PNG read with Pillow's own convert("RGB") comes out white."""
    from shards.images import ImageRule, admit

    image, expected = ramp(mode)
    options = {"WEBP": {"lossless": True}, "PNG": {"transparency": 3} if mode == "P" else {}}
    path = tmp_path / "photo.png"
    image.save(path, kind, **options.get(kind, {}))
    found = np.asarray(load_image(path)).astype(int)
    assert np.abs(found - expected[..., None]).max() <= 2
    if kind == "PNG":
        stored = admit(path.read_bytes(), ImageRule(convert=True))
        assert isinstance(stored, bytes)
        assert np.abs(decode(stored).astype(int) - expected[..., None]).mean() < 3


@pytest.mark.parametrize("mode", ["F", "I"])
def test_pixels_of_no_known_range_are_refused(mode: str, tmp_path: Path) -> None:
    Image.fromarray(np.full((8, 8), 70_000, np.float32 if mode == "F" else np.int32)).save(tmp_path / "x.tif")
    with pytest.raises(DataError, match=rf"x\.tif: has {mode} pixels .* convert it to 8 bits"):
        load_image(tmp_path / "x.tif")


def test_a_pipe_and_a_program_under_a_photos_name_are_refused(tmp_path: Path) -> None:
    import os

    os.mkfifo(tmp_path / "pipe.jpg")
    with pytest.raises(DataError, match="not an ordinary file"):
        load_image(tmp_path / "pipe.jpg")
    (tmp_path / "page.jpg").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\nshowpage\n")
    with pytest.raises(DataError, match="does not decode"):  # Pillow would start Ghostscript
        load_image(tmp_path / "page.jpg")


@pytest.mark.parametrize("kind", ["GIF", "PNG", "WEBP", "TIFF"])
def test_of_many_frames_the_first_is_the_photo(kind: str) -> None:
    frames = [Image.new("RGB", (32, 24), (n * 10, 0, 0)) for n in range(20)]
    data = encoded(frames[5], kind, save_all=True, append_images=frames)
    assert np.abs(decode(data).astype(int) - (50, 0, 0)).max() <= 3
