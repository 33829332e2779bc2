"""Recalls, and tables of PCA dimensions, from descriptor stores alone: no model, no GPU, no photographs.

Invariant: only stores whose images are those of the set, in its order, are searched; the grouping, size and precision
of a result come from the store, and only PCA, search and the policy for queries come from the configuration.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from pipeline.common.errors import DataError
from pipeline.config import EvaluationConfig
from pipeline.evaluation.describe.store import DescriptorStore
from pipeline.evaluation.evaluate import Result, answer_queries, score
from pipeline.evaluation.protocol import Protocol
from pipeline.evaluation.sets.evaluation_set import EvaluationSet


def stored_sets(output: Path) -> list[str]:
    """Names of the sets with descriptors below `output`, the folder an evaluation wrote to.

    Raises:
        DataError: there are none.
    """
    names = sorted({f.parent.parent.name for f in (output / "descriptors").glob("*/*/database")})
    if not names:
        raise DataError(f"{output}: no descriptors/ in it; evaluate once with --store fp32 or fp16")
    return names


def evaluate_stores(
    output: Path, sets: Sequence[EvaluationSet], config: EvaluationConfig, dimensions: Sequence[int | None] = (None,)
) -> list[Result]:
    """The results of every stored grouping of every set, once for each of `dimensions` (None: no PCA).

    Args:
        output: the folder an evaluation with `config.store` wrote to (it holds `descriptors/`).
        config: its recalls, PCA whitening, search and `without_positives`; PCA is fitted on each set's own database.

    Raises:
        DataError: a set has no finished store, or the store is of other images or other weights than its partner.
    """
    results: list[Result] = []
    for evaluated in sets:
        folder = output / "descriptors" / evaluated.name
        groupings = sorted((f.parent for f in folder.glob("*/database")), key=lambda f: f.name)
        if not groupings:
            raise DataError(f"{folder}: no descriptors of {evaluated.name}; evaluate it once with --store fp32")
        for grouping in groupings:
            database, queries = DescriptorStore(grouping / "database"), DescriptorStore(grouping / "queries")
            _belong(grouping, database, queries, evaluated)
            for dims in dimensions:
                protocol = _protocol(database.protocol, evaluated, config, dims)
                described = {"database": database.blocks, "queries": queries.blocks}
                answer = answer_queries(evaluated, protocol, config, described)  # type: ignore[arg-type]
                results.append(score(evaluated, protocol, config, *answer))
    return results


def _protocol(stored: Protocol, evaluated: EvaluationSet, config: EvaluationConfig, dims: int | None) -> Protocol:
    return dataclasses.replace(
        stored,
        pca=dims,
        whiten=config.pca_whiten and dims is not None,
        rule=evaluated.rule,
        without_positives=config.without_positives,
        search=config.search,
    )


def _belong(folder: Path, database: DescriptorStore, queries: DescriptorStore, evaluated: EvaluationSet) -> None:
    if database.about["model"] != queries.about["model"]:
        raise DataError(f"{folder}: database and queries were described by different weights; evaluate again")
    for store, paths in ((database, evaluated.database), (queries, evaluated.queries)):
        if not store.holds(paths):
            raise DataError(f"{store.folder}: holds other images than {evaluated.name} has now; evaluate again")
