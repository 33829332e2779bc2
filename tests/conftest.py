"""Fixtures shared by all tests: the optional real material, and a quiet, reproducible process."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

# One thread a process, also in the processes that tests start: another number of threads may round otherwise, so exact
# comparisons would depend on the machine's cores. It counts until torch, NumPy and faiss are imported.
os.environ["OMP_NUM_THREADS"] = "1"

# Files of much work. They begin first where several processes share the files (`make test`), so that none ends long
# after the others.
LONGEST = ("test_docs", "test_training_runs", "test_training_faults", "test_job_experiment", "test_engines")

SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder of real photos and reference numbers beside the checkout; skips the test where it is absent."""
    if not SHARED.is_dir():
        pytest.skip("the folder of reference material (../shared) is not beside this checkout")
    return SHARED


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: LONGEST.index(item.path.stem) if item.path.stem in LONGEST else len(LONGEST))
