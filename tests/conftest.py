"""Fixtures shared by all tests: the optional real material, and a quiet, reproducible process."""

from __future__ import annotations

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder of real photos and reference numbers beside the checkout; skips the test where it is absent."""
    if not SHARED.is_dir():
        pytest.skip("the folder of reference material (../shared) is not beside this checkout")
    return SHARED
