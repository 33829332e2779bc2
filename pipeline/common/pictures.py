"""A photo file of any origin -> bounded, upright RGB; the one way for preparing, training, evaluating and locating.

Invariant: nothing is decoded before its header says that it is small enough, and no pixel is clipped. What is too
large, or of a kind without a known range, is refused with its reason; the caller names the file.
"""

from __future__ import annotations

import io
import os
import re
import warnings
from pathlib import Path

import numpy as np
from PIL import Image

from pipeline.common.errors import DataError
from pipeline.common.files import open_ordinary
from pipeline.common.text import shown

MAX_PIXELS = 1 << 27  # 134 million, such as a panorama of 16,384 x 8,192: 400 MB as RGB
MAX_BYTES = 1 << 30  # of a photo's file
MAX_SCANNED = 1 << 31  # pixels times scans of a progressive JPEG, each of which goes over the whole image
FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "GIF")  # others, such as EPS, would start other programs
_SIXTEEN_BITS = ("I;16", "I;16L", "I;16B", "I;16N")
_ORIENTATION = 0x0112  # EXIF tag
_TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT, 3: Image.Transpose.ROTATE_180, 4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE, 6: Image.Transpose.ROTATE_270, 7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}  # fmt: skip


def read_file(path: Path) -> bytes:
    """The bytes of a photo's file.

    Raises:
        OSError: it cannot be read, or is no ordinary file.
        DataError: it is larger than `MAX_BYTES`.
    """
    with open_ordinary(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        if size > MAX_BYTES:
            raise DataError(f"too large: {size:,} bytes, the limit is {MAX_BYTES:,}")
        return stream.read()


def check_size(width: int, height: int, data: bytes = b"") -> None:
    """Refuses an image by its header's size in pixels; a JPEG's `data` also by its number of scans.

    Raises:
        DataError: it is too large.
    """
    if width * height > MAX_PIXELS:
        raise DataError(_too_large(f"{width:,} x {height:,} pixels"))
    scans = data.count(b"\xff\xda") if data.startswith(b"\xff\xd8") else 1
    if width * height * scans > MAX_SCANNED:
        raise DataError(_too_large(f"{width:,} x {height:,} pixels in {scans:,} scans"))


def open_picture(data: bytes) -> Image.Image:
    """Opens an image of one of `FORMATS` without decoding it. Of several frames the first is the image.

    Raises:
        DataError: no such image, or too large.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # damaged EXIF and large images: the one is no matter, the other our own
            image = Image.open(io.BytesIO(data), formats=FORMATS)
    except Image.DecompressionBombError as error:
        (pixels,) = re.findall(r"\d+(?= pixels\) exceeds)", str(error)) or ("0",)
        raise DataError(_too_large(f"{int(pixels):,} pixels")) from None
    except Exception as error:  # Pillow's readers stumble in many ways over damaged headers
        raise DataError(f"does not decode ({_reason(error)})") from None
    check_size(*image.size, data)
    return image


def to_rgb(image: Image.Image) -> Image.Image:
    """Any kind of pixels as 8-bit RGB, decoded completely. 16-bit grey keeps its upper 8 bits; transparency is dropped.

    Raises:
        DataError: it does not decode, or its pixels have no known range (32-bit numbers).
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            image.load()
            if image.mode in _SIXTEEN_BITS or (image.mode == "I" and image.format == "PNG"):
                small = Image.fromarray((np.asarray(image).astype(np.uint32) >> 8).astype(np.uint8))
                small.info = dict(image.info)  # EXIF lies there
                return small.convert("RGB")
            if image.mode in ("I", "F"):
                raise DataError(f"has {image.mode} pixels (32 bits) of no known range; convert it to 8 bits a channel")
            if image.mode in ("La", "RGBa"):  # premultiplied
                image = image.convert(image.mode[:-1] + "A")
            return image.convert("RGB")
    except (DataError, MemoryError):
        raise
    except Exception as error:
        raise DataError(f"does not decode ({_reason(error)})") from None


def turns(image: Image.Image) -> Image.Transpose | None:
    """The turn that puts an image upright by its EXIF orientation; None where it has none, or damaged EXIF."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return _TURNS.get(int(image.getexif().get(_ORIENTATION, 1)))
    except Exception:  # damaged EXIF is no reason to lose a photo: its pixels decide
        return None


def decode(data: bytes) -> Image.Image:
    """A photo's bytes as an upright RGB image. Raises `DataError` with the reason."""
    image = open_picture(data)
    rgb = to_rgb(image)
    turn = turns(image)  # after decoding: a PNG may have it at its end
    return rgb if turn is None else rgb.transpose(turn)


def _too_large(told: str) -> str:
    return f"too large: {told}, the limit is {MAX_PIXELS:,} pixels; reduce it"


def _reason(error: Exception) -> str:
    text = re.sub(r" *<_io\.[^>]*>", "", str(error))  # an address in memory says nothing, and differs on every rank
    return shown(text or type(error).__name__)
