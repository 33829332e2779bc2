"""Descriptors of a set of images, computed by all processes together: `encode` once an image, `correlate` per group.

Invariant: W never changes a descriptor. Forward batches of the per-image part and groups of the cross-image encoder
are both cut from positions in the dataset, then dealt to ranks whole; a group is always one call of `correlate`, and
groups of one image are called many together (`calls_of`), cut by position too. So ranks even agree to the last bit on
like hardware, where cutting batches per rank would leave rounding differences. Where photos keep their own shapes
(`image_size: native`), a forward batch goes through shape by shape; regions have one shape, so groups hold any mixture.

The regions [R, D] of an image are computed once and kept (memory, or a file for large sets) by the ranks whose
groups need them, so that all groupings cost one pass of the backbone. Sharded engines (FSDP2, ZeRO-3) need every
rank to call the model equally often: a rank without work passes zeros and drops the result. (Not so with `native`,
which no training, so no sharded engine, has.)
"""

from __future__ import annotations

import contextlib
import json
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pipeline import distributed
from pipeline.common.errors import told
from pipeline.common.files import replacing, reserve, unnamed_file
from pipeline.common.progress import Progress
from pipeline.config import EvaluationConfig
from pipeline.config.image_size import ImageSize, input_size
from pipeline.data import workers
from pipeline.data.images import load_image, normalise, to_input
from pipeline.evaluation.describe.broken import broken_photos
from pipeline.evaluation.protocol import Protocol, Side
from pipeline.model.cross_image import Memory

ALONE = 64  # images correlated in one call where each is a group of its own
BLOCK_BYTES = 64 * 2**20  # descriptors handed over at once: the memory of a gather, and the size of a stored part
REGIONS_IN_MEMORY = 4 * 2**30  # bytes of regions a rank keeps in memory before it turns to a file
TOLD = 5_000  # images from which the second step, quick beside the backbone, has a progress line of its own
Block = list[np.ndarray]
"""Consecutive groups that are computed, gathered and stored together."""
Parts = list[tuple[list[int], Tensor]]
"""Images of a forward batch by their shape: which rows of the batch, and these images [n, 3, H, W]."""


def blocks_of(groups: Sequence[np.ndarray], dim: int, limit: int = BLOCK_BYTES) -> list[Block]:
    """Cuts groups into blocks of about `limit` bytes of float32 descriptors, whatever W is; at least a group each."""
    blocks: list[Block] = []
    rows = 0
    for group in groups:
        if not blocks or (rows + len(group)) * dim * 4 > limit:
            blocks.append([])
            rows = 0
        blocks[-1].append(group)
        rows += len(group)
    return blocks


def calls_of(protocol: Protocol, images: int, side: Side, model: Any) -> tuple[list[np.ndarray], bool]:
    """(What is correlated in a call, whether its images are groups of one each): the groups, one a call; but of groups
    of one image `ALONE` together, where the model can. Cut by position, so the number of processes changes nothing.
    Images beside a bank are in no group: `ALONE` are handed over together."""
    if protocol.groups == "bank":
        return protocol.form(images, side, ALONE), False
    if protocol.group_size > 1 or not getattr(model, "correlates_alone", False):
        return protocol.form(images, side), False
    return protocol.form(images, side, ALONE), True


def by_shape(images: Iterable[Tensor]) -> Parts:
    """Images [3, H, W] of a forward batch, those of one shape together."""
    shapes: dict[torch.Size, tuple[list[int], list[Tensor]]] = {}
    for row, image in enumerate(images):
        rows, alike = shapes.setdefault(image.shape, ([], []))
        rows.append(row)
        alike.append(image)
    return [(rows, torch.stack(alike)) for rows, alike in shapes.values()]


class _Batches(torch.utils.data.Dataset[tuple[Parts, list[int]]]):
    """The forward batches of one rank, decoded: item i is (its images, []) or ([], positions of broken ones)."""

    def __init__(
        self, paths: Sequence[Path], batches: list[np.ndarray], size: int | str | ImageSize, resize: Any
    ) -> None:
        self.paths, self.batches, self.size, self.resize = paths, batches, size, resize

    def __len__(self) -> int:
        return len(self.batches)

    def __getitem__(self, index: int) -> tuple[Parts, list[int]]:
        images, broken = [], []
        for position in self.batches[index].tolist():
            try:
                images.append(to_input(load_image(self.paths[position]), self.size, self.resize))
            except Exception as error:
                if told(error) is None:
                    raise
                broken.append(position)
        if broken:
            return [], broken
        parts = by_shape(images)
        workers.hand_over(*(alike for _, alike in parts))
        return parts, []


