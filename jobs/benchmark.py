"""What the parts of the system cost on this machine.

    python -m jobs.benchmark step                     the training step and inference, at the demo's size
    python -m jobs.benchmark step --size vitb --full  the paper's model, more rounds, torch.compile
    python -m jobs.benchmark cost --config jobs/configs/cricavpr.yaml

Alternatives are timed in turn within one run, because machines differ and are busy. No data or weights are needed: the
inputs are generated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from jobs.cli import parse_part, run_job
from pipeline.common.errors import UsageError
from pipeline.config import RunConfig, SearchKind, TrainConfig

if TYPE_CHECKING:
    import torch

Name = Literal["demo", "vitb", "tiny"]
Device = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True)
class Step:
    """Times of the training step and of inference: precisions, chunks, the parts of a step."""

    size: Name = "demo"
    """Model and images: the demo's (112 px), the paper's (ViT-B/14, 224 px), or one that only shows that it runs."""
    full: bool = False
    """More rounds and images, and torch.compile; minutes instead of one."""
    device: Device = "auto"
    """Where steps are computed; auto takes a GPU where there is one."""


@dataclass(frozen=True)
class Published:
    """Speed of the training step and of inference over the published code's, restated plainly; float32, same batch."""

    size: Name = "vitb"
    """Model and images, as in `step`."""
    full: bool = False
    """More rounds."""
    device: Device = "auto"
    """Where steps are computed; auto takes a GPU where there is one."""


@dataclass(frozen=True)
class Memory:
    """Bytes of a training step against the number of images, with and without chunks."""

    size: Name = "demo"
    """Model and images, as in `step`."""
    limit_gb: float = 6.0
    """Steps with a counted peak below this (in 10^9 bytes) are also run on the CPU, each in its own process."""


@dataclass(frozen=True)
class Precision:
    """Errors of float32, bf16 and fp16 against float64, in descriptors, loss and gradients."""

    size: Name = "demo"
    """Model and images, as in `step`."""
    device: Device = "auto"
    """Where it is computed; auto takes a GPU where there is one."""


@dataclass(frozen=True)
class Data:
    """Times of reading images: decoding, augmentation, shards against plain files, the loader's workers."""

    size: Name = "demo"
    """Model whose image size is used."""
    full: bool = False
    """More rounds and images."""


@dataclass(frozen=True)
class Ranks:
    """Times of attention and loss over several ranks: own queries and rows against everything on every rank."""

    size: Name = "demo"
    """Model, as in `step`."""
    full: bool = False
    """More rounds and images."""


@dataclass(frozen=True)
class Engines:
    """Differences of every engine (DDP, FSDP2, ZeRO) from one process in float64, gradients and weights.

    Launches each engine for three SGD steps of a small model and prints the largest relative difference of any
    tensor's averaged gradient, and of the weights after the steps. On CPU or GPUs, whichever `accelerate launch` finds;
    minutes on two cores.
    """

    engines: tuple[str, ...] = ("ddp", "fsdp2", "zero1", "zero2", "zero3")
    """Engines: names of files in jobs/accelerate."""
    processes: int = 2
    """Ranks of each launch."""
    trainable: Literal["adapters", "full", "frozen", "last"] = "full"
    """What of the backbone is trained."""
    encode_chunk: int | None = None
    """Images encoded at a time, as train.encode_chunk; none: all at once."""
    passes: Literal["group", "joint"] = "group"
    """How often an image is described, as train.passes."""


@dataclass(frozen=True)
class Cost(RunConfig):
    """Bytes and operations of a step on one rank as the number of ranks W grows, modelled for any config.

    Prints a table for W = 1 ... 64 at a fixed number of places a rank (the global batch grows with W): bytes received
    in each part of the step, gathered keys and values kept, operations of the forward pass; then what each engine adds
    for parameters and gradients. A test counts the modelled bytes on real ranks. Needs no weights file.
    """

    places_per_rank: int = 72
    """Places on each rank; four images each."""
    worlds: tuple[int, ...] = (1, 2, 4, 8, 16, 32, 64)
    """Numbers of ranks."""
    bf16: bool = False
    """Under bf16 autocast: keys and values travel in two bytes."""


