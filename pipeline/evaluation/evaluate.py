"""A model and some sets -> recalls with their protocols: the one evaluation that training, jobs and tables share.

Invariant: collective and equal: every rank calls `evaluate` with the same sets and gets the same results; only rank 0
searches and writes. A result never leaves without its protocol.
"""

from __future__ import annotations

import dataclasses
import hashlib
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import nn

from pipeline.common.files import locked
from pipeline.config import EvaluationConfig
from pipeline.distributed import agreed, held_on_rank_0, on_rank_0, same
from pipeline.evaluation.describe.bank import chosen_bank
from pipeline.evaluation.describe.encode import evaluating
from pipeline.evaluation.describe.sides import Engine
from pipeline.evaluation.difference import Difference
from pipeline.evaluation.identity import Identity, files_digest, model_digest
from pipeline.evaluation.protocol import Protocol, Side, protocols
from pipeline.evaluation.recall import recall_at
from pipeline.evaluation.search.approximate import agreement, build_index, bytes_each, index_bytes, search_index
from pipeline.evaluation.search.cores import all_cores
from pipeline.evaluation.search.exact import Blocks, batches, search, search_within
from pipeline.evaluation.search.on_device import search_on_devices
from pipeline.evaluation.search.projection import (
    Prefix,
    Projection,
    check_prefix,
    fit_rows,
    load_projection,
    projected,
    sample_rows,
)
from pipeline.evaluation.search.rerank import build_reranker
from pipeline.evaluation.search.rerank.second_stage import Described, rerank
from pipeline.evaluation.sets.evaluation_set import EvaluationSet, check_names
from pipeline.evaluation.sets.load import load_set

SIDES: tuple[Side, Side] = ("database", "queries")


@dataclass(frozen=True)
class Result:
    """The recall of one set under one protocol."""

    set_name: str
    protocol: Protocol
    recalls: dict[int, float]
    """Recall@N in percent; empty for a set without ground truth."""
    queries: int
    """Queries of the set, also those without positives."""
    database: int
    without_positives: int
    """Queries that have no positive at all; a miss or dropped, as the protocol says."""
    predictions: np.ndarray = field(repr=False)
    """Database rows int64 [Q, max N], best first; -1 where the database is smaller."""
    distances: np.ndarray = field(repr=False)
    """Squared L2 of the predictions, float32 [Q, max N]."""
    remarks: tuple[str, ...] = ()
    """What a reader should know, for example how well an approximate search agrees with the exact one."""
    cost: SearchCost | None = None
    """Where it was asked for: of stored descriptors."""
    against: Difference | None = None
    """Where there is one: to the exact search in the full descriptors, at the smallest N."""


@dataclass(frozen=True)
class SearchCost:
    """What a search keeps and takes."""

    bytes_each: int
    """Of a database image, in what the search reads whole: codes, or float32 descriptors."""
    refine_bytes: int
    """Of a database image, in the floats that order the candidates anew; 0 without that."""
    milliseconds: float
    """A query, all queries being asked at once, on the threads there are; reading and projecting descriptors left
    out."""


@dataclass(frozen=True)
class Answers:
    """What a search found for Q queries."""

    rows: np.ndarray
    """Database rows int64 [Q, k], best first; -1 where there are fewer."""
    distances: np.ndarray
    """Squared L2, float32 [Q, k]."""
    remarks: tuple[str, ...] = ()
    cost: SearchCost | None = None


