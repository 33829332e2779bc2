"""What a step waits for: its batch on the device, and its numbers, read once."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from processes import run_ranks

from pipeline.data.images import normalise
from pipeline.data.places import Batch
from pipeline.distributed import rank
from pipeline.training.ahead import OnDevice
from pipeline.training.loss import MultiSimilarityLoss


def made(count: int) -> list[Batch]:
    draw = torch.Generator().manual_seed(0)
    return [
        Batch(
            torch.randint(256, (4, 3, 8, 8), dtype=torch.uint8, generator=draw), torch.full((4,), number), [str(number)]
        )
        for number in range(count)
    ]


def test_batches_come_in_order_one_ahead() -> None:
    def broken() -> Iterator[Batch]:
        yield from made(3)
        raise OSError("the fourth")

    batches = OnDevice(broken(), torch.device("cpu"))
    coming = batches.fetch()
    for batch in made(2):
        assert coming is not None
        now, coming = coming, batches.fetch()
        ready = now()
        assert torch.equal(ready.images, normalise(batch.images)) and torch.equal(ready.labels, batch.labels)
        assert ready.keys == batch.keys and ready.copy_wait() == 0.0
    assert coming is not None and coming().keys == ["2"]
    with pytest.raises(OSError, match="the fourth"):
        batches.fetch()
    assert OnDevice(iter(()), torch.device("cpu")).fetch() is None


def test_a_flag_of_one_rank_reaches_all_with_the_loss_and_changes_no_number() -> None:
    def told(flag: bool) -> tuple[float, object, int]:
        torch.manual_seed(rank())
        loss = MultiSimilarityLoss()
        value = loss(
            torch.randn(8, 6), torch.arange(2 * rank(), 2 * rank() + 2).repeat_interleave(4), flag=flag and rank() == 1
        )
        found = loss.summary()
        assert found.loss == pytest.approx(value.item())
        return found.loss, found.mined, found.flagged

    raised, plain = run_ranks(told, 2, True), run_ranks(told, 2, False)
    assert raised[0] == raised[1] and plain[0] == plain[1]
    assert raised[0] == (*plain[0][:2], 1) and plain[0][2] == 0
