"""PCA of descriptors, fitted once on a stated sample, kept beside the checkpoint, applied wherever it is asked for.

Invariant: a projection knows what it was fitted on, and is the exact PCA of those rows (not a randomised one), with
signs fixed, so that the same rows give the same descriptors anywhere. As published, projected descriptors are neither
whitened (an option) nor normalised again.

The sample may have more rows than memory holds: the covariance [D, D] is accumulated over blocks, in float64 up to
`DOUBLE` dimensions, above that as float32 products of centred blocks (10,752 dimensions: 0.46 GB, and 2.5 GB in
`eigh`, whose time grows with D cubed and not with the rows). With fewer rows than dimensions the Gram matrix
[rows, rows] holds the same spectrum and is smaller.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pipeline.common.errors import DataError, UsageError
from pipeline.common.files import replacing
from pipeline.evaluation.search.cores import all_cores
from pipeline.evaluation.search.exact import Blocks

SAMPLE = 16_384  # rows at most that PCA is fitted on (published: the same)
PIECE = 2**21  # numbers projected at once
DOUBLE = 1_024  # dimensions up to which the arithmetic is float64


@dataclass(frozen=True)
class Projection:
    """x -> (x - mean) components^T, divided by the standard deviations where `whiten`."""

    mean: Tensor
    """[D] float32"""
    components: Tensor
    """[k, D] float32, orthonormal rows by falling variance; the largest entry of each is positive."""
    variances: Tensor
    """[k] float32, of the sample along each component (n - 1 in the denominator)."""
    explained: float
    """Share of the sample's variance that the k components hold, 0 ... 1."""
    rows: int
    """Rows it was fitted on."""
    whiten: bool
    source: str
    """What those rows were: set, number, protocol."""

    def __call__(self, descriptors: np.ndarray) -> np.ndarray:
        """[n, D] -> [n, k] float32, some rows at a time."""
        out = np.empty((len(descriptors), len(self.components)), np.float32)
        rows = max(1, PIECE // len(self.mean))
        for first in range(0, len(out), rows):
            # array copies a read-only memory map's block, which torch would warn about
            centred = torch.from_numpy(np.array(descriptors[first : first + rows], np.float32)).sub_(self.mean)
            projected = centred @ self.components.T
            out[first : first + rows] = projected / self.variances.sqrt() if self.whiten else projected
        return out

    def save(self, path: Path) -> None:
        """Writes a safetensors file, whole or not at all."""
        from safetensors.torch import save_file

        about = {"explained": self.explained, "rows": self.rows, "whiten": self.whiten, "source": self.source}
        tensors = {"mean": self.mean, "components": self.components.contiguous(), "variances": self.variances}
        with replacing(path) as fresh:
            save_file(tensors, str(fresh), metadata={"projection": json.dumps(about)})


def load_projection(path: Path) -> Projection:
    """Reads a file of `Projection.save`. Raises `DataError` for one that is none."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), "pt") as file:
            tensors = {name: file.get_tensor(name) for name in ("mean", "components", "variances")}
            about = json.loads(file.metadata()["projection"])
    except (OSError, SafetensorError, KeyError, TypeError) as error:
        raise DataError(f"{path}: not a saved PCA ({error}); delete it to have it fitted again") from None
    return Projection(**tensors, **about)


def sample_rows(rows: int, limit: int = SAMPLE, seed: int = 0) -> np.ndarray:
    """At most `limit` of `rows` row numbers, seeded, ascending; all of them where they are few enough."""
    if rows <= limit:
        return np.arange(rows, dtype=np.int64)
    bits = np.random.Philox(key=[seed, rows]).random_raw(rows)  # a stream fixed over numpy versions
    return np.sort(np.argsort(bits, kind="stable")[:limit]).astype(np.int64)


@all_cores()
def fit_rows(
    blocks: Blocks,
    rows: np.ndarray,
    dims: int,
    whiten: bool = False,
    source: str = "",
    device: torch.device | str = "cpu",
) -> Projection:
    """The exact PCA of the given rows of a store or array, which is read twice and never held whole.

    Args:
        rows: row numbers to fit on (`sample_rows`).
        dims: components kept, at most the smaller of rows and dimensions.
        device: where the matrix products and `eigh` run.

    Raises:
        UsageError: more components than rows or dimensions; whitening along a direction without variance.
    """

    def chosen() -> Iterable[np.ndarray]:
        for numbers, block in blocks():
            inside = np.isin(numbers, rows)
            if inside.any():
                yield block if inside.all() else block[inside]

    total = np.zeros(0)
    count = 0
    for block in chosen():
        summed = block.sum(axis=0, dtype=np.float64)
        total = summed if count == 0 else total + summed
        count += len(block)
    dim = len(total)
    if dims > min(count, dim):
        raise UsageError(
            f"PCA to {dims} dimensions needs at least as many images and dimensions; {source or 'the sample'} has "
            f"{count} images of {dim} dimensions: choose a smaller pca, or a larger set with pca_from"
        )
    mean = torch.from_numpy(total / count)
    kind = torch.float64 if min(dim, count) <= DOUBLE else torch.float32

    def centred() -> Iterable[Tensor]:
        for block in chosen():
            for first in range(0, len(block), 4096):
                part = torch.from_numpy(np.array(block[first : first + 4096]))
                yield part.to(kind).sub_(mean.to(kind)).to(device)

    if count < dim:  # the Gram matrix is the smaller one, and the rows fit, being fewer than the dimensions
        matrix = torch.cat(list(centred()))
        values, vectors = _largest(matrix @ matrix.T, dims)
        spread = float(matrix.square().sum())
        components = torch.linalg.qr(matrix.T @ (vectors / values.sqrt().clamp_min(1e-30)))[0].T
    else:
        covariance = torch.zeros(dim, dim, dtype=kind, device=device)
        for part in centred():
            covariance.addmm_(part.T, part)
        spread = float(covariance.trace())
        values, vectors = _largest(covariance, dims)
        components = vectors.T
    largest = components.gather(1, components.abs().argmax(1, keepdim=True))
    components = components * torch.where(largest < 0, -1.0, 1.0)
    variances = values / max(count - 1, 1)
    if whiten and bool(variances[-1] <= variances[0] * 1e-10):
        raise UsageError(
            f"whitening to {dims} dimensions would divide by a variance of zero: {source or 'the sample'} spans fewer "
            "dimensions; choose a smaller pca or no whitening"
        )
    return Projection(
        mean.float(),
        components.float().cpu().contiguous(),
        variances.float().cpu(),
        float(values.sum()) / max(spread, 1e-30),
        count,
        whiten,
        source,
    )


def check_prefix(dims: int | None, of: int, setting: str = "prefix") -> None:
    """Raises `UsageError` for more dimensions than descriptors have."""
    if dims is not None and dims > of:
        raise UsageError(f"{setting} {dims}: the descriptors have {of} dimensions; take fewer")


@dataclass(frozen=True)
class Prefix:
    """x -> its first `dims` numbers, of unit length again: what a model trained with `loss.prefixes` makes short."""

    dims: int

    def __call__(self, descriptors: np.ndarray) -> np.ndarray:
        """[n, D] -> [n, dims] float32. Raises `UsageError` where D is less than that."""
        check_prefix(self.dims, descriptors.shape[1])
        first = descriptors[:, : self.dims].astype(np.float32)
        first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
        return first


def projected(blocks: Blocks, projection: Projection | Prefix) -> Blocks:
    """The same blocks, projected as they pass."""
    return lambda: ((numbers, projection(block)) for numbers, block in blocks())


def _largest(matrix: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The largest eigenvalues [count], descending and not below 0, and eigenvectors [n, count] of a symmetric matrix.

    `matrix` is overwritten.
    """
    if matrix.device.type != "cpu":
        values, vectors = torch.linalg.eigh(matrix)
        return values.flip(0)[:count].clamp_min(0), vectors.flip(1)[:, :count]
    from scipy.linalg import eigh  # leaves out the vectors that nobody wants, which torch computes

    n = len(matrix)
    wanted = [n - count, n - 1]
    # transposed, it lies in memory as LAPACK reads it, and is not copied
    found = eigh(matrix.T.numpy(), subset_by_index=wanted, driver="evr", overwrite_a=True, check_finite=False)
    values, vectors = (torch.from_numpy(part[..., ::-1].copy()) for part in found)
    return values.clamp_min(0), vectors
