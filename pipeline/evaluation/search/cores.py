"""How many cores the search and the PCA on rank 0 compute on.

Launchers set OMP_NUM_THREADS to 1 for every rank they start, whatever the machine has. While rank 0 searches, the other
ranks wait for it, so it may take all cores.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch

from pipeline.common.cores import available_cores


@contextmanager
def all_cores(faiss: bool = False) -> Iterator[None]:
    """Within it torch (and `faiss`) compute on every core that this process may use, if a launcher started it as one of
    several; otherwise, the user's own OMP_NUM_THREADS counts."""
    if int(os.environ.get("LOCAL_WORLD_SIZE", "1")) == 1:
        yield
        return
    cores = available_cores()
    counts: list[tuple[Callable[[], int], Callable[[int], None]]] = [(torch.get_num_threads, torch.set_num_threads)]
    if faiss:
        import faiss as library

        counts.append((library.omp_get_max_threads, library.omp_set_num_threads))
    # torch and faiss share one OpenMP or bring one each, by the order of their imports. Shared, setting one changes the
    # other: so both are read before either is set, and set back in the opposite order.
    before = [read() for read, _ in counts]
    for _, write in counts:
        write(cores)
    try:
        yield
    finally:
        for (_, write), number in reversed(list(zip(counts, before, strict=True))):
            write(number)