@dataclass(frozen=True)
class Search:
    """Recall against exact, bytes and seconds of approximate search, or of PCA where `pca` is given.

        python -m jobs.benchmark search                          100,000 x 256, made of clusters
        python -m jobs.benchmark search --store outputs/RUN/evaluation/descriptors/SET/single
        python -m jobs.benchmark search --pca 4096 --rows 16384 --dim 10752    PCA instead

    Each measurement runs in a process of its own, so that its peak memory is its own.
    """

    rows: int = 100_000
    """Database descriptors."""
    dim: int = 256
    """Dimensions of a descriptor."""
    queries: int = 1_000
    """Queries; with --store all stored queries."""
    recalls: tuple[int, ...] = (1, 10)
    """Nearest neighbours N: the result is the percentage of the exact N that were also found."""
    kinds: tuple[SearchKind, ...] = ("exact", "int8", "binary", "hnsw", "ivfpq")
    """Kinds of search to measure."""
    refine: int = 0
    """int8, binary, ivfpq: candidates that float descriptors order anew; 0: none."""
    store: str | None = None
    """A folder of stored descriptors (it holds database/ and queries/) instead of made ones."""
    pca: int | None = None
    """Measure PCA to so many dimensions instead of search."""
    sklearn: bool = False
    """Measure scikit-learn's PCA beside ours."""
    timeout: float = 600.0
    """Seconds after which one measurement is stopped; a line says so."""
    seed: int = 0
    """Seed of the made descriptors."""


@dataclass(frozen=True)
class Store:
    """Peak memory and seconds of a descriptor store at size: writing, reading, search, PCA and recalls from it.

        python -m jobs.benchmark store                           64 and 1,344 dimensions, each at N and at 4 N rows
        python -m jobs.benchmark store --sizes 20000x10752,80000x10752 --dims 4096 --folder /large/disk

    Made descriptors, in a store as an evaluation writes it. Every step runs in a process of its own. What does not grow
    from N to 4 N rows does not depend on them.
    """

    sizes: tuple[str, ...] = ("500000x64", "2000000x64", "60000x1344", "240000x1344")
    """Rows x dimensions of the database."""
    queries: int = 64
    """Queries, each another view of a known row."""
    stored: Literal["fp32", "fp16"] = "fp16"
    """Type of the stored descriptors."""
    dims: int = 32
    """Dimensions that PCA keeps."""
    recall: int = 10
    """Neighbours searched."""
    folder: str | None = None
    """Folder in which the store is written, and removed at the end; none: the temporary folder."""
    timeout: float = 1800.0
    """Seconds after which a step is stopped; a line says so."""


@dataclass(frozen=True)
class Mine:
    """Seconds of neighbours and plan of `data.order: mined`, and how the groups come out; on made descriptors.

    python -m jobs.benchmark mine                                          57,462 made places
    python -m jobs.benchmark mine --frames data/gsv-cities/Dataframes      GSV-Cities' places and positions
    """

    frames: str | None = None
    """Folder of GSV-Cities' `<City>.csv` or `.csv.gz`; its images are not needed."""
    places: int = 57_462
    """Number of made places, without `frames`."""
    dim: int = 256
    """Dimensions of a descriptor."""
    places_per_batch: int = 72
    """Places of a batch."""
    clique: int = 6
    """As data.clique."""
    mine_neighbours: int = 64
    """As data.mine_neighbours."""
    mine_radius: float = 25.0
    """As data.mine_radius; pairs closer than this in one batch are counted."""
    mine_temperature: float = 0.05
    """As data.mine_temperature."""
    seed: int = 0
    """Seed of the made descriptors and of the plan."""


def main() -> None:
    """Parses, measures, prints."""
    part, job = parse_part({name: kind for name, (kind, _) in PARTS.items()}, __doc__ or "")
    try:
        PARTS[part][1](job)
    except ModuleNotFoundError as error:
        raise UsageError(f"{part} needs {error.name}, which is not installed here") from error


def step(job: Step) -> None:
    """Prints the machine, then the comparisons."""
    from pipeline.benchmark import step, timing
    from pipeline.benchmark.sizes import SIZES

    size, device = SIZES[job.size], _device(job.device)
    images = (size.images_gpu if device.type == "cuda" else size.images) * (2 if job.full else 1)
    print(timing.show(step.measure(size, device, _rounds(job.full), images, job.full)))


def published(job: Published) -> None:
    """Prints the machine, then the comparisons."""
    from pipeline.benchmark import published, timing
    from pipeline.benchmark.sizes import SIZES

    size, device = SIZES[job.size], _device(job.device)
    images = size.images_gpu if device.type == "cuda" else size.images
    print(timing.show(published.measure(size, device, _rounds(job.full), images)))


