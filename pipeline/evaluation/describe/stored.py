"""Recalls of stored descriptors, whole, shortened and as codes, in one table: no model, no GPU, no photographs.

Invariant: only stores whose images are those of the set, in its order, are searched; the grouping, size and precision
of a result come from the store, and only what is made of whole descriptors (PCA, prefixes, codes), search and the
policy for queries come from the configuration.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.common.errors import DataError
from pipeline.config import EvaluationConfig
from pipeline.evaluation.describe.store import DescriptorStore
from pipeline.evaluation.difference import Difference, difference
from pipeline.evaluation.evaluate import Result, answer_queries, own_projection, score
from pipeline.evaluation.protocol import candidates
from pipeline.evaluation.recall import first_hits
from pipeline.evaluation.search.projection import check_prefix
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
    output: Path,
    sets: Sequence[EvaluationSet],
    config: EvaluationConfig,
    dimensions: Sequence[int] = (),
    prefixes: Sequence[int] = (),
    searches: Sequence[str] = (),
) -> list[Result]:
    """The results of every stored grouping of every set: of its whole descriptors, then of each way to make them small.

    Each has its cost, and its difference to the exact search in the whole descriptors, which comes first.

    Args:
        output: the folder an evaluation with `config.store` wrote to (it holds `descriptors/`).
        config: its recalls, PCA whitening, search, `refine` and `without_positives`.
        dimensions: of PCA, fitted on each set's own database.
        prefixes: numbers of first dimensions.
        searches: kinds of search beside the config's, for whole, projected and cut descriptors; with `config.refine`
            those of codes once by their codes alone and once refined.

    Raises:
        DataError: a set has no finished store, or the store is of other images or other weights than its partner.
        UsageError: more dimensions than there are, fewer candidates to refine than are asked for.
    """
    kinds = [
        (kind, number)
        for kind in dict.fromkeys((config.search, *searches))
        for number in sorted({0, candidates(kind, config)})
    ]
    results: list[Result] = []
    for evaluated in sets:
        folder = output / "descriptors" / evaluated.name
        groupings = sorted((f.parent for f in folder.glob("*/database")), key=lambda f: f.name)
        if not groupings:
            raise DataError(f"{folder}: no descriptors of {evaluated.name}; evaluate it once with --store fp32")
        for grouping in groupings:
            database, queries = DescriptorStore(grouping / "database"), DescriptorStore(grouping / "queries")
            _belong(grouping, database, queries, evaluated)
            check_prefix(max(prefixes, default=None), database.dim)
            described = {"database": database.blocks, "queries": queries.blocks}
            plain = dataclasses.replace(
                database.protocol, rule=evaluated.rule, without_positives=config.without_positives
            )
            pcas = [dataclasses.replace(plain, pca=dims, whiten=config.pca_whiten) for dims in dimensions]
            cuts = [dataclasses.replace(plain, prefix=dims) for dims in prefixes]
            whole: Result | None = None
            for short in (plain, *pcas, *cuts):
                fitted = own_projection(evaluated, short, database.blocks) if short.pca else None
                for kind, number in kinds:
                    protocol = dataclasses.replace(short, search=kind, refine=number)
                    answers = answer_queries(evaluated, protocol, config, described, fitted)  # type: ignore[arg-type]
                    result = score(evaluated, protocol, config, answers)
                    against = _against(whole, result, evaluated, min(config.recalls))
                    results.append(dataclasses.replace(result, cost=answers.cost, against=against))
                    whole = whole or (result if protocol == plain else None)
    return results


def _against(whole: Result | None, result: Result, evaluated: EvaluationSet, k: int) -> Difference | None:
    """A result compared with the one of whole descriptors, query by query; None without that, or without recalls."""
    if whole is None or not result.recalls:
        return None
    counted = np.fromiter((len(p) > 0 for p in evaluated.positives), bool, len(evaluated.positives))
    ranks = (
        first_hits(whole.predictions, evaluated.positives),
        first_hits(result.predictions, evaluated.positives),
    )
    names = (whole.protocol.name, result.protocol.name)
    drop = result.protocol.without_positives == "drop"
    return difference((result.set_name, names[1], k, names), ranks, counted if drop else np.ones_like(counted))


def _belong(folder: Path, database: DescriptorStore, queries: DescriptorStore, evaluated: EvaluationSet) -> None:
    if database.about["model"] != queries.about["model"]:
        raise DataError(f"{folder}: database and queries were described by different weights; evaluate again")
    for store, paths in ((database, evaluated.database), (queries, evaluated.queries)):
        if not store.holds(paths):
            raise DataError(f"{store.folder}: holds other images than {evaluated.name} has now; evaluate again")
