"""Patch-NetVLAD's and TransVPR's second stages, restated: what they describe and how they match.

Written from the public code that pipeline/evaluation/search/rerank names, in plain torch and NumPy; nothing of the
project is used.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

SIZES, WEIGHTS = (2, 5, 8), (0.45, 0.15, 0.4)


def patch_vlads(state: dict[str, Tensor], x: Tensor) -> list[Tensor]:
    """[b, D, h, w] of the encoder -> for each size [b, P, D'], by an integral image of all residuals."""
    x = F.normalize(x, dim=1)
    assigned = F.conv2d(x, state["pool.conv.weight"], state.get("pool.conv.bias")).softmax(1)
    centres = state["pool.centroids"]
    residuals = torch.stack(
        [assigned[:, k : k + 1] * (x - centres[k].view(1, -1, 1, 1)) for k in range(len(centres))], 1
    )  # [b, K, D, h, w]
    integral = F.pad(residuals.cumsum(-1).cumsum(-2), (1, 0, 1, 0))
    found = []
    for p in SIZES:
        sums = integral[..., p:, p:] - integral[..., :-p, p:] - integral[..., p:, :-p] + integral[..., :-p, :-p]
        flat = F.normalize(F.normalize(sums / p**2, dim=2).flatten(3).flatten(1, 2), dim=1)  # [b, K * D, P]
        if "WPCA.0.weight" in state:
            weight, bias = state["WPCA.0.weight"][:, :, 0, 0], state["WPCA.0.bias"]
            flat = F.normalize(torch.einsum("ok,bkp->bop", weight, flat) + bias[:, None], dim=1)
        found.append(flat.transpose(1, 2))
    return found


def mutual(a: Tensor, b: Tensor) -> list[tuple[int, int]]:
    """Pairs (row of a, row of b) that are each other's nearest, by rows of a."""
    distances = torch.cdist(a, b)
    return [(i, int(j)) for i, j in enumerate(distances.argmin(1)) if int(distances[:, j].argmin()) == i]


def ransac(left: list[tuple[int, int]], right: list[tuple[int, int]], pixels: float) -> int:
    if len(left) < 4:
        return 0
    _, mask = cv2.findHomography(np.array(left), np.array(right), cv2.FM_RANSAC, ransacReprojThreshold=pixels)
    return 0 if mask is None else int(mask.sum())


def patch_scores(query: list[Tensor], candidate: list[Tensor], side: int, rapid: bool) -> list[float]:
    """Scores of a pair on a square grid of `side` tokens of 16 pixels: smaller is better, as published."""
    scores = []
    for p, q, c in zip(SIZES, query, candidate, strict=True):
        width = side - p + 1
        pairs = mutual(c, q)
        places = [[(row % width, row // width) for row in rows] for rows in zip(*pairs, strict=True)] or [[], []]
        if not rapid:
            # the middle of a patch's receptive field: 196 wide, 90 of it before the token
            pixels = [[tuple(int(16 * at + 8 * (p - 1) + 7.5) for at in xy) for xy in side] for side in places]
            scores.append(-ransac(*pixels, pixels=24) / len(q))
        elif not pairs:
            scores.append(0.0)
        else:
            moved = np.array(places[0]) - np.array(places[1])
            rest = np.abs(moved - moved.mean(0))
            scores.append(-((width - 1 - rest) ** 2).sum() / len(q))
    return scores


def patch_order(scores: list[list[float]]) -> list[int]:
    """Positions of a query's candidates, best first."""
    whole = np.zeros(len(scores))
    for column, weight in zip(np.array(scores).T, WEIGHTS, strict=True):
        whole += weight * (column - column.mean()) / column.std()
    return list(np.argsort(whole, kind="stable"))


def key_mask(maps: Tensor) -> Tensor:
    """Attention maps [3, N] -> weights [N], from 0 to 1."""

    def scaled(x: Tensor) -> Tensor:
        low, high = x.min(-1, keepdim=True).values, x.max(-1, keepdim=True).values
        return (x - low) / (high - low)

    return scaled(scaled(maps).sum(0))


def key_score(query: Tensor, candidate: Tensor, masks: tuple[Tensor, Tensor], side: int) -> tuple[int, bool]:
    """Patches [N, D] and their weights -> matches in agreement, and whether the first patches of both are no key
    patches but a match, as zeros are."""
    similar = candidate @ query.T
    similar[:, masks[0] <= 0.02] = 0
    similar[masks[1] <= 0.02, :] = 0
    to_candidate, to_query = similar.argmax(0), similar.argmax(1)
    kept = [i for i in range(len(query)) if int(to_query[to_candidate[i]]) == i]
    places = np.linspace(8, 16 * side - 8, side, dtype=int)
    left, right = (
        [(places[int(i) % side], places[int(i) // side]) for i in rows] for rows in (kept, to_candidate[kept])
    )
    return ransac(left, right, 24), bool(masks[0][0] <= 0.02 and masks[1][0] <= 0.02)
