"""The multi-similarity loss of the global batch (paper, Eq. 5), a rank's rows at a time.

Invariant: the value and the averaged gradient do not depend on the number of ranks. Each rank compares its own `b`
anchors with all `B` gathered descriptors and takes the mean over its own anchors; the backward of the gather sums over
ranks and the data-parallel wrapper averages, which is exactly the gradient of the global mean (pipeline.distributed).
Cost a rank: receives (W-1)*b descriptors, computes b*B similarities; the redundant form would compute B*B. Where each
image is described p times (joint training: p = 2, in the global batch and alone), b and B count descriptors: all p*B
are compared with each other, and an image's other descriptions are positives of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn import functional as F

from pipeline.distributed import OnItsWay, gather, is_distributed, rank, world_size


@dataclass(frozen=True)
class Summary:
    """What a step tells the host, over the global batch and the same on every rank.

    Attributes:
        loss: its value.
        mined: what mining kept.
        flagged: how many ranks set their flag.
    """

    loss: float
    mined: MiningStatistics
    flagged: int


@dataclass(frozen=True)
class MiningStatistics:
    """What mining kept, over the global batch.

    Attributes:
        anchors: share of anchors with at least one mined pair, 0 to 1.
        by_pass: the same for each of an image's p descriptions.
        positives: mined positive pairs an anchor.
        negatives: mined negative pairs an anchor.
    """

    anchors: float
    by_pass: tuple[float, ...]
    positives: float
    negatives: float


class MultiSimilarityLoss(nn.Module):
    """Multi-similarity loss over online mined pairs (Wang et al. 2019; paper section 3.4, Eq. 5).

    A positive p of anchor q is kept if S_qp - margin < max_n S_qn, a negative n if S_qn + margin > min_p S_qp (strict).
    Similarities are cosines, computed in float32 at least: beta = 50 turns an error of 1e-2 into a factor of 1.6.

    Args:
        alpha: weight of positives.
        beta: weight of negatives.
        base: similarity threshold lambda.
        margin: mining margin.
        ignore_within: metres; a pair of two places closer than this is neither positive nor negative. 0: none is.
        prefixes: the losses of the first so many dimensions, of unit length again, are added, each with its own mining
            (Kusupati et al. 2022, Matryoshka Representation Learning, Eq. 1 with weights of 1). No more is gathered.
        points: [P, 3] float64, where place number p lies, in metres (pipeline.data.positions); NaN where unknown, and
            then near to nothing. The same on all ranks.
    """

    points: Tensor | None

    def __init__(
        self,
        alpha: float = 1.0,
        beta: float = 50.0,
        base: float = 0.0,
        margin: float = 0.1,
        ignore_within: float = 0.0,
        points: Tensor | None = None,
        prefixes: Sequence[int] = (),
    ) -> None:
        super().__init__()
        self.prefixes = tuple(prefixes)
        self.alpha, self.beta, self.base, self.margin = alpha, beta, base, margin
        self.ignore_within = ignore_within
        self.register_buffer("points", points, persistent=False)
        self._summary: tuple[int, OnItsWay] | None = None

    def forward(self, descriptors: Tensor, labels: Tensor, flag: bool = False) -> Tensor:
        """Loss of the global batch.

        Args:
            descriptors: [p*b, dim], this rank's rows, p descriptions of each image: all images in one way, then all in
                the next (p = 1: [b, dim]). The same p and b on every rank.
            labels: [b] integers, the same number for the same place on every rank.
            flag: what this rank has to tell the others, which `summary` counts.

        Returns:
            Scalar whose value is the mean over all p*B anchors (an anchor without mined pairs counts 0) and whose
            gradient is that of this rank's own mean, to be averaged over ranks. Without any mined pair it is 0 with
            a zero gradient.

        Raises:
            ValueError: shapes do not fit.
        """
        if any(dims > descriptors.shape[-1] for dims in self.prefixes):
            raise ValueError(f"prefixes {self.prefixes} of descriptors {tuple(descriptors.shape)}")
        if descriptors.ndim != 2 or labels.ndim != 1 or not len(labels) or len(descriptors) % len(labels):
            raise ValueError(
                f"descriptors {tuple(descriptors.shape)} need [p*b, dim] and labels {tuple(labels.shape)} [b]"
            )
        b = len(descriptors)
        passes = b // len(labels)
        labels = labels.repeat(passes)
        with torch.autocast(descriptors.device.type, enabled=False):
            own = F.normalize(descriptors.to(torch.promote_types(descriptors.dtype, torch.float32)), dim=1)
            others = gather(own)  # [B, dim]
            similarities = [own @ others.T]  # [b, B]
            for dims in self.prefixes:
                cut = [F.normalize(part[:, :dims], dim=1) for part in (own, others)]
                similarities.append(cut[0] @ cut[1].T)
        everyone = gather(labels)
        same = labels[:, None] == everyone[None, :]
        columns = torch.arange(len(everyone), device=labels.device)
        itself = columns == rank() * b + columns[:b, None]
        different = ~same & ~self._near(labels, everyone)
        local = own.new_zeros(())
        for similarity in reversed(similarities):  # the whole descriptors last: the statistics are of their pairs
            positive, negative = self.mine(similarity.detach(), same & ~itself, different)
            push = self.soft_sum(-self.alpha * (similarity - self.base), positive) / self.alpha
            pull = self.soft_sum(self.beta * (similarity - self.base), negative) / self.beta
            local = local + (push + pull).mean()

        anchors = (positive.any(1) | negative.any(1)).view(passes, -1).sum(1)
        counts = torch.cat([anchors, positive.sum()[None], negative.sum()[None]])
        # one small all-reduce carries the loss's global value, the mining counts and the ranks' flags
        summary = torch.cat([local.detach()[None], counts.to(local.dtype), local.new_full((1,), float(flag))])
        if is_distributed():
            dist.all_reduce(summary)
        self._summary = (len(everyone), OnItsWay(summary))
        return local + (summary[0] / world_size() - local.detach())

    def _near(self, labels: Tensor, everyone: Tensor) -> Tensor:
        """Which pairs lie closer than `ignore_within`: labels [b] and [B] -> bool [b, B], or one False for all.

        From the gathered labels and the whole table of points, so no rank can see another distance than the others.
        """
        if self.points is None or not self.ignore_within:
            return torch.zeros((), dtype=torch.bool, device=labels.device)
        own, others = self.points[labels], self.points[everyone]
        x, y, z = ((own[:, None, axis] - others[None, :, axis]).square() for axis in range(3))
        return x + y + z < self.ignore_within**2

    def mine(self, similarity: Tensor, positive: Tensor, negative: Tensor) -> tuple[Tensor, Tensor]:
        """Hard pairs of each anchor: boolean masks [b, B] from similarities [b, B] and the masks of all pairs."""
        hardest_negative = similarity.masked_fill(~negative, -torch.inf).amax(1, keepdim=True)
        hardest_positive = similarity.masked_fill(~positive, torch.inf).amin(1, keepdim=True)
        return (
            positive & (similarity - self.margin < hardest_negative),
            negative & (similarity + self.margin > hardest_positive),
        )

    def summary(self) -> Summary:
        """What the last forward computed, over the global batch. Waits for that forward, and not for what the device
        was given since: called after backward and update, it lets them go on.

        Raises:
            RuntimeError: before any forward.
        """
        if self._summary is None:
            raise RuntimeError("no batch has been through the loss yet")
        total, numbers = self._summary
        loss, *anchors, positives, negatives, flagged = numbers.read()
        each = total / len(anchors)
        mined = MiningStatistics(
            sum(anchors) / total, tuple(n / each for n in anchors), positives / total, negatives / total
        )
        return Summary(loss / world_size(), mined, int(flagged))

    def statistics(self) -> MiningStatistics:
        """What the last forward mined, as `summary` has it."""
        return self.summary().mined

    @staticmethod
    def soft_sum(exponent: Tensor, mask: Tensor) -> Tensor:
        """log(1 + sum over the mask of e^exponent) for each row, without overflow: [b, B] -> [b]."""
        exponent = exponent.masked_fill(~mask, -torch.inf)
        return torch.logsumexp(torch.cat([exponent.new_zeros(len(exponent), 1), exponent], dim=1), dim=1)
