"""What the camera does to a picture: sharpness, exposure, colour, noise, JPEG.

Invariant: draws only from the photo's own random stream.
"""

from __future__ import annotations

import io
from functools import lru_cache

import numpy as np
from PIL import Image

from shards.sources.miniature.weather import Conditions


@lru_cache(maxsize=4)
def _noise(width: int, height: int) -> np.ndarray:
    """[2 * height, 2 * width, 3] unit normal noise, int8 in 1/32."""
    rng = np.random.default_rng(99)
    return (rng.normal(0, 1, (2 * height, 2 * width, 3)) * 32).clip(-127, 127).astype(np.int8)


@lru_cache(maxsize=4)
def _vignette(width: int, height: int) -> Image.Image:
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    fall = np.clip(1 - 0.11 * (x**2 + y**2) ** 1.3, 0, 1)
    return Image.fromarray((255 * (1 - fall)).astype(np.uint8))


def develop(canvas: Image.Image, size: tuple[int, int], sky: Conditions, rng: np.random.Generator) -> bytes:
    """The canvas as the JPEG bytes of a photo of this size (width, height)."""
    # the resampling filter is the lens: from crisp to soft, in one pass
    soft = float(rng.uniform(0.0, 1.0)) + (0.1 if sky.dark else 0.0)
    kind = Image.Resampling
    image = canvas.resize(size, kind.HAMMING if soft < 0.5 else kind.BILINEAR if soft < 0.85 else kind.BOX)
    if soft > 0.85:
        shrunk = max(1.55 - soft, 0.6)
        coarse = (int(size[0] * shrunk), int(size[1] * shrunk))
        image = image.resize(coarse, kind.BILINEAR).resize(size, kind.BICUBIC)
    exposure = float(rng.normal(1.10, 0.10)) * (1.15 if sky.hour == "night" else 1.0)
    gamma = float(rng.uniform(0.9, 1.12))
    balance = np.array([1.0 + rng.normal(0, 0.045), 1.0, 1.0 + rng.normal(0, 0.05)])
    levels = np.linspace(0, 1, 256) ** gamma * 255 * exposure
    levels = np.where(levels > 205, 205 + (levels - 205) * 0.55, levels)  # a soft shoulder, as cameras have
    image = image.point([int(v) for c in range(3) for v in np.clip(levels * balance[c], 0, 255)])
    image.paste((0, 0, 0), mask=_vignette(*size))
    strength = float(rng.uniform(1.0, 3.5)) * (2.2 if sky.hour == "night" else 1.0)
    grid = _noise(*size)
    y, x = int(rng.integers(size[1])), int(rng.integers(size[0]))
    grain = grid[y : y + size[1], x : x + size[0]]
    pixels = np.asarray(image).astype(np.int16) + ((grain * np.int16(round(strength * 8))) >> 8)
    image = Image.fromarray(np.clip(pixels, 0, 255).astype(np.uint8))
    store = io.BytesIO()
    image.save(store, "JPEG", quality=int(rng.integers(72, 93)))
    return store.getvalue()
