"""Exact nearest neighbours on the ranks' GPUs: every rank searches its part of each block, and the best are merged.

Invariant: the answer is that of `exact.search`, but for the rounding of distances. Float32 products find candidates;
their distances are then computed anew, differences in float64, rounded once. So neither the blocks nor the number of
ranks change a distance, and equal distances are ordered by the lower row, which is file order.

Cost a rank: receives the queries and 1/W of the database, computes Q * n / W products of D numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor

from pipeline.distributed import (
    agreed,
    broadcast_tensors,
    collective_device,
    gather,
    is_distributed,
    on_rank_0,
    rank,
    rank_slice,
    world_size,
)
from pipeline.evaluation.search.exact import Blocks, check_finite

MARGIN = 32  # candidates beside the k best, among which rounding may have put one of them
QUERIES = 4_096  # queries whose products with a block are held at once
PAIRS_BYTES = 2**28  # of the differences of candidates from their queries, held at once


class Nearest:
    """The k nearest rows to each query among the blocks seen so far, on the queries' device."""

    def __init__(self, queries: Tensor, k: int) -> None:
        """`queries`: [Q, D]."""
        self.queries, self.k = queries.float(), k
        self.distances = torch.full((len(queries), k), torch.inf, device=queries.device)
        """Squared L2, float32 [Q, k], best first; infinite where there are fewer rows."""
        self.rows = torch.full((len(queries), k), -1, device=queries.device)
        """int64 [Q, k]; -1 where there are fewer."""

    @torch.no_grad()
    def add(self, numbers: Tensor, block: Tensor) -> None:
        """Rows `numbers` [n] of the database with their descriptors [n, D], of any type, on any device."""
        if not len(numbers):
            return
        numbers, order = numbers.to(self.queries.device).sort()
        block = block.to(self.queries.device)[order].float()
        for first in range(0, len(self.queries), QUERIES):
            part = slice(first, first + QUERIES)
            distances, at = _nearest(self.queries[part], block, self.k)
            rows = torch.where(at < 0, -1, numbers[at])
            self.distances[part], self.rows[part] = _best(
                torch.cat([self.distances[part], distances], 1), torch.cat([self.rows[part], rows], 1), self.k
            )


def search_on_devices(
    queries: np.ndarray | None, database: Blocks | None, k: int, device: torch.device
) -> tuple[np.ndarray, np.ndarray]:
    """`exact.search` by all ranks, each on its `device`. Collective.

    Args:
        queries: [Q, D] on rank 0; what the others pass is ignored.
        database: on rank 0, as `queries`.
        k: neighbours a query, the same on all ranks.

    Returns:
        (squared distances float32 [Q, k], rows int64 [Q, k]) on all ranks.

    Raises:
        DataError: descriptors that are not finite; on all ranks.
    """
    asked: dict[str, Tensor] = {}
    coming: Iterator[tuple[np.ndarray, np.ndarray]] = iter(())

    def begin() -> None:
        nonlocal coming
        assert queries is not None and database is not None  # descriptors are on rank 0
        check_finite(queries, "query")
        asked["queries"] = torch.from_numpy(np.array(queries, np.float32))
        coming = iter(database())

    on_rank_0(begin)
    asked = broadcast_tensors(asked)
    nearest = agreed(lambda: Nearest(asked["queries"].to(device), k))
    while (part := _own_part(coming)) is not None:
        agreed(partial(nearest.add, *part))
    with torch.no_grad():
        # [W * Q, k] -> [Q, W * k]
        parts = [gather(found.to(collective_device())) for found in (nearest.distances, nearest.rows)]
        each = [found.view(world_size(), -1, k).transpose(0, 1).flatten(1) for found in parts]
        distances, rows = _best(each[0], each[1], k)
    return distances.cpu().numpy(), rows.cpu().numpy()


