"""RandAugment's operations against their definitions, and the keys of all randomness."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
from PIL import Image

from pipeline.common.errors import UsageError
from pipeline.data import augment
from pipeline.data.augment import NAMED, Draws, check, rand_augment, training_view
from pipeline.data.images import decode, shrink

Photo = Callable[..., bytes]
SIZE = 224
PUBLISHED = 9 / 30


def apply(name: str, pixels: np.ndarray, share: float = PUBLISHED) -> np.ndarray:
    return np.asarray(NAMED[name][0](Image.fromarray(pixels.astype(np.uint8)), share)).astype(int)


def ramp(axis: int) -> np.ndarray:
    """Grey level = coordinate along the axis (1: x, 0: y)."""
    line = np.arange(SIZE)
    plane = np.broadcast_to(line[:, None] if axis == 0 else line[None, :], (SIZE, SIZE))
    return np.repeat(plane[:, :, None], 3, axis=2)


def test_geometry_moves_by_the_published_amounts() -> None:
    y, x = np.mgrid[0:SIZE, 0:SIZE] + 0.5  # pixel centres
    inner = (slice(60, 160), slice(60, 160))
    for sign in (1, -1):
        s = sign * PUBLISHED
        sources = {  # from where, on each axis, an output pixel is taken
            "ShearX": (x + sign * 0.09 * y, y),
            "ShearY": (x, y + sign * 0.09 * x),
            "TranslateX": (x - sign * 30, y),
            "TranslateY": (x, y - sign * 30),
        }
        angle = np.deg2rad(sign * 9)  # counter-clockwise about the centre
        u, v = x - SIZE / 2, y - SIZE / 2
        turned_x = np.cos(angle) * u - np.sin(angle) * v + SIZE / 2
        sources["Rotate"] = (turned_x, np.sin(angle) * u + np.cos(angle) * v + SIZE / 2)
        for name, (from_x, from_y) in sources.items():
            for axis, source in ((1, from_x), (0, from_y)):
                moved = apply(name, ramp(axis), s)[..., 0]
                assert np.abs(moved[inner] - (source - 0.5)[inner]).max() <= 1.0, name
    assert (apply("TranslateX", np.full((SIZE, SIZE, 3), 200))[:, :30] == 0).all()  # black comes in


def test_whole_pixel_translation_is_what_bilinear_gives(make_photo: Photo) -> None:
    image = Image.fromarray(shrink(decode(make_photo(1)), (SIZE, SIZE)))
    slow = image.transform(image.size, Image.Transform.AFFINE, (1, 0, -30, 0, 1, 0), Image.Resampling.BILINEAR)
    assert (apply("TranslateX", np.asarray(image)) == np.asarray(slow)).all()


def test_colour_operations_follow_their_definitions(make_photo: Photo) -> None:
    pixels = shrink(decode(make_photo(2)), (SIZE, SIZE))
    full = pixels.astype(float)
    grey = np.asarray(Image.fromarray(pixels).convert("L")).astype(float)
    for factor, share in ((1.27, PUBLISHED), (0.73, -PUBLISHED)):
        for name, base in (("Brightness", 0.0), ("Color", grey[..., None]), ("Contrast", round(grey.mean()))):
            expected = np.clip(base + factor * (full - base), 0, 255)
            assert np.abs(apply(name, pixels, share) - expected).max() <= 1.01, name
    assert (apply("Posterize", pixels) == (pixels & 0b11111110)).all()
    assert (apply("Solarize", pixels) == np.where(pixels < 178.5, pixels, 255 - pixels)).all()
    for m in range(31):  # the table's rows at every magnitude
        level, bits = 255 - 8.5 * m, 8 - int(np.round(m / 7.5))
        assert (apply("Solarize", pixels, m / 30) == np.where(pixels < level, pixels, 255 - pixels)).all()
        assert (apply("Posterize", pixels, m / 30) == (pixels & (256 - 2 ** (8 - bits)))).all()
    flat = np.linspace(60, 180, SIZE * SIZE).reshape(SIZE, SIZE, 1).repeat(3, axis=2)
    assert apply("AutoContrast", flat).min() == 0 and apply("AutoContrast", flat).max() == 255
    assert np.abs(np.histogram(apply("Equalize", flat), bins=8, range=(0, 256))[0] / flat.size - 1 / 8).max() < 0.02
    assert apply("Sharpness", pixels, PUBLISHED).std() > full.std() > apply("Sharpness", pixels, -PUBLISHED).std()


def test_operations_and_signs_are_drawn_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: Counter[tuple[int, float]] = Counter()

    def spy(number: int) -> Callable[[Image.Image, float], Image.Image]:
        def operation(image: Image.Image, share: float) -> Image.Image:
            seen[number, share] += 1
            return image

        return operation

    signed = [s for _, s in augment.OPERATIONS]
    monkeypatch.setattr(augment, "OPERATIONS", tuple((spy(i), s) for i, s in enumerate(signed)))
    image = Image.new("RGB", (4, 4))
    for view in range(4000):
        rand_augment(image, 3, 9, Draws("view", 0, 0, "000001", view))
    assert sum(seen.values()) == 12000 and len(signed) == 14
    for number, both in enumerate(signed):
        shares = {share: count for (n, share), count in seen.items() if n == number}
        assert set(shares) == ({PUBLISHED, -PUBLISHED} if both else {PUBLISHED})
        for count in shares.values():  # five standard deviations
            expected = 12000 / 14 / len(shares)
            assert abs(count - expected) < 5 * expected**0.5


@pytest.mark.parametrize("kind", ["rand", "light", "off"])
def test_pixels_depend_on_the_key_alone(make_photo: Photo, kind: augment.Augment) -> None:
    pixels = decode(make_photo(7, 400, 300))

    def view(*key: object) -> np.ndarray:
        return training_view(pixels, (112, 112), kind, 3, 9, Draws(*key))

    first = view("view", 0, 0, "000001", 0)
    view("view", 5, 5, "000009", 1)  # what happened between changes nothing
    assert first.shape == (112, 112, 3) and first.dtype == np.uint8
    assert (view("view", 0, 0, "000001", 0) == first).all()
    others = [view("view", *key) for key in ((1, 0, "000001", 0), (0, 1, "000001", 0), (0, 0, "000001", 1))]
    if kind == "off":
        assert all((other == shrink(pixels, (112, 112))).all() for other in others)
    else:
        assert all((other != first).any() for other in others)


def test_draws_are_the_same_on_every_platform() -> None:
    draws = Draws("view", 0, 3, "000123", 2)
    assert [draws.bits(), draws.below(14), round(draws.uniform(0, 1), 9)] == [13632872862354884126, 0, 0.738268596]
    numbers = np.array([draws.uniform(-1, 1) for _ in range(20000)])
    assert abs(numbers.mean()) < 0.02 and abs(numbers.var() - 1 / 3) < 0.01 and -1 <= numbers.min() < numbers.max() < 1


def test_settings_out_of_range_are_refused() -> None:
    for ops, magnitude in ((-1, 9), (3, 31), (3, -1)):
        with pytest.raises(UsageError, match=r"rand_magnitude in 0\.\.30"):
            check(ops, magnitude)
