"""Rank 0 of a launched job searches on all cores, whatever OMP_NUM_THREADS the launcher set."""

from __future__ import annotations

import subprocess
import sys

import pytest

ASKED = """
import os
import {first}
import faiss, torch
from pipeline.evaluation.search.cores import all_cores
os.sched_getaffinity = lambda _: set(range(3))
before = (torch.get_num_threads(), faiss.omp_get_max_threads())
with all_cores(faiss=True):
    inside = (torch.get_num_threads(), faiss.omp_get_max_threads())
print(before, inside, (torch.get_num_threads(), faiss.omp_get_max_threads()))
"""


@pytest.mark.parametrize("first", ["torch", "faiss"])  # whether both share one OpenMP depends on it
@pytest.mark.parametrize(("local", "wanted"), [("2", "(1, 1) (3, 3) (1, 1)"), ("1", "(1, 1) (1, 1) (1, 1)")])
def test_launched_ranks_search_on_every_core(
    first: str, local: str, wanted: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("LOCAL_WORLD_SIZE", local)
    done = subprocess.run([sys.executable, "-c", ASKED.format(first=first)], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == wanted
