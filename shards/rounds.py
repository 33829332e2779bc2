"""Which four images of a place go into round r, and in which order places are written.

A place's images are permuted once, keyed by (seed, city, place, image), and round r takes the next four, cyclically:
the first ceil(n / 4) rounds show every one of n images. Invariant: every choice is a pure function of the seed and of
names, through a hash that is the same on every machine and Python: an image added or lost moves no other place.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

IMAGES_A_PLACE = 4


def rank(seed: int, *names: str) -> bytes:
    """A key that sorts `names` into a random but reproducible order; 8 bytes."""
    return hashlib.blake2b("\0".join((str(seed), *names)).encode(), digest_size=8).digest()


def permutation(seed: int, city: str, place_id: str, images: Sequence[str]) -> list[int]:
    """The order in which a place's n images are shown: a permutation of range(n), whatever the order they came in."""
    return sorted(range(len(images)), key=lambda i: (rank(seed, city, place_id, images[i]), images[i]))


def draw(n: int, round_: int) -> tuple[int, int, int, int]:
    """Positions in the permutation of the four images that round `round_` shows, all different.

    Raises:
        ValueError: n is under four, so that no round can show the place.
    """
    if n < IMAGES_A_PLACE:
        raise ValueError(f"a place needs {IMAGES_A_PLACE} images, not {n}")
    start = IMAGES_A_PLACE * round_
    return (start % n, (start + 1) % n, (start + 2) % n, (start + 3) % n)


def shown(n: int, rounds: int) -> int:
    """How many of a place's n images appear in `rounds` rounds: 0 under four images, else min(n, 4 rounds)."""
    return min(n, IMAGES_A_PLACE * rounds) if n >= IMAGES_A_PLACE else 0
