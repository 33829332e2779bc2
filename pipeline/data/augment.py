"""Augmentation of training images, every random number keyed by (seed, epoch, sample, view).

Invariant: the pixels of a view depend on its key alone; which rank or worker makes it, and what was made before, never
enter. `rand` is RandAugment (Cubuk et al., 2020) in the form that the published training used: of the operations below
`ops` are drawn with repetition and applied to the image after its resize, all at the one magnitude m of 0 to 30.

| operation                              | value at m, image of side S | sign     | published (m = 9, S = 224) |
|----------------------------------------|-----------------------------|----------|----------------------------|
| Identity, AutoContrast, Equalize       |                             |          |                            |
| ShearX, ShearY                         | 0.3 m/30                    | either   | 0.09                       |
| TranslateX, TranslateY                 | int(150/331 S m/30) pixels  | either   | 30                         |
| Rotate                                 | 30 m/30 degrees             | either   | 9                          |
| Brightness, Color, Contrast, Sharpness | 1 + 0.9 m/30                | either   | 1.27 or 0.73               |
| Posterize                              | 8 - round(4 m/30) bits      |          | 7                          |
| Solarize                               | threshold 255 (1 - m/30)    |          | 178.5                      |

Geometry is bilinear and fills with black; shears are about the top left corner, rotation about the centre.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageEnhance, ImageOps

from pipeline.common.errors import UsageError
from pipeline.data.images import shrink

Augment = Literal["rand", "light", "off"]
MAGNITUDES = 30


class Draws:
    """Random numbers that are a function of their key: SHA-256 of (key, counter), the same on every platform."""

    def __init__(self, *key: object) -> None:
        self._key, self._count = "|".join(map(str, key)).encode(), 0

    def bits(self) -> int:
        """The next 64 random bits."""
        self._count += 1
        return int.from_bytes(hashlib.sha256(self._key + b"#%d" % self._count).digest()[:8], "little")

    def below(self, n: int) -> int:
        """An integer of 0 to n-1 (n is small: the bias is below n / 2^64)."""
        return self.bits() % n

    def uniform(self, low: float, high: float) -> float:
        """A number of [low, high)."""
        return low + (high - low) * (self.bits() >> 11) / (1 << 53)


def training_view(
    pixels: NDArray[np.uint8], shape: tuple[int, int], augment: Augment, ops: int, magnitude: int, draws: Draws
) -> NDArray[np.uint8]:
    """An RGB image, uint8 [H, W, 3] of any size -> an augmented one of `shape` = (H', W')."""
    if augment == "light":
        return _light(pixels, shape, draws)
    small = shrink(pixels, shape)
    return np.asarray(rand_augment(Image.fromarray(small), ops, magnitude, draws)) if augment == "rand" else small


def check(ops: int, magnitude: int) -> None:
    """Raises `UsageError` where RandAugment's settings are outside their range."""
    if ops < 0 or not 0 <= magnitude <= MAGNITUDES:
        raise UsageError(
            f"data.rand_ops must be at least 0 and data.rand_magnitude in 0..{MAGNITUDES}; they are {ops}, {magnitude}"
        )


def rand_augment(image: Image.Image, ops: int, magnitude: int, draws: Draws) -> Image.Image:
    """RandAugment on an RGB image, same size."""
    share = magnitude / MAGNITUDES
    for _ in range(ops):
        operation, signed = OPERATIONS[draws.below(len(OPERATIONS))]
        sign = -1.0 if signed and draws.below(2) else 1.0
        image = operation(image, sign * share)
    return image


def _light(pixels: NDArray[np.uint8], shape: tuple[int, int], draws: Draws) -> NDArray[np.uint8]:
    """A crop of 80 to 100 % of each side, then brightness and contrast within 20 %."""
    height, width = pixels.shape[:2]
    h, w = math.ceil(height * draws.uniform(0.8, 1.0)), math.ceil(width * draws.uniform(0.8, 1.0))
    top, left = draws.below(height - h + 1), draws.below(width - w + 1)
    image = Image.fromarray(shrink(pixels[top : top + h, left : left + w], shape))
    image = ImageEnhance.Brightness(image).enhance(draws.uniform(0.8, 1.2))
    return np.asarray(ImageEnhance.Contrast(image).enhance(draws.uniform(0.8, 1.2)))


def _affine(image: Image.Image, matrix: tuple[float, float, float, float, float, float]) -> Image.Image:
    """`matrix` takes output coordinates to input coordinates."""
    return image.transform(image.size, Image.Transform.AFFINE, matrix, Image.Resampling.BILINEAR)


def _shear_x(image: Image.Image, share: float) -> Image.Image:
    return _affine(image, (1, 0.3 * share, 0, 0, 1, 0))


def _shear_y(image: Image.Image, share: float) -> Image.Image:
    return _affine(image, (1, 0, 0, 0.3 * share, 1, 0))


def _translate_x(image: Image.Image, share: float) -> Image.Image:
    return _moved(image, int(150 / 331 * image.width * share), 0)


def _translate_y(image: Image.Image, share: float) -> Image.Image:
    return _moved(image, 0, int(150 / 331 * image.height * share))


def _moved(image: Image.Image, right: int, down: int) -> Image.Image:
    # whole pixels need no interpolation; a crop beyond the image's edge fills with black
    return image.crop((-right, -down, image.width - right, image.height - down))


def _rotate(image: Image.Image, share: float) -> Image.Image:
    return image.rotate(30 * share, Image.Resampling.BILINEAR)


def _posterize(image: Image.Image, share: float) -> Image.Image:
    return ImageOps.posterize(image, 8 - round(4 * share))


def _solarize(image: Image.Image, share: float) -> Image.Image:
    # a whole-number threshold decides the same: pixels are whole, and `pixel < 178.5` is `pixel < 179`
    return ImageOps.solarize(image, math.ceil(round(255 * (1 - share), 6)))


def _enhance(kind: Callable[[Image.Image], ImageEnhance._Enhance]) -> Callable[[Image.Image, float], Image.Image]:
    return lambda image, share: kind(image).enhance(1 + 0.9 * share)


# name -> (operation on an image and a signed share of the largest magnitude, whether the sign is drawn)
NAMED: dict[str, tuple[Callable[[Image.Image, float], Image.Image], bool]] = {
    "Identity": (lambda image, share: image, False),
    "ShearX": (_shear_x, True),
    "ShearY": (_shear_y, True),
    "TranslateX": (_translate_x, True),
    "TranslateY": (_translate_y, True),
    "Rotate": (_rotate, True),
    "Brightness": (_enhance(ImageEnhance.Brightness), True),
    "Color": (_enhance(ImageEnhance.Color), True),
    "Contrast": (_enhance(ImageEnhance.Contrast), True),
    "Sharpness": (_enhance(ImageEnhance.Sharpness), True),
    "Posterize": (_posterize, False),
    "Solarize": (_solarize, False),
    "AutoContrast": (lambda image, share: ImageOps.autocontrast(image), False),
    "Equalize": (lambda image, share: ImageOps.equalize(image), False),
}
OPERATIONS = tuple(NAMED.values())