def evaluate(
    model: nn.Module,
    sets: Sequence[EvaluationSet],
    config: EvaluationConfig,
    device: torch.device | str,
    output: Path | None = None,
    progress: bool = True,
    projections: Mapping[str, Projection] | None = None,
    fingerprint: str | None = None,
) -> list[Result]:
    """Recall of `model` on every set under every grouping of `config`, sets outermost. Collective.

    Args:
        model: a `PlaceModel`, or the wrapper that holds one as `.module`; left in the mode it came in.
        output: folder of the descriptor store (`config.store`) and of what is too large for memory.
        progress: show bars on rank 0.
        projections: protocol name without PCA -> PCA fitted before (`fit_projections`); needed where
            `config.pca_from` names a set; otherwise PCA is fitted on each set's own database.
        fingerprint: `identity.model_digest` of the model; None computes it where `output` needs it.

    Raises:
        DataError: images that cannot be read, descriptors that are not finite; the same on all ranks.
        UsageError: two sets of one name.
    """
    model = getattr(model, "module", model)
    device = torch.device(device)
    if output is not None and fingerprint is None:
        fingerprint = model_digest(model)
    results: list[Result] = []
    with _alone_in(output), evaluating(model):
        engine = Engine(model, config, device, output, progress, fingerprint or "")
        check_prefix(config.prefix, int(engine.model.descriptor_dim))
        second = Described(build_reranker(model, config, device)) if config.rerank else None
        bank = None
        same(", ".join(evaluated.name for evaluated in sets), "the list of sets")
        check_names(sets)
        for evaluated in sets:
            same(_names_digest(evaluated), f"the digest of the photo names of {evaluated.name}")
            if bank is None or config.bank_from == "map":  # only that one is another for each set
                bank = chosen_bank(model, config, evaluated.database, device)
            chosen = protocols(config, engine.model.image_size, evaluated.rule, bank)
            sides = {side: engine.side(evaluated, side, chosen, bank) for side in SIDES}
            for protocol in chosen:
                described = {side: sides[side].describe(protocol) for side in SIDES}
                fitted = (projections or {}).get(protocol.grouping.name)
                answer_by = answer_on_devices if on_devices(device, evaluated, protocol) else _answer_on_rank_0
                answer = answer_by(evaluated, protocol, config, described, fitted, device)
                if second is not None:
                    rows, distances, cost = rerank(second, evaluated, answer.rows, answer.distances, progress)
                    remarks = (*answer.remarks, f"{protocol.name}: {cost}")
                    answer = dataclasses.replace(answer, rows=rows, distances=distances, remarks=remarks)
                results.append(score(evaluated, protocol, config, answer))
            for side in SIDES:
                sides[side].close()
    return results


def _alone_in(output: Path | None) -> AbstractContextManager[None]:
    """No second evaluation works in the folder at the same time: they would remove each other's parts."""
    if output is None:
        return nullcontext()
    refusal = f"{output}: another evaluation works in it; wait for that, or give another --output"
    return held_on_rank_0(partial(locked, output / ".lock", refusal), what=f"the results' folder {output}")


def _names_digest(evaluated: EvaluationSet) -> str:
    names = "\n".join(path.name for path in (*evaluated.database, *evaluated.queries))
    return hashlib.sha256(names.encode(errors="surrogateescape")).hexdigest()[:16]


def projections_from(
    model: nn.Module,
    config: EvaluationConfig,
    device: torch.device | str,
    progress: bool = True,
    beside: Path | None = None,
    fingerprint: str = "",
) -> dict[str, Projection] | None:
    """`fit_projections` on the set that `config.pca_from` names; None where it names none, or there is no PCA."""
    if not config.pca or not config.pca_from:
        return None
    source = agreed(partial(load_set, config.pca_from, dataclasses.replace(config, split="train")))
    return fit_projections(model, source, config, device, progress, beside, fingerprint)


