"""Validation during training: the sets of the config, evaluated by the referee's own code.

Invariant: the score that chooses the best checkpoint is R@5 of the first set under the first grouping (paper,
section 4.2: R@5), as computed by `pipeline.evaluation`; nothing is measured twice in different ways.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import sys
from typing import Any

import numpy as np
from torch import nn

from pipeline.common.errors import UsageError
from pipeline.config import RunConfig
from pipeline.evaluation.sets.evaluation_set import EvaluationSet


class Validation:
    """Loads the validation sets once, evaluates a model on them whenever asked.

    Args:
        config: of the run; `config.validate` says sets and protocols.
        device: where descriptors are computed.
        queries: take so many queries of each set, with a database of as many images; none: all.

    Raises:
        DataError: a set is missing or not laid out as documented.
        UsageError: a set cannot be scored.
    """

    def __init__(self, config: RunConfig, device: Any, queries: int | None = None) -> None:
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
        if queries is not None:
            self.sets = [first(evaluated, queries) for evaluated in self.sets]
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
        from pipeline.evaluation.protocol import metric_name

        results = evaluate(model, self.sets, self.config, self.device)
        values: dict[str, float] = {}
        for result in results:
            for k, value in result.recalls.items():
                values["validation/" + metric_name(result.set_name, result.protocol, k)] = value
            if show:
                recalls = "  ".join(f"R@{k} {value:.1f}" for k, value in result.recalls.items())
                print(f"validation  {result.set_name}  {result.protocol.name}  {recalls}", file=sys.stderr, flush=True)
        return values, results[0].recalls[5]


def first(whole: EvaluationSet, queries: int) -> EvaluationSet:
    """The first queries of a set, and a database of as many images: a positive of each, and others in their order.

    Its name ends in `_first<queries>`, so that its recall is not taken for the set's.
    """
    asked = min(queries, len(whole.queries))
    found = {int(rows[0]) for rows in whole.positives[:asked] if len(rows)}
    others = (row for row in range(len(whole.database)) if row not in found)
    rows = np.array(sorted([*found, *itertools.islice(others, asked - len(found))]))

    def part(values: np.ndarray | None, chosen: np.ndarray) -> np.ndarray | None:
        return None if values is None else values[chosen]

    return dataclasses.replace(
        whole,
        name=f"{whole.name}_first{asked}",
        database=[whole.database[row] for row in rows],
        queries=whole.queries[:asked],
        positives=[np.flatnonzero(np.isin(rows, kept)) for kept in whole.positives[:asked]],
        database_positions=part(whole.database_positions, rows),
        query_positions=part(whole.query_positions, np.arange(asked)),
        database_part=part(whole.database_part, rows),
        query_part=part(whole.query_part, np.arange(asked)),
    )
