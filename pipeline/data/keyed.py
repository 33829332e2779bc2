"""Random keys that depend on what they are for and on nothing else.

Stability: the raw 64-bit outputs of Philox (a stream that numpy guarantees), keyed by SHA-256 of the purpose: the same
on every platform and numpy version.
"""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

Rows = NDArray[np.int64]


def random(n: int, *purpose: object) -> NDArray[np.uint64]:
    """n random 64-bit keys that depend on `purpose` alone."""
    digest = hashlib.sha256("|".join(map(str, purpose)).encode()).digest()
    return np.random.Philox(key=int.from_bytes(digest[:16], "little")).random_raw(n)
