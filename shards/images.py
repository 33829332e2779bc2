"""One photo's bytes: is it a whole JPEG, and, only where asked, another JPEG made of it.

Invariant: bytes that `admit` returns with the check "decode" were decoded to their last coefficient without a
warning by the decoder that training uses; unless resizing or conversion was asked for they are the source's own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import simplejpeg

from pipeline.common import pictures
from pipeline.common.errors import DataError
from pipeline.common.text import shown

Check = Literal["decode", "header", "none"]
_KINDS = {
    b"\x89PNG": "PNG", b"GIF8": "GIF", b"RIFF": "WebP", b"II*\0": "TIFF", b"MM\0*": "TIFF", b"BM": "BMP",
    b"PK\3\4": "zip archive", b"\x1f\x8b": "gzip", b"<": "HTML or XML", b"{": "JSON", b"\0\0\0": "zeros or HEIC",
}  # fmt: skip
QUALITY = 95


@dataclass(frozen=True)
class ImageRule:
    """What is done to each photo: how it is checked, and whether another JPEG is made of it."""

    check: Check = "decode"
    resize: int = 0  # shorter side in pixels that larger photos are reduced to; 0 copies the bytes
    convert: bool = False  # PNG becomes JPEG of quality 95 instead of being left out


@dataclass(frozen=True)
class Refused:
    """Why a photo is left out."""

    reason: str


def admit(data: bytes, rule: ImageRule) -> bytes | Refused:
    """The JPEG bytes to store for a photo's file bytes, or why it is left out."""
    if not data:
        return Refused("empty file (0 bytes)")
    if rule.convert and data.startswith(b"\x89PNG"):
        return _again(data, rule.resize)
    problem = check(data, rule.check)
    if problem is not None:
        return Refused(problem)
    return _again(data, rule.resize) if rule.resize else data


def check(data: bytes, how: Check = "decode") -> str | None:
    """What is wrong with the bytes of a JPEG file, or None.

    "decode" runs the whole entropy decoder, which any cut or hole in the file upsets, and saves only the inverse
    transform, which cannot fail, by asking for an eighth of the size in grey. "header" reads the header and looks for
    the end marker: it misses what is wrong in between. "none" believes.
    """
    if how == "none":
        return None
    if not data.startswith(b"\xff\xd8"):
        kind = next((kind for magic, kind in _KINDS.items() if data.startswith(magic)), "unknown data")
        return f"not a JPEG ({kind})"
    try:
        height, width = simplejpeg.decode_jpeg_header(data)[:2]
        pictures.check_size(width, height, data)
        if how == "header":
            return None if data.rstrip(b"\0").endswith(b"\xff\xd9") else "broken JPEG: no end marker"
        simplejpeg.decode_jpeg(data, "GRAY", min_height=1, min_width=1)
    except ValueError as error:
        return f"broken JPEG: {shown(error)}"
    except DataError as error:
        return str(error)
    return None


def _again(data: bytes, resize: int) -> bytes | Refused:
    """Encodes a photo again: upright, RGB, its shorter side at most `resize` (0: any), quality 95."""
    import numpy as np
    from PIL import Image

    try:
        opened = pictures.open_picture(data)
        shorter = min(opened.size)
        if resize and shorter <= resize and opened.format == "JPEG":
            return data
        factor = min(1.0, resize / shorter) if resize else 1.0
        target = tuple(max(1, round(side * factor)) for side in opened.size)
        if factor < 0.5:  # let the JPEG decoder halve first, never under twice the target
            opened.draft("RGB", (2 * target[0], 2 * target[1]))
        image = pictures.to_rgb(opened)
        if factor < 1:
            image = image.resize((target[0], target[1]), Image.Resampling.BICUBIC)
        turn = pictures.turns(opened)
    except DataError as error:
        return Refused(str(error) if str(error).startswith("too large") else f"cannot be decoded: {error}")
    upright = image if turn is None else image.transpose(turn)
    return bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(upright), quality=QUALITY, colorsubsampling="420"))
