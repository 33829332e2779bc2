"""What a second stage is: how it describes a photo for matching, scores a pair, and orders a query's candidates."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pipeline.config import EvaluationConfig
from pipeline.config.image_size import input_size

Features = tuple[Tensor, ...]
"""Of one photo, on the model's device; what tells a shape, on the CPU."""


class Reranker(ABC):
    """A second stage over the model that made the descriptors.

    One blank image goes through the model at once, so that what cannot be matched is refused before hours of
    describing. Scores of a pair depend on the two images and `seed` alone.

    Args:
        model: a `PlaceModel` in evaluation mode, whole on this rank.
        config: says how many candidates, and of which layer the patches are.

    Raises:
        UsageError: the model cannot be matched in this way; the same on all ranks.
    """

    columns = 1
    """Scores of a pair: one for each size of patch."""

    def __init__(self, model: Any, config: EvaluationConfig, device: torch.device | str) -> None:
        self.model, self.config, self.device = model, config, torch.device(device)
        self.describe(torch.zeros(3, *input_size(model).largest, device=self.device))

    @abstractmethod
    def describe(self, image: Tensor) -> Features:
        """What is matched of a normalised image [3, H, W], without gradient."""

    @abstractmethod
    def compare(self, query: Features, candidate: Features, seed: tuple[int, int]) -> tuple[float, ...]:
        """`columns` scores of a pair, larger for more alike. `seed` names the pair."""

    def combine(self, scores: np.ndarray) -> np.ndarray:
        """Scores of a query's candidates [n, columns] -> one of each [n]; the largest comes first."""
        return scores[:, 0]
