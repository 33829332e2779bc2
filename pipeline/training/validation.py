"""Validation during training: the sets of the config, evaluated by the referee's own code.

Invariant: the score that chooses the best checkpoint is R@5 of the first set under the first grouping (paper,
section 4.2: R@5), as computed by `pipeline.evaluation`; nothing is measured twice in different ways.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import sys
from typing import Any

from torch import nn

from pipeline.common.errors import UsageError
from pipeline.config import RunConfig


class Validation:
    """Loads the validation sets once, evaluates a model on them whenever asked.

    Args:
        config: of the run; `config.validate` says sets and protocols.
        device: where descriptors are computed.

    Raises:
        DataError: a set is missing or not laid out as documented.
        UsageError: a set cannot be scored.
    """

    def __init__(self, config: RunConfig, device: Any) -> None:
        from pipeline.evaluation.sets.load import load_set

        if config.validate.rerank:
            raise UsageError(
                "validate.rerank: a checkpoint is chosen by the recall of its descriptors; re-rank in jobs.evaluate"
            )
        self.image_size = config.data.image_size
        # R@5 chooses the best checkpoint, whatever else is asked for
        recalls = tuple(sorted({*config.validate.recalls, 5}))
        self.config = dataclasses.replace(config.validate, recalls=recalls)
        self.sets = [load_set(name, self.config) for name in config.validate.sets]
        for name, evaluated in zip(config.validate.sets, self.sets, strict=True):
            if not evaluated.has_ground_truth:
                raise UsageError(
                    f"validate.sets: {name} has no ground truth, so no recall could choose a checkpoint; take another "
                    "set, and let jobs.evaluate export this one's predictions"
                )
        self.device = device

    def identity(self) -> str:
        """Sixteen hex digits of what the score is of: the first set's images and positives, and its protocol.

        Scores of two identities are not compared. Names and sizes of images count, not where they lie.
        """
        from pipeline.evaluation.protocol import protocols

        first = self.sets[0]
        protocol = protocols(self.config, self.image_size, first.rule)[0]
        seen = hashlib.sha256(json.dumps([first.name, protocol.to_dict()], sort_keys=True).encode())
        for paths in (first.database, first.queries):
            seen.update(json.dumps([(path.name, path.stat().st_size) for path in paths]).encode())
        for positives in first.positives:
            seen.update(positives.tobytes() + b"|")
        return seen.hexdigest()[:16]

    def run(self, model: nn.Module, show: bool) -> tuple[dict[str, float], float]:
        """Recalls by metric name, and the score; collective, the same on every rank."""
        from pipeline.evaluation.evaluate import evaluate

        results = evaluate(model, self.sets, self.config, self.device)
        values: dict[str, float] = {}
        for result in results:
            prefix = f"validation/{result.set_name}.{result.protocol.name}"
            values |= {f"{prefix}.recall_at_{k}": value for k, value in result.recalls.items()}
            if show:
                recalls = "  ".join(f"R@{k} {value:.1f}" for k, value in result.recalls.items())
                print(f"validation  {result.set_name}  {result.protocol.name}  {recalls}", file=sys.stderr, flush=True)
        return values, results[0].recalls[5]