def _own_part(coming: Iterator[tuple[np.ndarray, np.ndarray]]) -> tuple[Tensor, Tensor] | None:
    """(row numbers, descriptors) of this rank's part of rank 0's next block; None after the last. Collective."""
    taken: list[Tensor] = []

    def take() -> tuple[int, int, torch.dtype] | None:
        found = next(coming, None)
        if found is None:
            return None
        check_finite(found[1], "database")
        # array copies a read-only memory map's block, which torch would warn about
        taken.extend(torch.from_numpy(np.array(part)) for part in found)
        return (*taken[1].shape, taken[1].dtype)

    about = on_rank_0(take)
    if about is None:
        return None
    if not is_distributed():
        return taken[0], taken[1]
    n, dim, kind = about
    device, longest = collective_device(), -(-n // world_size())
    # pieces of a scatter are of one length: where a rank owns one row fewer, its piece begins or ends with another's
    starts = [min(rank_slice(n, r).start, n - longest) for r in range(world_size())]

    def room() -> tuple[list[Tensor], list[list[Tensor] | None]]:
        received = [
            torch.empty(longest, dtype=torch.int64, device=device),
            torch.empty(longest, dim, dtype=kind, device=device),
        ]
        if rank() != 0:
            return received, [None, None]
        return received, [[whole.to(device)[at : at + longest].contiguous() for at in starts] for whole in taken]

    received, sent = agreed(room)
    for into, pieces in zip(received, sent, strict=True):
        dist.scatter(into, pieces, src=0)
    own, begin = rank_slice(n), starts[rank()]
    return received[0][own.start - begin : own.stop - begin], received[1][own.start - begin : own.stop - begin]


def _nearest(queries: Tensor, block: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """(Squared L2 float32 [q, k], positions in the block int64 [q, k], -1 beyond its end), ordered by both.

    A row's float32 product may be off by `slack`, so all rows are candidates that are no farther than the k-th nearest
    and twice that; they are nearly always fewer than k + `MARGIN`. Copies of one photo can be more: such queries are
    then searched one by one.
    """
    squares = block.square().sum(1)
    far = torch.addmm(squares[None], queries, block.T, alpha=-2)  # [q, n]: without the query's own square
    wanted = min(len(block), k + MARGIN)
    values, at = far.topk(wanted, largest=False)
    distances = torch.empty(at.shape, device=far.device)
    step = max(1, PAIRS_BYTES // (8 * wanted * block.shape[1]))
    for first in range(0, len(queries), step):
        distances[first : first + step] = _exactly(queries[first : first + step], block[at[first : first + step]])
    distances, at = _best(distances, at, min(k, wanted))
    if wanted < len(block):
        slack = 2.0**-23 * block.shape[1] ** 0.5 * (queries.square().sum(1) + squares.max())
        limit = values[:, k - 1] + 2 * slack
        for q in torch.nonzero(values[:, -1] <= limit)[:, 0].tolist():
            near = torch.nonzero(far[q] <= limit[q])[:, 0]
            whole = [_exactly(queries[q : q + 1], block[part][None])[0] for part in near.split(max(1, step * wanted))]
            distances[q], at[q] = (found[0] for found in _best(torch.cat(whole)[None], near[None], k))
    missing = k - at.shape[1]
    if missing > 0:
        distances = torch.nn.functional.pad(distances, (0, missing), value=torch.inf)
        at = torch.nn.functional.pad(at, (0, missing), value=-1)
    return distances, at


def _exactly(queries: Tensor, candidates: Tensor) -> Tensor:
    """Squared L2 of queries [q, D] and their candidates [q, c, D]: float32 [q, c], of float64 differences."""
    return (candidates.double() - queries[:, None].double()).square().sum(-1).float()


def _best(distances: Tensor, rows: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """The first k of each [Q, n] by (distance, row)."""
    rows, order = rows.sort(1)
    distances, place = distances.gather(1, order).sort(dim=1, stable=True)
    return distances[:, :k], rows.gather(1, place)[:, :k]