@dataclass
class Regions:
    """The regional features of the positions that this rank's groups need.

    `positions` [n] sorted, `values` [n, R, D]; in memory, or a memory-mapped file of `_allocate`.
    """

    positions: np.ndarray
    values: np.ndarray

    def put(self, positions: np.ndarray, regions: np.ndarray) -> None:
        """Keeps those of the given rows that are wanted here."""
        if len(self.positions):
            slots = np.minimum(np.searchsorted(self.positions, positions), len(self.positions) - 1)
            wanted = self.positions[slots] == positions
            self.values[slots[wanted]] = regions[wanted]

    def take(self, positions: np.ndarray) -> Tensor:
        """Regions [n, R, D] of positions that were put before."""
        return torch.from_numpy(np.ascontiguousarray(self.values[np.searchsorted(self.positions, positions)]))


@contextlib.contextmanager
def evaluating(model: nn.Module) -> Iterator[None]:
    """Eval mode without gradients; the mode of before afterwards."""
    training = model.training
    model.eval()
    try:
        with torch.no_grad():
            yield
    finally:
        model.train(training)


def encode(
    model: nn.Module,
    paths: Sequence[Path],
    wanted: Sequence[Sequence[Block]],
    config: EvaluationConfig,
    device: torch.device,
    label: str = "encoding",
    scratch: Path | None = None,
    key: str = "",
    progress: bool = True,
    beyond: Sequence[Path] = (),
    fixed: bool = False,
) -> Regions:
    """Runs the per-image part over `paths`, each once. Collective.

    Args:
        model: has `encode(images [b, 3, H, W]) -> [b, R, D]`, `regions`, `descriptor_dim` and `image_size`.
        wanted: for each grouping, the blocks that will be correlated; a rank keeps what its groups in them need.
        scratch: folder for the regions of sets too large for memory; None: they lie in a file without a name.
        key: digest of what the regions depend on (`Identity`); a file in `scratch` left by a killed run with the same
            key and batch is continued: its progress is counted in batches.
        beyond: photos that will be described next; where one of `paths` is broken, these are looked through too.
        fixed: fill every call up to `config.batch` images, so that none rounds otherwise.

    Raises:
        DataError: images that cannot be read, all of them (`broken_photos`), on all ranks alike.
    """
    w, r = distributed.world_size(), distributed.rank()
    mine = [block[j] for blocks in wanted for block in blocks for j in range(r, len(block), w)]
    positions = np.unique(np.concatenate(mine)) if mine else np.empty(0, np.int64)
    shape = (len(positions), *region_shape(model))
    dtype = _dtype(model)
    own_key = f"{key} batches of {config.batch}, {r}/{w} {zlib.crc32(positions.tobytes())}"
    values, resume = distributed.agreed(partial(_allocate, shape, dtype, scratch, own_key), what=label)
    regions = Regions(positions, values)

    batches = [np.arange(s, min(s + config.batch, len(paths))) for s in range(0, len(paths), config.batch)]
    steps = -(-len(batches) // w)
    first = min(distributed.gather_uneven(torch.tensor([resume.done], device=device)).tolist())
    own = [batches[step * w + r] for step in range(first, steps) if step * w + r < len(batches)]
    size = input_size(model)
    loader = _loader(_Batches(paths, own, size, config.resize), config.workers)
    total = sum(len(batch) for batch in batches[first * w :])
    problem: BaseException | None = None
    broken: list[int] = []
    with Progress(label, total, "images", enabled=progress and r == 0) as bar:
        for step in range(first, steps):
            dealt = batches[step * w : (step + 1) * w]
            parts: Parts = [([0], torch.zeros(1, 3, *size.of_photo(1, 1)))]
            if r < len(dealt) and problem is None:
                parts, broken, problem = _next(loader)
            if distributed.agree(problem, notice=len(broken), what=label):
                break
            encoded = encode_parts(model, parts, config, device, config.batch if fixed else 0)
            gathered = distributed.gather_uneven(encoded[: len(dealt[r]) if r < len(dealt) else 0])
            try:
                regions.put(np.concatenate(dealt), gathered.cpu().numpy())
                resume.advance(step + 1, values, final=step + 1 == steps)
            except OSError as error:  # told to the other ranks before the next forward pass
                problem = error
            bar.advance(sum(len(batch) for batch in dealt))
    if distributed.agree(problem, notice=len(broken), what=label):
        rest = np.arange(r, len(beyond), w)
        last = _loader(
            _Batches(beyond, [rest[i : i + 1] for i in range(len(rest))], size, config.resize), config.workers
        )
        found = distributed.agreed(partial(_broken, label, broken, loader, iter(last), len(paths), r == 0), what=label)
        everyones = distributed.gather_uneven(torch.tensor(found, dtype=torch.int64, device=device))
        raise broken_photos([*paths, *beyond], everyones.tolist(), label)
    return regions


def _broken(
    label: str, known: list[int], loader: Iterator[Any], beyond: Iterator[Any], paths: int, progress: bool
) -> list[int]:
    """Positions of this rank's broken photos: those `known`, and those among what the loaders still hold."""
    found = list(known)
    with Progress(f"{label}: looking for other broken photos", None, "batches", enabled=progress) as bar:
        for first, each in ((0, loader), (paths, beyond)):
            for _, broken in each:
                found += [first + position for position in broken]
                bar.advance()
    return found


def _next(loader: Iterator[tuple[Parts, list[int]]]) -> tuple[Parts, list[int], BaseException | None]:
    """The next batch, which of its images are broken, or what else is wrong with it."""
    try:
        return *next(loader), None
    except Exception as error:
        return [], [], error


def describe_alone(
    model: nn.Module,
    photo: Path | bytes,
    resize: Any,
    precision: Any,
    device: torch.device,
    memory: Memory | None = None,
) -> np.ndarray:
    """The descriptor [1, dim] of one photo (a file, or its bytes), in a forward pass of its own.

    So other photos cannot even change its rounding. `memory`: of a bank (`PlaceModel.remember`), beside which it is
    described; None: in a group of its own. For a model in `evaluating`. Raises `DataError` naming a broken photo.
    """
    images = to_input(load_image(photo), input_size(model), resize)[None]
    regions = encode_parts(model, [([0], images)], EvaluationConfig(precision=precision), device)
    whole: Any = model
    described: Tensor = whole.correlate(regions) if memory is None else whole.correlate_beside(regions, memory)
    numbers: np.ndarray = described.float().cpu().numpy()
    return numbers


def describe_each(
    model: nn.Module,
    paths: Sequence[Path],
    config: EvaluationConfig,
    device: torch.device,
    label: str = "describing",
    progress: bool = True,
    memory: Memory | None = None,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(positions [n], descriptors [n, dim]) of images, a forward batch at a time; each is a group of its own, or beside
    the bank of `memory`.

    For a model in `evaluating`, on one process; nothing is kept. With `config.batch` 1 each is what `describe_alone`
    gives, to the last bit. Raises `DataError` naming the broken images, after what came before the first was given.
    """
    size, together = input_size(model), getattr(model, "correlates_alone", False)
    batches = [np.arange(s, min(s + config.batch, len(paths))) for s in range(0, len(paths), config.batch)]
    loader = _loader(_Batches(paths, batches, size, config.resize), config.workers)
    with Progress(label, len(paths), "images", enabled=progress) as bar:
        left = iter(loader)
        for batch in batches:
            parts, broken = next(left)
            if broken:
                found = _broken(label, broken, left, iter(()), len(paths), progress)
                raise broken_photos(paths, found, label)
            regions = encode_parts(model, parts, config, device)
            if memory is not None:
                described = model.correlate_beside(regions, memory)  # type: ignore[operator]
            elif together and len(batch) > 1:
                described = model.correlate(regions, alone=True)  # type: ignore[operator]
            else:
                described = torch.cat([model.correlate(one[None]) for one in regions])  # type: ignore[operator]
            yield batch, described.float().cpu().numpy()
            bar.advance(len(batch))


def correlate(
    model: nn.Module,
    regions: Regions,
    blocks: Sequence[Block],
    keep: Callable[[int, np.ndarray, np.ndarray], None],
    device: torch.device,
    done: frozenset[int] = frozenset(),
    label: str = "correlating",
    progress: bool = True,
    alone: bool = False,
    memory: Memory | None = None,
) -> None:
    """Runs the cross-image encoder over groups. Collective.

    Args:
        model: has `correlate(regions [n, R, D]) -> descriptors [n, dim]`, of one group.
        keep: called on rank 0 alone with (number of the block, positions [n], descriptors [n, dim]).
        done: numbers of blocks that are stored already; the same on all ranks.
        alone: the blocks' "groups" are calls of many groups of one image each (`calls_of`).
        memory: of a bank (`PlaceModel.remember`), beside which each image is described instead of in a group.
    """
    w, r = distributed.world_size(), distributed.rank()
    todo = [number for number in range(len(blocks)) if number not in done]
    total = sum(len(group) for number in todo for group in blocks[number])
    shape = regions.values.shape[1:]
    whole: Any = model
    describe: Callable[[Tensor], Tensor] = partial(whole.correlate, alone=True) if alone else whole.correlate
    if memory is not None:
        describe = partial(whole.correlate_beside, memory=memory)
    with Progress(label, total, "images", enabled=progress and r == 0 and total >= TOLD) as bar:
        for number in todo:
            block = blocks[number]
            own: list[Tensor] = []
            for call in range(-(-len(block) // w)):
                j = call * w + r
                group = regions.take(block[j]) if j < len(block) else _zeros(shape, regions.values.dtype)
                described = describe(group.to(device))
                own.append(described if j < len(block) else described[:0])
            gathered = distributed.gather_uneven(torch.cat(own))
            order = np.concatenate([block[j] for rank in range(w) for j in range(rank, len(block), w)])
            distributed.on_rank_0(partial(keep, number, order, gathered.cpu().numpy()), what=label)
            bar.advance(sum(len(group) for group in block))


def encode_parts(
    model: Any, parts: Parts, config: EvaluationConfig, device: torch.device, filled: int = 0, dtype: Any = None
) -> Tensor:
    """Regions [n, R, D] of a forward batch in the order of its rows.

    `filled`: each call is filled with zeros to so many images; `dtype`: of the regions, none: float32, or float64 for a
    model in it.
    """
    found = []
    for rows, images in parts:
        whole = F.pad(images, (0, 0, 0, 0, 0, 0, 0, filled - len(images))) if filled else images
        found.append(encode_batch(model.encode, whole, config, device, dtype or _dtype(model))[: len(rows)])
    if len(found) == 1:
        return found[0]
    order = torch.tensor([row for rows, _ in parts for row in rows], device=found[0].device)
    return torch.cat(found)[order.argsort()]


def encode_batch(
    encode: Callable[[Tensor], Tensor], images: Tensor, config: EvaluationConfig, device: torch.device, dtype: Any
) -> Tensor:
    """Normalised on the device where the loader left bytes; regions in the type they are kept in."""
    images = images.to(device, non_blocking=True)
    images = normalise(images, dtype=dtype) if images.dtype == torch.uint8 else images.to(dtype)
    if config.precision == "fp32":
        return encode(images).to(dtype)
    half = torch.bfloat16 if config.precision == "bf16" else torch.float16
    with torch.autocast(device.type, dtype=half):
        return encode(images).to(dtype)


def region_shape(model: Any) -> tuple[int, int]:
    """(R, D) of a model's regions."""
    return int(model.regions), int(model.descriptor_dim) // int(model.regions)


def _dtype(model: nn.Module) -> torch.dtype:
    """float32, or float64 for a model in float64 (tests of exactness)."""
    parameter = next(model.parameters(), None)
    return torch.float64 if parameter is not None and parameter.dtype == torch.float64 else torch.float32


def _zeros(shape: tuple[int, ...], dtype: Any) -> Tensor:
    return torch.from_numpy(np.zeros((1, *shape), dtype))


def _loader(dataset: _Batches, processes: int) -> Iterator[tuple[Parts, list[int]]]:
    """Whole batches in order. Its own generator: a validation must not advance the training's random state."""
    processes = min(processes, len(dataset)) if len(dataset) > 1 else 0
    options = workers.options(processes, prefetch=2)
    return workers.batches(
        torch.utils.data.DataLoader(dataset, batch_size=None, generator=torch.Generator(), **options)
    )


class _Resume:
    """How many steps of a scratch file are complete; nothing for regions in memory."""

    def __init__(self, file: Path | None, key: str) -> None:
        self.file, self.key, self.done = file, key, 0
        if file is not None and file.is_file():
            left = json.loads(file.read_text())
            self.done = int(left["done"]) if left["key"] == key else 0

    def advance(self, done: int, values: np.ndarray, final: bool) -> None:
        self.done = done
        if self.file is not None and isinstance(values, np.memmap) and (final or done % 64 == 0):
            values.flush()
            with replacing(self.file) as fresh:
                fresh.write_text(json.dumps({"key": self.key, "done": done}))


def _allocate(shape: tuple[int, ...], dtype: torch.dtype, scratch: Path | None, key: str) -> tuple[np.ndarray, _Resume]:
    """Room for regions: memory, or a file for what exceeds `REGIONS_IN_MEMORY`; one in `scratch` is continued where its
    key agrees."""
    kind = np.float64 if dtype == torch.float64 else np.float32
    size = int(np.prod(shape)) * np.dtype(kind).itemsize
    if size <= REGIONS_IN_MEMORY:
        return np.empty(shape, kind), _Resume(None, key)
    if scratch is None:
        with unnamed_file(size) as unnamed:
            return np.memmap(unnamed, kind, mode="r+", shape=shape), _Resume(None, key)
    scratch.mkdir(parents=True, exist_ok=True)
    file = scratch / f"regions.{distributed.rank()}.bin"
    resume = _Resume(file.with_suffix(".json"), f"{key} {shape} {np.dtype(kind)}")
    if not file.is_file() or file.stat().st_size != size:
        resume.done = 0
    if not resume.done:
        reserve(file, size)
    return np.memmap(file, kind, mode="r+", shape=shape), resume