def fit_projections(
    model: nn.Module,
    source: EvaluationSet,
    config: EvaluationConfig,
    device: torch.device | str,
    progress: bool = True,
    beside: Path | None = None,
    fingerprint: str = "",
) -> dict[str, Projection]:
    """PCA of `source`'s database for every grouping: name of the grouping -> projection. Collective.

    At most `projection.SAMPLE` images, seeded; groups are formed over the sample. Kept in the folder `beside`, under
    the digest of its identity (`fingerprint` is the model's digest), and read from there the next time. Ranks other
    than 0 get {}.
    """
    model, device = getattr(model, "module", model), torch.device(device)
    rows = sample_rows(len(source.database))
    sampled = dataclasses.replace(
        source,
        database=[source.database[row] for row in rows],
        queries=source.queries[:1],
        positives=[np.zeros(0, np.int64)],
        database_positions=None,
        query_positions=None,
        database_part=None,
        query_part=None,
    )
    fitted: dict[str, Projection] = {}
    with evaluating(model):
        bank = chosen_bank(model, config, source.database, device)
    chosen = protocols(config, model.image_size, source.rule, bank)  # type: ignore[arg-type]

    files: dict[Protocol, Path] = {}

    def read() -> list[Protocol]:
        if beside is not None:
            digest = files_digest(sampled.database)
            for p in chosen:
                fit = dataclasses.replace(p.grouping, pca=p.pca, whiten=p.whiten)
                name = f"pca.{source.name}.{fit.name}.{Identity('pca', fingerprint, digest, fit).digest}.safetensors"
                files[p] = beside / name
        kept = {p: path for p, path in files.items() if path.is_file()}
        fitted.update({p.grouping.name: load_projection(path) for p, path in kept.items()})
        return [p for p in chosen if p not in kept]

    def fit(blocks: Blocks | None, protocol: Protocol) -> None:
        about = f"{source.name} database, {len(rows)} of {len(source.database)} images, {protocol.grouping.name}"
        projection = fit_rows(_there(blocks), np.arange(len(rows)), config.pca or 0, protocol.whiten, about, device)
        fitted[protocol.grouping.name] = projection
        if protocol in files:
            projection.save(files[protocol])

    missing = on_rank_0(read)
    if not missing:
        return fitted
    with evaluating(model):
        engine = Engine(model, config, device, None, progress, "")
        side = engine.side(sampled, "database", missing, bank)
        for protocol in missing:
            on_rank_0(partial(fit, side.describe(protocol), protocol))
        side.close()
    return fitted


@all_cores(faiss=True)
def answer_queries(
    evaluated: EvaluationSet,
    protocol: Protocol,
    config: EvaluationConfig,
    described: Mapping[Side, Blocks | None],
    fitted: Projection | None = None,
) -> Answers:
    """The search itself, on one process, from descriptors in memory or in a store.

    PCA is fitted on the set's own database where the protocol asks for PCA and none is given.
    """
    database, queries = _shortened(evaluated, protocol, described, fitted)
    found, distances = _none_yet(evaluated, protocol, config)
    k = found.shape[1]
    parts = evaluated.database_part, evaluated.query_part
    clock, within = Clock(), parts[0] is not None and parts[1] is not None
    if within or protocol.search == "exact":
        dim = 0
        for numbers, asked in batches(queries):
            dim = asked.shape[1]
            with clock:
                if parts[0] is not None and parts[1] is not None:
                    answers = search_within(asked, parts[1][numbers], clock.outside(database), parts[0], k)
                else:
                    answers = search(asked, clock.outside(database)(), k)
            distances[numbers], found[numbers] = answers
        remarks = ("each query is searched within its own part of the database",) * within
        return Answers(found, distances, remarks, SearchCost(4 * dim, 0, 1e3 * clock.seconds / len(found)))
    index = build_index(database, protocol.search, protocol.refine > 0)
    sample = sample_rows(len(evaluated.queries), 1_000)  # the exact answer of some tells what the approximation costs
    exact: list[np.ndarray] = []
    near: list[np.ndarray] = []
    for numbers, asked in batches(queries):
        with clock:
            distances[numbers], found[numbers] = search_index(index, asked, k, protocol.refine)
        if (inside := np.isin(numbers, sample)).any():
            exact.append(search(asked[inside], database(), k)[1])
            near.append(found[numbers[inside]])
    share = agreement(np.concatenate(near), np.concatenate(exact))
    remark = f"{protocol.name} finds {share:.1f} % of the exact {k} neighbours ({len(sample):,} queries), index"
    cost = SearchCost(*bytes_each(index), 1e3 * clock.seconds / len(found))
    return Answers(found, distances, (f"{remark} {index_bytes(index) / 1e6:,.1f} MB",), cost)


def _none_yet(evaluated: EvaluationSet, protocol: Protocol, config: EvaluationConfig) -> tuple[np.ndarray, np.ndarray]:
    """Room for the rows int64 and the distances float32 [Q, k] of as many answers as are asked for."""
    shape = (len(evaluated.queries), max(*config.recalls, protocol.rerank))
    return np.full(shape, -1, np.int64), np.full(shape, np.inf, np.float32)