def memory(job: Memory) -> None:
    """Prints the machine, then the table."""
    from pipeline.benchmark import memory

    _device("cpu")
    print(memory.measure(job.size, job.limit_gb * 1e9))


def precision(job: Precision) -> None:
    """Prints the machine, then the table."""
    from pipeline.benchmark import precision
    from pipeline.benchmark.sizes import SIZES

    size, device = SIZES[job.size], _device(job.device)
    images = min(size.images_gpu if device.type == "cuda" else size.images, 32)
    print(precision.show(precision.compare(size, images, device)))


def data(job: Data) -> None:
    """Prints the machine, then the comparisons."""
    from pipeline.benchmark import data, timing
    from pipeline.benchmark.sizes import SIZES

    _device("cpu")
    print(timing.show(data.measure(_rounds(job.full), 64 if job.full else 24, SIZES[job.size].image_size)))


def ranks(job: Ranks) -> None:
    """Prints the machine, then the comparisons."""
    from pipeline.benchmark import ranks, timing
    from pipeline.benchmark.sizes import SIZES

    _device("auto")
    print(timing.show(ranks.measure(SIZES[job.size], _rounds(job.full), 288 if job.full else 64)))


def engines(job: Engines) -> None:
    """Prints a line an engine."""
    from pipeline.benchmark import engines

    configs = Path(__file__).parent / "accelerate"
    config = TrainConfig(encode_chunk=job.encode_chunk, passes=job.passes)
    for line in engines.differences(configs, job.engines, job.processes, job.trainable, config):
        print(line, flush=True)


def cost(job: Cost) -> None:
    """Prints both tables."""
    from pipeline.benchmark import cost

    key_bytes, passes = 2 if job.bf16 else 4, 2 if job.train.passes == "joint" else 1
    parts, engines = cost.tables(job.model, job.data.image_size, job.places_per_rank, job.worlds, key_bytes, passes)
    parts.print()
    print("\nMB received for parameters and gradients, float32:\n")
    engines.print()


def search(job: Search) -> None:
    """Prints a line a measurement."""
    from pipeline.benchmark import search

    if job.pca:
        lines = search.projections(job.rows, job.dim, job.pca, job.sklearn, job.timeout, job.seed)
    else:
        lines = search.searches(
            job.store, job.rows, job.dim, job.queries, job.kinds, job.refine, job.recalls, job.timeout, job.seed
        )
    for line in lines:
        print(line, flush=True)


def store(job: Store) -> None:
    """Prints a line a step."""
    from pipeline.benchmark import store

    sizes = [store.parse_size(text) for text in job.sizes]
    for line in store.measure(sizes, job.queries, job.stored, job.dims, job.recall, job.folder, job.timeout):
        print(line, flush=True)


def mine(job: Mine) -> None:
    """Prints the machine, then a line a figure."""
    from pipeline.benchmark import mining
    from pipeline.data.cliques import CliqueRule

    _device("cpu")
    rule = CliqueRule(job.clique, job.mine_neighbours, job.mine_radius, job.mine_temperature)
    for line in mining.measure(job.frames, job.places, job.dim, job.places_per_batch, rule, job.mine_radius, job.seed):
        print(line, flush=True)


PARTS: dict[str, tuple[type, Callable[[Any], None]]] = {
    "step": (Step, step),
    "published": (Published, published),
    "memory": (Memory, memory),
    "precision": (Precision, precision),
    "data": (Data, data),
    "ranks": (Ranks, ranks),
    "engines": (Engines, engines),
    "cost": (Cost, cost),
    "search": (Search, search),
    "store": (Store, store),
    "mine": (Mine, mine),
}


def _rounds(full: bool) -> int:
    return 9 if full else 3


def _device(wanted: Device) -> torch.device:
    """Where to compute; prints what the figures were measured on. Raises `UsageError`."""
    import torch

    from pipeline.benchmark import timing

    if wanted == "cuda" and not torch.cuda.is_available():
        raise UsageError("--device cuda: there is no GPU that torch can use here; leave --device out")
    device = torch.device("cuda" if torch.cuda.is_available() and wanted != "cpu" else "cpu")
    print(timing.machine(device), flush=True)
    return device


if __name__ == "__main__":
    run_job(main)
