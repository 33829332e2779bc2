"""Own queries and own loss rows against the redundant form, in which every rank computes the whole batch.

Invariant: both forms give the same loss and the same gradient of this rank's regions (checked in each run, before the
clock starts); they differ in work and bytes only. The backbone is left out: it is the same in both.
"""

from __future__ import annotations

import os
import tempfile
from datetime import timedelta
from pathlib import Path

import torch
import torch.distributed as dist
import torch.nn.functional as F
from torch import Tensor

from pipeline.benchmark.sizes import VIEWS, Size
from pipeline.benchmark.timing import Comparison, clock, from_seconds
from pipeline.distributed import gather, rank_slice, world_size
from pipeline.model.backbones.transformer import sizes
from pipeline.model.cross_image import CrossImageEncoder
from pipeline.training.loss import MultiSimilarityLoss

REGIONS = 14


class BothForms:
    """The cross-image encoder and the loss on one rank; B images in the global batch."""

    def __init__(self, size: Size, images: int, device: torch.device) -> None:
        torch.manual_seed(0)
        dim = sizes(size.model.backbone).dim
        self.encoder = CrossImageEncoder(dim, size.model.cross_image).to(device)
        self.loss = MultiSimilarityLoss()
        # views that resemble each other only a little: mining then finds pairs
        places = 0.3 * torch.randn(images // VIEWS, 1, REGIONS, dim) + torch.randn(images // VIEWS, VIEWS, REGIONS, dim)
        mine = rank_slice(images)
        self.regions = places.flatten(0, 1)[mine].to(device).requires_grad_()
        self.labels = torch.arange(images // VIEWS).repeat_interleave(VIEWS)[mine].to(device)

    def own_rows(self) -> Tensor:
        """As this project trains: own queries over gathered keys and values, own rows of the similarity matrix."""
        self.encoder.train()
        loss: Tensor = self.loss(self._descriptors(self.regions), self.labels)
        return loss

    def redundant(self) -> Tensor:
        """Gather the regions with gradient, then everything for everybody on every rank."""
        self.encoder.eval()  # dropout is 0: all that changes is that it takes the images given as the whole group
        everyone, labels = self._descriptors(gather(self.regions)), gather(self.labels)
        similarity = everyone @ everyone.T
        same = labels[:, None] == labels[None, :]
        itself = torch.eye(len(labels), dtype=torch.bool, device=labels.device)
        positive, negative = self.loss.mine(similarity.detach(), same & ~itself, ~same)
        push = self.loss.soft_sum(-self.loss.alpha * (similarity - self.loss.base), positive) / self.loss.alpha
        pull = self.loss.soft_sum(self.loss.beta * (similarity - self.loss.base), negative) / self.loss.beta
        return (push + pull).mean()

    def _descriptors(self, regions: Tensor) -> Tensor:
        return F.normalize(self.encoder(regions).flatten(1), dim=-1)

    def gradient(self, form: str) -> tuple[Tensor, Tensor]:
        """Loss and the gradient of the regions by a form."""
        self.encoder.zero_grad(set_to_none=True)
        self.regions.grad = None
        loss: Tensor = getattr(self, form)()
        loss.backward()
        assert self.regions.grad is not None
        return loss.detach(), self.regions.grad

    def seconds(self, rounds: int) -> dict[str, list[float]]:
        """Forward and backward, the ranks starting together; {form: seconds by round}."""
        (value, ours), (other, theirs) = self.gradient("own_rows"), self.gradient("redundant")
        torch.testing.assert_close(value, other, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(ours, theirs, rtol=1e-2, atol=1e-4 * ours.abs().max().item())
        found: dict[str, list[float]] = {"redundant": [], "own_rows": []}
        for number in range(rounds):
            for form in list(found)[:: -1 if number % 2 else 1]:
                if world_size() > 1:
                    dist.barrier()
                start = clock(self.regions.device)
                self.gradient(form)
                found[form].append(clock(self.regions.device) - start)
        return found


def measure(size: Size, rounds: int, images: int, worlds: tuple[int, ...] = (1, 2)) -> list[Comparison]:
    """One comparison for each number of ranks, at one global batch; gloo ranks of one thread, or GPUs if enough."""
    found = []
    for w in worlds:
        ranks = [_alone(size, rounds, images)] if w == 1 else _together(w, size, rounds, images)
        # a step is over when the last rank is done
        slowest = {form: [max(times) for times in zip(*(r[form] for r in ranks), strict=True)] for form in ranks[0]}
        named = {"every rank computes all": slowest["redundant"], "own queries, own rows": slowest["own_rows"]}
        where = "CPU, 1 thread a rank" if not _on_gpus(w) else "GPU"
        title = f"cross-image encoder and loss, {images} images, W = {w} ({where})"
        found.append(from_seconds(title, named, images))
    return found


def _alone(size: Size, rounds: int, images: int) -> dict[str, list[float]]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return BothForms(size, images, torch.device("cuda" if _on_gpus(1) else "cpu")).seconds(rounds)
    finally:
        torch.set_num_threads(threads)


def _together(w: int, size: Size, rounds: int, images: int) -> list[dict[str, list[float]]]:
    with tempfile.TemporaryDirectory() as folder:
        torch.multiprocessing.spawn(_rank, (w, folder, size, rounds, images), nprocs=w)
        return [torch.load(Path(folder) / f"{r}.pt") for r in range(w)]


def _on_gpus(w: int) -> bool:
    return torch.cuda.is_available() and torch.cuda.device_count() >= w


def _rank(r: int, w: int, folder: str, size: Size, rounds: int, images: int) -> None:
    device = torch.device("cuda", r) if _on_gpus(w) else torch.device("cpu")
    if device.type == "cuda":
        torch.cuda.set_device(device)
    torch.set_num_threads(1)
    dist.init_process_group(
        "nccl" if device.type == "cuda" else "gloo", store=dist.FileStore(f"{folder}/store", w), rank=r, world_size=w,
        timeout=timedelta(seconds=120),
    )  # fmt: skip
    torch.save(BothForms(size, images, device).seconds(rounds), Path(folder) / f"{r}.pt")
    dist.barrier()
    os._exit(0)  # gloo's threads can abort an orderly exit
