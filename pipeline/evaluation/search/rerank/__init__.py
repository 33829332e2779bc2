"""Second stages by name, `rerank_by`: each describes photos for matching, scores pairs, orders candidates."""

from __future__ import annotations

from typing import Any

import torch

from pipeline.config import EvaluationConfig
from pipeline.evaluation.search.rerank.grid_patches import GridPatches
from pipeline.evaluation.search.rerank.key_patches import KeyPatches
from pipeline.evaluation.search.rerank.patch_netvlad import PatchNetVLAD, PatchNetVLADRapid
from pipeline.evaluation.search.rerank.reranker import Reranker

RERANKERS: dict[str, type[Reranker]] = {
    "patches": GridPatches,
    "patch-netvlad": PatchNetVLAD,
    "patch-netvlad-rss": PatchNetVLADRapid,
    "transvpr": KeyPatches,
}


def build_reranker(model: Any, config: EvaluationConfig, device: torch.device | str) -> Reranker:
    """The second stage that `config.rerank_by` names.

    Raises:
        UsageError: the model cannot be matched in this way, or a library is missing.
    """
    return RERANKERS[config.rerank_by](model, config, device)
