"""What size photos are brought to before a model sees them: a square, height x width, or their own shape.

A setting is written `224` (a square), `480x640` (height x width, aspect not kept), `native` or `native800`: the photo's
own aspect, its longest side at most so many pixels. In a config it stays a plain value, a number for a square and a
text otherwise, in its one canonical form: `224x224` is 224, `native` is `native640`. Nothing here imports torch.
"""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass
from typing import Any

from pipeline.common.errors import UsageError

LARGEST = 8192  # pixels of a side
LONGEST = 640  # of `native`: the longest side of most evaluation sets' photos
FIXED = "a side in pixels (224), or height x width (480x640), each 1 to 8,192"
ANY = f"{FIXED}, or native, or native and its longest side (native800)"


@dataclass(frozen=True)
class ImageSize:
    """A size of input; what a photo of some shape becomes is `of_photo`."""

    height: int
    """Pixels; native: the longest side."""
    width: int
    native: bool = False
    """Each photo keeps its aspect, and is never enlarged but to `least`."""
    multiple: int = 1
    """native: both sides are rounded to multiples of so many pixels, the backbone's patch."""
    least: int = 1
    """native: pixels that each side has at least, for the model's regions."""

    @classmethod
    def of(cls, value: int | str | ImageSize) -> ImageSize:
        """The size that a setting means.

        Raises:
            UsageError: it means none.
        """
        if isinstance(value, ImageSize):
            return value
        try:
            return parsed(value)
        except ValueError:
            raise UsageError(f"image_size must be {ANY}; it is {value!r}") from None

    @property
    def setting(self) -> int | str:
        """The canonical value of a config."""
        if self.native:
            return f"native{self.height}"
        return self.height if self.height == self.width else f"{self.height}x{self.width}"

    @property
    def text(self) -> str:
        """For people, without the unit: "224", "480 x 640", "photos' own shape, at most 640"."""
        if self.native:
            return f"photos' own shape, at most {self.height}"
        return str(self.height) if self.height == self.width else f"{self.height} x {self.width}"

    @property
    def largest(self) -> tuple[int, int]:
        """Height and width of the largest input; of every input, where the size is fixed."""
        return self.of_photo(self.height, self.width)

    def of_photo(self, height: int, width: int) -> tuple[int, int]:
        """Height and width of the input that a photo becomes."""
        if not self.native:
            return self.height, self.width
        share = min(1.0, self.height / max(height, width))
        return self._side(height * share), self._side(width * share)

    def takes(self, height: int, width: int) -> bool:
        """Whether an input may have this shape."""
        return (height, width) == self.of_photo(height, width)

    def _side(self, pixels: float) -> int:
        least, most = -(-self.least // self.multiple), self.height // self.multiple
        return max(least, min(int(pixels / self.multiple + 0.5), most)) * self.multiple


def parsed(value: Any, fixed: bool = False) -> ImageSize:
    """The size that a plain value means; `fixed`: not `native`. Raises ValueError where it means none."""
    found = re.fullmatch(r"([1-9]\d{0,3})(?:x([1-9]\d{0,3}))?|native([1-9]\d{0,3})?", str(value))
    if found is None or type(value) not in (int, str) or (fixed and str(value).startswith("native")):
        raise ValueError
    height = int(found[1] or found[3] or LONGEST)
    width = int(found[2] or height)
    if max(height, width) > LARGEST:
        raise ValueError
    return ImageSize(height, width, native=found[1] is None)


def input_size(model: Any) -> ImageSize:
    """What a model takes: its `input_size`, or what its `image_size` says."""
    return ImageSize.of(getattr(model, "input_size", model.image_size))


def for_patch(size: ImageSize, patch: int, backbone: str) -> ImageSize:
    """The same size for a backbone that cuts images into patches.

    Raises:
        UsageError: its sides are no multiples of the patch, or smaller.
    """
    if size.native and size.height >= patch:
        return dataclasses.replace(size, multiple=patch, least=max(size.least, patch))
    if size.native or size.height % patch or size.width % patch:
        height, width = (max(1, int(side / patch + 0.5)) * patch for side in (size.height, size.width))
        raise UsageError(
            f"image_size {size.setting} is not a multiple of the patch {patch} of backbone {backbone}; the nearest is "
            f"{ImageSize(height, width).setting}"
        )
    return size
