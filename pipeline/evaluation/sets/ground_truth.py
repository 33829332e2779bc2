"""Which database images are correct for a query: within a radius in metres, within some frames, or named pairs.

Invariant: every rule returns Q sorted int64 arrays of database rows; distances are taken in float64 and the bound
is inclusive, so published counts come out exactly.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np

from pipeline.common.errors import DataError

QUERIES_AT_A_TIME = 4_096


def within_radius(
    database: np.ndarray, queries: np.ndarray, radius: float, parts: tuple[np.ndarray, np.ndarray] | None = None
) -> list[np.ndarray]:
    """Database rows at most `radius` metres from each query.

    `database` [N, 2] and `queries` [Q, 2] are positions in metres, float64; `parts`, where given, are two integer
    arrays [N] and [Q] (a city, say), and only rows of the query's own part count. Exact: scipy's k-d tree finds
    candidates within a slightly larger radius, and every candidate's distance is computed and compared here, so that
    the tree's own rounding decides nothing.
    """
    if parts is not None:
        return _by_part(database, queries, radius, *parts)
    from scipy.spatial import cKDTree

    database = np.asarray(database, np.float64).reshape(-1, 2)
    queries = np.asarray(queries, np.float64).reshape(-1, 2)
    if len(database) == 0 or len(queries) == 0:
        return [np.zeros(0, np.int64) for _ in queries]
    tree = cKDTree(database)
    found: list[np.ndarray] = []
    for first in range(0, len(queries), QUERIES_AT_A_TIME):
        block = queries[first : first + QUERIES_AT_A_TIME]
        for query, near in zip(block, tree.query_ball_point(block, radius * (1 + 1e-6) + 1e-6), strict=True):
            rows = np.sort(np.array(near, np.int64))
            found.append(rows[((database[rows] - query) ** 2).sum(axis=1) <= radius**2])
    return found


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
