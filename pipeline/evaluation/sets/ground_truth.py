"""Which database images are correct for a query: within a radius in metres, within some frames, or named pairs.

Invariant: every rule returns Q sorted int64 arrays of database rows; distances are taken in float64 and the bound
is inclusive, so published counts come out exactly; memory is bounded by the pairs examined at a time.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np

from pipeline.common.errors import DataError

PAIRS_AT_A_TIME = 2_000_000


def within_radius(
    database: np.ndarray, queries: np.ndarray, radius: float, parts: tuple[np.ndarray, np.ndarray] | None = None
) -> list[np.ndarray]:
    """Database rows at most `radius` metres from each query.

    `database` [N, 2] and `queries` [Q, 2] are positions in metres, float64; `parts`, where given, are two integer
    arrays [N] and [Q] (a city, say), and only rows of the query's own part count. Exact: a grid with cells just
    wider than the radius picks candidates from 3 x 3 cells and every candidate's distance is computed.
    """
    if parts is not None:
        return _by_part(database, queries, radius, *parts)
    database = np.asarray(database, np.float64).reshape(-1, 2)
    queries = np.asarray(queries, np.float64).reshape(-1, 2)
    if len(database) == 0 or len(queries) == 0:
        return [np.zeros(0, np.int64) for _ in queries]
    origin = database.min(axis=0)
    extent = float((database.max(axis=0) - origin).max())
    # wider than the radius, lest rounding in the division puts two points at exactly that distance two cells apart;
    # and not so fine that the cell number overflows
    cell = max(radius * (1 + 1e-6), extent / 1e6, 1e-6)
    column, row = np.floor((database - origin) / cell).astype(np.int64).T
    span = int(row.max()) + 3  # an empty row on both sides keeps neighbours of different columns apart
    number = column * span + row + 1
    order = np.argsort(number, kind="stable")
    number = number[order]
    # queries far outside fall into the empty rim, where there is nothing to find
    spot = np.clip(np.floor((queries - origin) / cell), -2, [column.max() + 2, row.max() + 2]).astype(np.int64)
    # three cells of a column are neighbours in the sorted order, so a query has three ranges of candidates
    lowest = np.clip(spot[:, 1], 0, span - 1)
    highest = np.clip(spot[:, 1] + 2, 0, span - 1)
    columns = spot[:, :1] + np.arange(-1, 2)
    starts = np.searchsorted(number, columns * span + lowest[:, None], side="left")
    ends = np.searchsorted(number, columns * span + highest[:, None], side="right")
    counts = np.maximum(ends - starts, 0)
    edges = np.concatenate([[0], np.cumsum(counts.sum(axis=1))])
    found: list[np.ndarray] = []
    first = 0
    while first < len(queries):
        last = max(first + 1, int(np.searchsorted(edges, edges[first] + PAIRS_AT_A_TIME, side="right")) - 1)
        found += _near(database, queries[first:last], radius, order, starts[first:last], counts[first:last])
        first = last
    return found


def _near(
    database: np.ndarray,
    queries: np.ndarray,
    radius: float,
    order: np.ndarray,
    starts: np.ndarray,
    counts: np.ndarray,
) -> list[np.ndarray]:
    """Candidates [q, 3 ranges] of a block of queries, each distance computed and compared."""
    flat = counts.ravel()
    within = np.arange(flat.sum()) - np.repeat(np.cumsum(flat) - flat, flat)
    rows = order[np.repeat(starts.ravel(), flat) + within]
    query = np.repeat(np.repeat(np.arange(len(queries)), counts.shape[1]), flat)
    offset = database[rows] - queries[query]
    near = (offset**2).sum(axis=1) <= radius**2
    rows, query = rows[near], query[near]
    arranged = np.lexsort((rows, query))
    edges = np.cumsum(np.bincount(query, minlength=len(queries)))[:-1]
    return np.split(rows[arranged].astype(np.int64), edges)


def _by_part(
    database: np.ndarray, queries: np.ndarray, radius: float, of_database: np.ndarray, of_queries: np.ndarray
) -> list[np.ndarray]:
    positives = [np.zeros(0, np.int64) for _ in queries]
    for part in np.unique(of_queries):
        rows, asked = np.flatnonzero(of_database == part), np.flatnonzero(of_queries == part)
        for query, near in zip(asked, within_radius(database[rows], queries[asked], radius), strict=True):
            positives[query] = rows[near]
    return positives


def within_frames(database: int | np.ndarray, queries: np.ndarray, frames: int) -> list[np.ndarray]:
    """Database rows whose frame number is at most `frames` from the query's.

    `database` is the number of images when they are frames 0, 1, 2, ..., else their frame numbers [N]; `queries` [Q]
    are frame numbers in the database's counting.
    """
    numbers = np.arange(database) if isinstance(database, int) else np.asarray(database, np.int64)
    order = np.argsort(numbers, kind="stable")
    asked = np.asarray(queries, np.int64)
    starts = np.searchsorted(numbers[order], asked - frames, side="left")
    ends = np.searchsorted(numbers[order], asked + frames, side="right")
    return [np.sort(order[a:b]).astype(np.int64) for a, b in zip(starts, ends, strict=True)]


def paired(database: Sequence[Hashable], queries: Sequence[Hashable], what: str) -> list[np.ndarray]:
    """One to one by key; `what` names the set in messages.

    Raises `DataError` for a key that is missing on one side or occurs twice.
    """
    place = {key: row for row, key in enumerate(database)}
    if len(place) != len(database) or len(set(queries)) != len(queries):
        raise DataError(f"{what}: two images of one folder have the same name, so they cannot be paired one to one")
    unmatched = sorted({str(key) for key in set(place) ^ set(queries)})
    if unmatched:
        raise DataError(
            f"{what}: {len(unmatched)} images have no partner of the same name, the first is '{unmatched[0]}'; "
            "database and queries of this set go in pairs"
        )
    return [np.array([place[key]], np.int64) for key in queries]
