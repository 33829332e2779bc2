"""From bytes to batches: decoding and augmenting on one core, shards against plain files, the loader's workers.

Invariant: the code that is timed is the training's own, on photos drawn here (400 x 300, as in GSV-Cities) and a shard
set written from them; files were just written, so the page cache holds them and no disk is measured.
"""

from __future__ import annotations

import io
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from pipeline.benchmark.timing import Comparison, compare, from_seconds
from pipeline.common.cores import available_cores
from pipeline.config import DataConfig
from pipeline.data.augment import Augment, Draws, training_view
from pipeline.data.images import decode, shrink
from pipeline.data.places import Places, build_loader, members
from shards.index import ShardIndex, read_index
from shards.sources.registry import read_source
from shards.writer import WriteRule, write_shards

VIEWS, PLACES_A_BATCH = 4, 4
CPU = torch.device("cpu")


def photo(place: int, view: int) -> bytes:
    """A JPEG of 400 x 300 with a photo's size in bytes (about 40 kB): smooth shapes under fine noise."""
    random = np.random.default_rng([place, view])
    shapes = np.random.default_rng(place).integers(0, 255, (6, 8, 3), dtype=np.uint8)
    picture = np.asarray(Image.fromarray(shapes).resize((400, 300), Image.Resampling.BICUBIC), np.float32)
    noisy = np.clip(picture + random.normal(0, 12, picture.shape), 0, 255).astype(np.uint8)
    stream = io.BytesIO()
    Image.fromarray(noisy).save(stream, "JPEG", quality=85)
    return stream.getvalue()


def measure(rounds: int, places: int, size: int, workers: tuple[int, ...] = (0, 1, 2)) -> list[Comparison]:
    """All comparisons of the reading.

    Args:
        rounds: how often each is timed.
        places: drawn, four photos each.
        size: side of the training image in pixels.
        workers: of the loader.
    """
    with tempfile.TemporaryDirectory() as folder, _one_thread():
        root = Path(folder)
        files, index = prepare(root, places)
        found = [decoding([path.read_bytes() for path in files[:32]], rounds, size), storage(files, index, rounds)]
        data = DataConfig(shards=index.root, places_per_batch=PLACES_A_BATCH, image_size=size, cache=str(root / "c"))
        return [*found, loading(index, data, rounds, workers)]


def prepare(root: Path, places: int) -> tuple[list[Path], ShardIndex]:
    """Photos as plain files, and the shard set of them."""
    for place in range(places):
        (root / "photos" / f"place{place:04d}").mkdir(parents=True)
        for view in range(VIEWS):
            (root / "photos" / f"place{place:04d}" / f"{view}.jpg").write_bytes(photo(place, view))
    write_shards(read_source(root / "photos"), root / "shards", WriteRule(rounds=1, workers=1))
    return sorted((root / "photos").rglob("*.jpg")), read_index(str(root / "shards"))


def decoding(photos: list[bytes], rounds: int, size: int) -> Comparison:
    """One core: decode, decode and resize, and the augmentations on top."""

    def augmented(kind: Augment) -> Callable[[], None]:
        def run() -> None:
            for number, data in enumerate(photos):
                training_view(decode(data), (size, size), kind, 3, 9, Draws(number))

        return run

    ways: dict[str, Callable[[], object]] = {
        "decode and resize": lambda: [shrink(decode(data), (size, size)) for data in photos],
        "decode alone": lambda: [decode(data) for data in photos],
        "with light augmentation": augmented("light"),
        "with RandAugment (3, 9)": augmented("rand"),
    }
    return compare(f"a photo of 400 x 300 to {size} x {size}, one core", ways, len(photos), rounds, CPU)


def storage(files: list[Path], index: ShardIndex, rounds: int) -> Comparison:
    """The bytes of all photos: a file each, or by offset out of shards."""
    from pipeline.data.cache import ShardCache

    rows = np.arange(index.table.num_rows)
    cache = ShardCache(index, Path("unused"), 1 << 30)
    dataset = Places(members(index, rows), cache, DataConfig(), 0, 0)
    ways: dict[str, Callable[[], object]] = {
        "plain files": lambda: [path.read_bytes() for path in files],
        "shards, by offset": lambda: [dataset.encoded(position) for position in range(len(dataset))],
    }
    found = compare("bytes of an image, out of the page cache", ways, len(files), rounds, CPU)
    dataset.close()
    return found


def loading(index: ShardIndex, data: DataConfig, rounds: int, workers: tuple[int, ...]) -> Comparison:
    """Batches with RandAugment; the clock starts at the first batch, when the workers are up."""
    seconds: dict[str, list[float]] = {f"{n} workers": [] for n in workers}
    images = 0
    for epoch in range(rounds):
        for n in workers[:: -1 if epoch % 2 else 1]:
            batches: Iterator[Any] = iter(build_loader(index, replace(data, workers=n), 0, epoch, 0, 0, 1))
            next(batches)
            start = time.perf_counter()
            images = sum(len(batch.images) for batch in batches)
            seconds[f"{n} workers"].append(time.perf_counter() - start)
    cores = available_cores()
    return from_seconds(f"the loader, RandAugment, {cores} cores", seconds, images)


@contextmanager
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
