"""Hard batches: groups of places that look alike but are not the same (after CliqueMining, Izquierdo and Civera, 2024).

Invariant: cliques are a pure function of (descriptors, places, positions, settings, seed, turn). Descriptors are fp16
of unit length, so a product of two numbers is a multiple of 2^-48 and no sum of them exceeds 2: float64 holds every
similarity exactly, in whatever order a library sums it. Similarities are then rounded to 2^-10, the random part too,
and ties go to the smaller place number. (The random part has two logarithms: on a platform that rounds their last bit
in another way, a draw differs with a chance of about 1e-14.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.data.keyed import Rows, random

STEP = 1024  # similarities are counted in units of 1 / STEP
BLOCK = 2**24  # similarities computed at a time


@dataclass(frozen=True)
class CliqueRule:
    """How places are grouped (`data.clique`, `mine_neighbours`, `mine_radius`, `mine_temperature`)."""

    clique: int
    neighbours: int
    radius: float
    temperature: float


@dataclass(frozen=True)
class Mined:
    """What the descriptors of P places say about batches."""

    near: NDArray[np.int32]
    """[P, k] the most similar places of the same city, by falling similarity; -1 where the city has fewer."""
    similarity: NDArray[np.int16]
    """[P, k] their similarities in units of 2^-10."""
    points: NDArray[np.float64]
    """[P, 3] where places lie, in metres; NaN where unknown."""
    rule: CliqueRule


def mine(descriptors: NDArray[np.float16], cities: Rows, points: NDArray[np.float64], rule: CliqueRule) -> Mined:
    """Finds the nearest places of each place.

    Args:
        descriptors: [P, d] of unit length.
        cities: [P] a number for each place's city; neighbours are of one city.
        points: [P, 3].
    """
    near = np.full((len(cities), rule.neighbours), -1, np.int32)
    similarity = np.zeros(near.shape, np.int16)
    for city in np.unique(cities):
        places = np.flatnonzero(cities == city)
        n = len(places)
        k = min(rule.neighbours, n - 1)
        if k == 0:
            continue
        unit = torch.from_numpy(descriptors[places].astype(np.float64))
        later = torch.arange(n - 1, -1, -1, dtype=torch.float64)  # the smaller place number wins a tie
        for first in range(0, n, max(1, BLOCK // n)):
            rows = torch.arange(first, min(first + max(1, BLOCK // n), n))
            keys = (unit[rows] @ unit.T).mul_(STEP).round_().mul_(n).add_(later)  # whole numbers below 2^53
            keys[torch.arange(len(rows)), rows] = -torch.inf
            found = keys.topk(k, dim=1)
            near[places[rows], :k] = places[found.indices]
            similarity[places[rows], :k] = found.values.div(n).floor().numpy()
    return Mined(near, similarity, points, rule)


def cliques(mined: Mined, places: Rows, keys: NDArray[np.uint64], seed: int, turn: int) -> NDArray[np.int64]:
    """Cliques [n, clique] of place numbers, no place twice, in the order they were made.

    Places become seeds in the order of `keys`. A seed that is still free takes free neighbours, drawn without
    replacement by similarity / temperature (Gumbel top-k), except any that lies closer than `radius` to a member; where
    they are too few, it makes no clique and stays free. Positions that are unknown are near to nothing.

    Args:
        places: [n] place numbers that may be used.
        keys: [n] random keys of the seeds' order.
    """
    rule = mined.rule
    total = len(mined.near)
    ranked = _ranked(mined, seed, turn)
    free = np.zeros(total + 1, np.bool_)  # the last one is what -1 points at, and never free
    free[places] = True
    made: list[NDArray[np.int64]] = []
    for start in places[np.argsort(keys, kind="stable")].tolist():
        if not free[start]:
            continue
        candidates = ranked[start]
        candidates = candidates[free[candidates]]
        chosen = _apart(mined.points, start, candidates, rule)
        if len(chosen) == rule.clique:
            free[chosen] = False
            made.append(np.array(chosen, np.int64))
    return np.stack(made) if made else np.empty((0, rule.clique), np.int64)


def _ranked(mined: Mined, seed: int, turn: int) -> NDArray[np.int64]:
    """[P, k] neighbours of each place in the order they are drawn in this turn."""
    score = mined.similarity.astype(np.int64)
    if mined.rule.temperature > 0:
        raw = random(score.size, "gumbel", seed, turn) >> np.uint64(11)
        noise = -np.log(-np.log((raw.astype(np.float64) + 0.5) * 2.0**-53))
        score += np.rint(STEP * mined.rule.temperature * noise).astype(np.int64).reshape(score.shape)
    near = mined.near.astype(np.int64)
    # one whole number a neighbour: no two are equal, so the order is the same by any way of sorting
    order = np.argsort(near - score * (len(near) + 1), axis=1)
    return np.take_along_axis(near, order, axis=1)


def _apart(points: NDArray[np.float64], start: int, candidates: Rows, rule: CliqueRule) -> list[int]:
    """`start` and the first candidates that lie apart from it and each other, at most `clique` in all."""
    chosen = [start]
    if len(candidates) < rule.clique - 1:
        return chosen
    if rule.radius == 0:
        return [start, *candidates[: rule.clique - 1].tolist()]
    at = points[candidates]
    open_ = np.ones(len(candidates), np.bool_)
    while True:
        open_ &= ~(((at - points[chosen[-1]]) ** 2).sum(1) < rule.radius**2)
        if len(chosen) == rule.clique or not open_.any():
            return chosen
        first = int(open_.argmax())
        open_[first] = False
        chosen.append(int(candidates[first]))
