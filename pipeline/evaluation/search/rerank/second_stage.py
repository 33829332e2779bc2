"""The second stage of two-stage retrieval: the first candidates of each query in another order.

Invariant: only the order of the first `rerank` candidates changes, never which they are; a pair's scores depend on the
two images and their row numbers alone, and ties keep the order of the global search. Features come from the model that
made the descriptors, one image at a time: no grouping and no number of processes enters.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from pipeline import distributed
from pipeline.common.errors import UsageError
from pipeline.common.progress import Progress
from pipeline.config.image_size import input_size
from pipeline.data.images import load_image, normalise, to_input
from pipeline.evaluation.search.rerank.reranker import Features, Reranker
from pipeline.evaluation.sets.evaluation_set import EvaluationSet

KEPT_BYTES = 2**32  # features kept: neighbours of one query are often candidates of the next


@dataclass
class Cost:
    """What a second stage took on this rank."""

    seconds: float = 0.0
    describing: float = 0.0
    """Seconds of these for reading photos and describing them."""
    photo_bytes: int = 0
    """Features of one photo, the largest."""


class Described:
    """Features of photos, the most recently used kept: the same for every grouping of a set."""

    def __init__(self, reranker: Reranker) -> None:
        self.reranker, self.cost = reranker, Cost()
        self._kept: OrderedDict[Path, Features] = OrderedDict()

    def of(self, path: Path) -> Features:
        """Of a photo.

        Raises:
            DataError: an image that cannot be read.
        """
        if path not in self._kept:
            begun, stage = time.perf_counter(), self.reranker
            image = to_input(load_image(path), input_size(stage.model), stage.config.resize).to(stage.device)
            self._kept[path] = stage.describe(normalise(image) if image.dtype == torch.uint8 else image)
            if stage.device.type == "cuda":
                torch.cuda.synchronize(stage.device)  # or its time would count as matching
            size = sum(part.numel() * part.element_size() for part in self._kept[path])
            self.cost.photo_bytes = max(self.cost.photo_bytes, size)
            while len(self._kept) * self.cost.photo_bytes > KEPT_BYTES and len(self._kept) > 1:
                self._kept.popitem(last=False)
            self.cost.describing += time.perf_counter() - begun
        self._kept.move_to_end(path)
        return self._kept[path]


def rerank(
    described: Described,
    evaluated: EvaluationSet,
    predictions: np.ndarray,
    distances: np.ndarray,
    progress: bool = False,
) -> tuple[np.ndarray, np.ndarray, str]:
    """The first `config.rerank` of each query's candidates in the order of their scores. Collective.

    Each rank takes consecutive queries, whose candidates overlap; every rank needs the whole model.

    Args:
        described: features by the second stage, whose configuration says how many candidates.
        predictions, distances: [Q, k] database rows (-1: none) and squared distances of the global search.

    Returns:
        Predictions and distances [Q, k] in the new order, and a line that tells time and memory.

    Raises:
        UsageError: fewer candidates than are to be re-ranked; DataError: an image that cannot be read, on all ranks.
    """
    stage = described.reranker
    first = stage.config.rerank
    if predictions.shape[1] < first:
        raise UsageError(f"rerank {first} needs as many candidates, the search gave {predictions.shape[1]}")
    own = distributed.rank_slice(len(predictions))
    scores = np.full((own.stop - own.start, first), -np.inf)
    label, show = f"re-ranking {evaluated.name}", progress and distributed.rank() == 0
    cost = described.cost = Cost(photo_bytes=described.cost.photo_bytes)

    def compare() -> None:
        begun = time.perf_counter()
        with Progress(label, len(scores), "queries of this rank", enabled=show) as bar:
            for i, q in enumerate(range(own.start, own.stop)):
                query = described.of(evaluated.queries[q])
                there = [(j, row) for j, row in enumerate(predictions[q, :first].tolist()) if row >= 0]
                pairs = [stage.compare(query, described.of(evaluated.database[row]), (q, row)) for _, row in there]
                if pairs:
                    scores[i, [j for j, _ in there]] = stage.combine(np.array(pairs, np.float64))
                bar.advance()
        cost.seconds = time.perf_counter() - begun

    distributed.agreed(compare, what=label)
    device = stage.device
    all_scores = distributed.gather_uneven(torch.from_numpy(scores).to(device)).cpu().numpy()
    spent = torch.tensor([[cost.seconds, cost.describing, cost.photo_bytes]], dtype=torch.float64)
    costs = distributed.gather_uneven(spent.to(device)).cpu().numpy()
    order = np.argsort(-all_scores, axis=1, kind="stable")
    rows, kept = predictions.copy(), distances.copy()
    rows[:, :first] = np.take_along_axis(predictions[:, :first], order, 1)
    kept[:, :first] = np.take_along_axis(distances[:, :first], order, 1)
    return rows, kept, _told(costs, len(predictions), min(first, len(evaluated.database)))


def _told(costs: np.ndarray, queries: int, candidates: int) -> str:
    """`costs`: [W, 3] of seconds, seconds of describing, bytes a photo."""
    each, describing = (f"{costs[:, column].sum() / max(queries, 1):,.3f} s" for column in (0, 1))
    size = costs[:, 2].max() / 1e6
    return (
        f"re-ranking takes {each} a query on one process ({describing} to read and describe photos not yet described) "
        f"and {size * (1 + candidates):,.1f} MB for it and its candidates ({size:,.2f} MB a photo)"
    )
