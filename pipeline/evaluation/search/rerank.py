"""The second stage of two-stage retrieval: the first candidates put in order by matching patches in space.

Invariant: only the order of the first `rerank` candidates changes, never which they are; a candidate's score depends on
the two images and their row numbers alone, and ties keep the order of the global search. Patch tokens come from the
backbone of the model that made the descriptors, one image at a time: no grouping and no number of processes enters.

The check: patches of query and candidate that are each other's nearest (cosine) are matches; a similarity transform
(scale, rotation, shift) between the two patch grids is proposed by pairs of matches; the score is the largest number of
matches that agree with one transform. (Patch-NetVLAD and TransVPR fit homographies by RANSAC to the same kind of
matches; a similarity needs two matches instead of four, and a grid of patches holds few.)
"""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from pipeline import distributed
from pipeline.common.errors import UsageError
from pipeline.common.progress import Progress
from pipeline.config import EvaluationConfig
from pipeline.data.images import load_image, normalise, to_input
from pipeline.evaluation.sets.evaluation_set import EvaluationSet

PROPOSALS = 256  # pairs of matches tried; all pairs where there are fewer
TOLERANCE = 1.5  # patches: half a patch each of two roundings to the grid, and one of distortion
SCALES = (0.5, 2.0)  # enlargement between two photographs of a place
TURN = np.pi / 6  # cameras are held upright
SIDE = 4  # patches: a smaller grid tells too little
CACHE_BYTES = 2**30  # patch tokens kept: neighbours of one query are often candidates of the next


def mutual_matches(a: Tensor, b: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Rows of unit vectors a [n, D] and b [m, D] that are each other's nearest: two int64 arrays of the same length."""
    similarities = a @ b.T
    forward, backward = similarities.argmax(1), similarities.argmax(0)
    rows = torch.arange(len(a), device=a.device)
    mutual = backward[forward] == rows
    return rows[mutual].cpu().numpy(), forward[mutual].cpu().numpy()


def inliers(left: np.ndarray, right: np.ndarray, seed: tuple[int, int] = (0, 0)) -> int:
    """The largest number of matches that agree with one similarity transform.

    Args:
        left, right: complex [n], matched positions (column + i row, in patches): right = s * left + t.
        seed: names the pair of images; decides which pairs of matches are tried where there are too many for all.
    """
    n = len(left)
    if n < 2:
        return n
    first, second = np.triu_indices(n, 1)
    if len(first) > PROPOSALS:
        # the raw stream of Philox is fixed for ever, where numpy's own samplers may change between versions
        bits = np.random.Philox(key=np.array(seed, np.uint64)).random_raw(len(first))
        chosen = np.argpartition(bits, PROPOSALS)[:PROPOSALS]
        first, second = first[chosen], second[chosen]
    step = left[first] - left[second]  # never 0: no patch is matched twice
    s = (right[first] - right[second]) / step
    plausible = (np.abs(s) >= SCALES[0]) & (np.abs(s) <= SCALES[1]) & (np.abs(np.angle(s)) <= TURN)
    s, first = s[plausible], first[plausible]
    if not len(s):
        return 1
    t = right[first] - s * left[first]
    errors = np.abs(s[:, None] * left + t[:, None] - right)  # [proposals, n]
    return int((errors <= TOLERANCE).sum(1).max())


class PatchTokens:
    """Unit patch tokens of images, the most recently used kept: the same for every grouping of a set.

    Args:
        model: a `PlaceModel` in evaluation mode, whole on this rank. One blank image goes through it at once, so that
            what cannot be matched is refused before hours of describing.

    Raises:
        UsageError: no such layer, or fewer than 4 x 4 patches; the same on all ranks.
    """

    def __init__(self, model: Any, config: EvaluationConfig, device: torch.device | str) -> None:
        self.model, self.config, self.device = model, config, torch.device(device)
        self._kept: OrderedDict[Path, Tensor] = OrderedDict()
        patches = len(self._patches(torch.zeros(3, model.image_size, model.image_size)))
        if patches < SIDE * SIDE:
            raise UsageError(f"rerank: an image has {patches} patches and needs at least 16; use a larger image_size")

    def _patches(self, image: Tensor) -> Tensor:
        """[3, S, S] normalised -> [G*G, D]."""
        with torch.no_grad():
            found: Tensor = self.model.backbone.patches(image[None].to(self.device), self.config.rerank_layer)[0]
        return found

    def of(self, path: Path) -> Tensor:
        """[G*G, D], float16 and of unit length but for its rounding.

        Raises:
            DataError: an image that cannot be read.
        """
        if path not in self._kept:
            image = to_input(load_image(path), self.model.image_size, self.config.resize).to(self.device)
            tokens = self._patches(normalise(image) if image.dtype == torch.uint8 else image)
            self._kept[path] = F.normalize(tokens.float(), dim=-1).half()
            size = self._kept[path].numel() * 2
            while len(self._kept) * size > CACHE_BYTES and len(self._kept) > 1:
                self._kept.popitem(last=False)
        self._kept.move_to_end(path)
        return self._kept[path]


def score(query: Tensor, candidate: Tensor, seed: tuple[int, int]) -> int:
    """Matches in agreement between two images' unit patch tokens [G*G, D]."""
    grid = round(len(query) ** 0.5)
    left, right = mutual_matches(query.float(), candidate.float())
    return inliers(left % grid + 1j * (left // grid), right % grid + 1j * (right // grid), seed)


def rerank(
    tokens: PatchTokens,
    evaluated: EvaluationSet,
    predictions: np.ndarray,
    distances: np.ndarray,
    progress: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """The first `config.rerank` of each query's candidates in the order of their scores. Collective.

    Each rank takes consecutive queries, whose candidates overlap; every rank needs the whole model.

    Args:
        tokens: of the model that made the descriptors; its configuration says how many candidates.
        predictions, distances: [Q, k] database rows (-1: none) and squared distances of the global search.

    Raises:
        UsageError: fewer candidates than are to be re-ranked; DataError: an image that cannot be read, on all ranks.
    """
    first = tokens.config.rerank
    if predictions.shape[1] < first:
        raise UsageError(f"rerank {first} needs as many candidates, the search gave {predictions.shape[1]}")
    own = distributed.rank_slice(len(predictions))
    scores = np.full((own.stop - own.start, first), -1, np.int64)
    label, show = f"re-ranking {evaluated.name}", progress and distributed.rank() == 0

    def compare() -> None:
        with Progress(label, len(scores), "queries of this rank", enabled=show) as bar:
            for i, q in enumerate(range(own.start, own.stop)):
                query = tokens.of(evaluated.queries[q])
                for j, row in enumerate(predictions[q, :first].tolist()):
                    if row >= 0:
                        scores[i, j] = score(query, tokens.of(evaluated.database[row]), (q, row))
                bar.advance()

    distributed.agreed(compare, what=label)
    all_scores = distributed.gather_uneven(torch.from_numpy(scores).to(tokens.device)).cpu().numpy()
    order = np.argsort(-all_scores, axis=1, kind="stable")
    rows, kept = predictions.copy(), distances.copy()
    rows[:, :first] = np.take_along_axis(predictions[:, :first], order, 1)
    kept[:, :first] = np.take_along_axis(distances[:, :first], order, 1)
    return rows, kept
