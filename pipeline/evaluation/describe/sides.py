"""One side of one set, from image files to descriptors under each protocol: encoded once, kept in a store or held.

Invariant: what a store already holds under the same key is not computed again, and nothing is computed for a grouping
that is complete. Descriptors are on rank 0 alone; every method is collective.
"""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pipeline import distributed
from pipeline.common.files import unnamed_file
from pipeline.config import EvaluationConfig, to_dict
from pipeline.evaluation.describe.encode import Block, Regions, blocks_of, calls_of, correlate, encode
from pipeline.evaluation.describe.store import DescriptorStore, StoreWriter, store_folder
from pipeline.evaluation.identity import Identity, files_digest
from pipeline.evaluation.protocol import Protocol, Side
from pipeline.evaluation.search.exact import Blocks, slices
from pipeline.evaluation.sets.evaluation_set import EvaluationSet
from pipeline.model.bank import Bank
from pipeline.model.cross_image import Memory

IN_MEMORY = 8 * 2**30  # bytes of one side's descriptors that rank 0 holds in memory; larger ones lie in a file


@dataclass(frozen=True)
class Engine:
    """The model and where it works; `side` encodes."""

    model: Any
    """Has `encode`, `correlate`, `regions`, `descriptor_dim`, `image_size`; in eval mode already (`evaluating`)."""
    config: EvaluationConfig
    device: torch.device
    output: Path | None
    """Folder of the store and of regions too large for memory; None: no store."""
    progress: bool
    fingerprint: str
    """`model_digest`; needed with an output folder."""

    def side(
        self, evaluated: EvaluationSet, side: Side, chosen: Sequence[Protocol], bank: Bank | None = None
    ) -> DescribedSide:
        """Encodes one side of a set, unless the store holds all of it under the `chosen` protocols.

        `bank`: the one of the protocol of groups `bank`, where there is one among them.
        """
        paths = evaluated.database if side == "database" else evaluated.queries
        dim = int(self.model.descriptor_dim)
        calls = {p: calls_of(p, len(paths), side, self.model) for p in chosen}
        blocks = {p: blocks_of(groups, dim) for p, (groups, _) in calls.items()}
        files = ""
        writers: dict[Protocol, StoreWriter] = {}

        def open_stores() -> tuple[str, dict[Protocol, frozenset[int]]]:
            digest = files_digest(paths)
            if self.config.store != "none":
                writers.update({p: self._writer(evaluated, side, p, digest, len(blocks[p])) for p in chosen})
            return digest, {p: writer.done for p, writer in writers.items()}

        done: dict[Protocol, frozenset[int]] = {}
        if self.output is not None:
            files, done = distributed.on_rank_0(open_stores, what=f"the descriptors in {self.output}")
        missing = [p for p in chosen if len(done.get(p, ())) < len(blocks[p])]
        scratch = None if self.output is None else self.output / "scratch" / f"{evaluated.name}.{side}"
        regions = None
        if missing:
            regions = encode(
                self.model,
                paths,
                [blocks[p] for p in missing],
                self.config,
                self.device,
                f"{evaluated.name} {side}: encoding",
                scratch,
                " ".join(Identity("regions", self.fingerprint, files, p.grouping).digest for p in missing),
                self.progress,
                evaluated.queries if side == "database" else (),
                any(p.groups == "bank" for p in missing),
            )
        alone = {p: together for p, (_, together) in calls.items()}
        label = f"{evaluated.name} {side}"
        memory = None if bank is None else self.model.remember(bank)
        return DescribedSide(self, label, len(paths), blocks, alone, writers, done, regions, scratch, memory)

    def _writer(self, evaluated: EvaluationSet, side: Side, protocol: Protocol, files: str, parts: int) -> StoreWriter:
        of_database = side == "database"
        assert self.output is not None  # stores are opened only where there is a folder
        model_config = getattr(self.model, "config", None)
        described = dataclasses.is_dataclass(model_config) and not isinstance(model_config, type)
        return StoreWriter(
            store_folder(self.output, evaluated.name, protocol, side),
            Identity(side, self.fingerprint, files, protocol.grouping),
            evaluated.database if of_database else evaluated.queries,
            evaluated.database_positions if of_database else evaluated.query_positions,
            parts,
            to_dict(model_config) if described else None,
        )


@dataclass(frozen=True)
class DescribedSide:
    """The regions of one side, and where its descriptors are kept."""

    engine: Engine
    label: str
    rows: int
    blocks: dict[Protocol, list[Block]]
    alone: dict[Protocol, bool]
    """Whether a block's calls are of groups of one image each."""
    writers: dict[Protocol, StoreWriter]
    """Empty on ranks other than 0, and without a store."""
    done: dict[Protocol, frozenset[int]]
    """Parts that the store held before; the same on all ranks."""
    regions: Regions | None
    scratch: Path | None
    memory: Memory | None = None
    """Of the bank."""

    def describe(self, protocol: Protocol) -> Blocks | None:
        """The descriptors under one protocol, as blocks on rank 0, None elsewhere. Collective."""
        writer = self.writers.get(protocol)
        held = _Held(self.rows) if writer is None and distributed.rank() == 0 else None
        keep = writer.put if writer is not None else held.put if held is not None else _drop
        if self.regions is not None:
            correlate(
                self.engine.model,
                self.regions,
                self.blocks[protocol],
                keep,
                self.engine.device,
                self.done.get(protocol, frozenset()),
                f"{self.label}: {protocol.grouping.name}",
                self.engine.progress,
                self.alone[protocol],
                self.memory if protocol.groups == "bank" else None,
            )
        if writer is not None:
            return DescriptorStore(writer.folder).blocks
        return held.blocks if held is not None else None

    def close(self) -> None:
        """Removes the regions' file, which a killed run would have continued. Collective."""
        distributed.barrier()
        if self.scratch is None:
            return
        shutil.rmtree(self.scratch, ignore_errors=True)  # all ranks of a machine try; one succeeds
        with contextlib.suppress(OSError):  # the other side's folder is still there
            self.scratch.parent.rmdir()


class _Held:
    """One side's descriptors in row order, without a store: in memory, or in a temporary file when large."""

    def __init__(self, rows: int) -> None:
        self.rows, self.array = rows, np.empty((0, 0), np.float32)

    def put(self, number: int, positions: np.ndarray, descriptors: np.ndarray) -> None:
        if len(self.array) == 0:
            kind, shape = descriptors.dtype, (self.rows, descriptors.shape[1])
            if shape[0] * shape[1] * kind.itemsize <= IN_MEMORY:
                self.array = np.empty(shape, kind)
            else:
                with unnamed_file(shape[0] * shape[1] * kind.itemsize) as file:
                    self.array = np.memmap(file, kind, mode="r+", shape=shape)
        self.array[positions] = descriptors

    def blocks(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        return slices(self.array)


def _drop(number: int, positions: np.ndarray, descriptors: np.ndarray) -> None:
    """Ranks other than 0 keep nothing."""
