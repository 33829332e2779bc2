"""JPEG bytes or any photo file -> RGB -> the model's input; shared by training and evaluation.

Invariant: one way from bytes to pixels. EXIF orientation is applied, grayscale becomes RGB, and what does not decode
completely raises `DataError`; nothing is ever replaced by a black image.

The published training resizes with Pillow's bilinear filter, which antialiases. torch's antialiased bilinear resize of
uint8 is the same filter in the same fixed-point arithmetic at a third of the time: over 150 photos at most 1 grey level
apart, 0.00015 on average. Training and evaluation (`antialias`) both use it. JPEG decoding is simplejpeg where it is
installed, and Pillow (`pipeline.common.pictures`, which also bounds the size) for everything else.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor
from torch.nn import functional as F

from pipeline.common import pictures
from pipeline.common.errors import DataError
from pipeline.common.pictures import check_size
from pipeline.common.text import shown
from pipeline.config.image_size import ImageSize

try:
    import simplejpeg
except ImportError:  # Pillow decodes the same images at about 0.6 times the speed
    simplejpeg = None

MEAN = (0.485, 0.456, 0.406)
STD = (0.229, 0.224, 0.225)
ADVICE = "; restore the file or leave it out"  # ends the line of a photo that cannot be read


def decode(data: bytes) -> NDArray[np.uint8]:
    """An encoded image -> RGB, uint8 [H, W, 3]. Raises `DataError` with the reason (the caller names the file)."""
    pixels = _fast_jpeg(data)
    return pixels if pixels is not None else np.asarray(pictures.decode(data))


def load_image(source: Path | str | bytes) -> Image.Image:
    """A photo as an RGB Pillow image, upright by its EXIF orientation. Raises `DataError` naming the file."""
    name = f"an image of {len(source)} bytes" if isinstance(source, bytes) else shown(source)
    try:
        data = source if isinstance(source, bytes) else pictures.read_file(Path(source))
        pixels = _fast_jpeg(data)
        return Image.fromarray(pixels) if pixels is not None else pictures.decode(data)
    except (OSError, ValueError) as error:  # ValueError: a name with a NUL
        told = error.strerror if isinstance(error, OSError) else error
        raise DataError(f"{name}: cannot be read ({told or error}){ADVICE}") from None
    except DataError as error:
        raise DataError(f"{name}: {error}{ADVICE}") from None


def to_input(
    image: Image.Image, size: int | str | ImageSize, resize: Literal["antialias", "published"] = "antialias"
) -> Tensor:
    """An RGB image as input of H x W, as `size` gives them (`ImageSize.of_photo`).

    `antialias`: as in training, uint8 [3, H, W], to be normalised on the device. `published`: the published evaluation
    order, normalised first and then resized bilinearly *without* antialias, float32 [3, H, W].
    """
    shape = ImageSize.of(size).of_photo(image.height, image.width)
    if resize == "antialias":
        return to_tensor(shrink(np.asarray(image), shape))
    pixels = normalise(to_tensor(np.asarray(image)))
    return F.interpolate(pixels[None], shape, mode="bilinear", align_corners=False, antialias=False)[0]


def shrink(pixels: NDArray[np.uint8], shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Resizes uint8 [H, W, 3] to `shape` = (H', W'); bilinear with antialias."""
    planes = torch.from_numpy(np.require(pixels, requirements=["C", "W"])).permute(2, 0, 1)[None]
    small = F.interpolate(planes, shape, mode="bilinear", align_corners=False, antialias=True)
    return np.ascontiguousarray(small[0].permute(1, 2, 0).numpy())


def to_tensor(pixels: NDArray[np.uint8]) -> Tensor:
    """uint8 [H, W, 3] as a tensor of its own, uint8 [3, H, W]."""
    return (
        torch.from_numpy(np.require(pixels, requirements=["C", "W"]))
        .permute(2, 0, 1)
        .clone(memory_format=torch.contiguous_format)
    )


def normalise(images: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
    """uint8 [..., 3, H, W] -> (x / 255 - mean) / std with ImageNet's figures, on the images' device."""
    work = torch.float64 if dtype == torch.float64 else torch.float32  # the arithmetic is never in half precision
    mean, std = _constants(work, images.device)
    return ((images.to(work) / 255 - mean) / std).to(dtype)


@cache
def _constants(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """MEAN and STD [3, 1, 1], copied to a device once: the copy would stop the host at every step."""
    with torch.inference_mode(False):  # a first call in inference would leave tensors that no other place may use
        mean, std = (torch.tensor(figures, dtype=dtype, device=device).view(3, 1, 1) for figures in (MEAN, STD))
    return mean, std


def _fast_jpeg(data: bytes) -> NDArray[np.uint8] | None:
    """simplejpeg's answer, or None where Pillow is the one to ask: no JPEG, CMYK, or an EXIF orientation."""
    if simplejpeg is None or not simplejpeg.is_jpeg(data) or data.find(b"Exif\0\0", 0, 65536) >= 0:
        return None
    try:
        height, width, colours, _ = simplejpeg.decode_jpeg_header(data)
        if colours not in ("YCbCr", "RGB", "Gray"):
            return None
        check_size(width, height, data)
        pixels: NDArray[np.uint8] = simplejpeg.decode_jpeg(data, colorspace="RGB")
        return pixels
    except ValueError as error:
        raise DataError(f"does not decode as JPEG ({shown(error)})") from None