def on_devices(device: torch.device, evaluated: EvaluationSet, protocol: Protocol) -> bool:
    """Whether the ranks' GPUs search: exactly, and in the whole database. faiss does everything else."""
    return device.type == "cuda" and protocol.search == "exact" and evaluated.database_part is None


def answer_on_devices(
    evaluated: EvaluationSet,
    protocol: Protocol,
    config: EvaluationConfig,
    described: Mapping[Side, Blocks | None],
    fitted: Projection | None,
    device: torch.device,
) -> Answers:
    """As `answer_queries`, by all ranks, each on its `device`; the same on all. Collective."""
    sides: list[Blocks] = []
    on_rank_0(lambda: sides.extend(_shortened(evaluated, protocol, described, fitted)))
    coming = batches(sides[1]) if sides else iter(())
    found, distances = _none_yet(evaluated, protocol, config)
    taken: list[np.ndarray] = []

    def take() -> np.ndarray | None:
        batch = next(coming, None)
        taken[:] = () if batch is None else (batch[1],)
        return None if batch is None else batch[0]

    while (numbers := on_rank_0(take)) is not None:
        asked, database = (taken[0], sides[0]) if sides else (None, None)
        distances[numbers], found[numbers] = search_on_devices(asked, database, found.shape[1], device)
    return Answers(found, distances)


def _answer_on_rank_0(
    evaluated: EvaluationSet,
    protocol: Protocol,
    config: EvaluationConfig,
    described: Mapping[Side, Blocks | None],
    fitted: Projection | None,
    device: torch.device,
) -> Answers:
    return on_rank_0(partial(answer_queries, evaluated, protocol, config, described, fitted))


def _shortened(
    evaluated: EvaluationSet,
    protocol: Protocol,
    described: Mapping[Side, Blocks | None],
    fitted: Projection | None,
) -> tuple[Blocks, Blocks]:
    """Database and queries as the protocol compares them: whole, projected, or cut."""
    database, queries = _there(described["database"]), _there(described["queries"])
    if protocol.pca:
        short: Projection | Prefix = fitted or own_projection(evaluated, protocol, database)
    elif protocol.prefix:
        short = Prefix(protocol.prefix)
    else:
        return database, queries
    return projected(database, short), projected(queries, short)


def own_projection(evaluated: EvaluationSet, protocol: Protocol, database: Blocks) -> Projection:
    """The PCA that the protocol asks for, of the set's own database."""
    rows = sample_rows(len(evaluated.database))
    about = f"{evaluated.name} database, {len(rows)} of {len(evaluated.database)} images, {protocol.grouping.name}"
    return fit_rows(database, rows, protocol.pca or 0, protocol.whiten, about)


class Clock:
    """Seconds inside `with clock`, without those in which blocks come that are read `outside` of it."""

    def __init__(self) -> None:
        self.seconds, self._start = 0.0, 0.0

    def __enter__(self) -> None:
        self._start = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self.seconds += time.perf_counter() - self._start

    def outside(self, blocks: Blocks) -> Blocks:
        """The same blocks, with the clock stopped while each is made."""

        def paused() -> Iterator[tuple[np.ndarray, np.ndarray]]:
            coming = iter(blocks())
            while True:
                start = time.perf_counter()
                block = next(coming, None)
                self.seconds -= time.perf_counter() - start
                if block is None:
                    return
                yield block

        return paused


def score(evaluated: EvaluationSet, protocol: Protocol, config: EvaluationConfig, answers: Answers) -> Result:
    """Predictions [Q, k] -> the result, without recalls where the set has no ground truth."""
    recalls: dict[int, float] = {}
    if evaluated.has_ground_truth:
        recalls = recall_at(
            answers.rows, evaluated.positives, config.recalls, without_positives=config.without_positives
        )
    return Result(
        evaluated.name,
        protocol,
        recalls,
        len(evaluated.queries),
        len(evaluated.database),
        sum(len(positives) == 0 for positives in evaluated.positives),
        answers.rows,
        answers.distances,
        tuple(evaluated.remarks) + answers.remarks,
    )


def _there(blocks: Blocks | None) -> Blocks:
    assert blocks is not None  # descriptors are on rank 0, and only rank 0 searches
    return blocks
