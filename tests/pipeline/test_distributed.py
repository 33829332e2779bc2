"""Agreement between ranks: what fails or is decided on one of them ends, or is known, on all (two real gloo ranks)."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from processes import run_ranks

from pipeline.common.errors import DataError, Interrupted, Unexpected, UsageError, UserError, told
from pipeline.distributed import agree, agreed, begin_gather, broadcast_tensors, gather, on_rank_0, rank, same


def full_disk() -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def broken_tensors() -> None:
    from safetensors import SafetensorError

    raise SafetensorError("I/O error: No space left on device (os error 28)")


def broken_parquet() -> None:
    import pyarrow.parquet as pq

    pq.read_table(__file__)


def no_such_file() -> None:
    Path("/nowhere/at/all").read_text()


def user() -> None:
    raise UsageError("choose another --name")


def mistake() -> None:
    raise ZeroDivisionError("a bug")


def too_little_memory() -> None:
    raise MemoryError


FAULTS: dict[str, tuple[Callable[[], None], type[UserError], str]] = {
    "full disk": (full_disk, DataError, "rank 1: writing x: No space left on device"),
    "safetensors": (broken_tensors, DataError, "rank 1: writing x: I/O error: No space left on device (os error 28)"),
    "pyarrow": (broken_parquet, DataError, "rank 1: writing x: "),
    "missing": (no_such_file, DataError, "rank 1: writing x: /nowhere/at/all: No such file or directory"),
    "user": (user, UsageError, "rank 1: choose another --name"),
    "memory": (too_little_memory, DataError, "rank 1: writing x: out of memory"),
    "bug": (mistake, Unexpected, "rank 1: ZeroDivisionError: a bug"),
}


def outcomes() -> list[tuple[str, str, int, str, float]]:
    """Each fault on rank 1 alone, one after the other in one group: (fault, class, code, message, seconds)."""
    found = []
    for name, (fault, _, _) in FAULTS.items():
        start = time.perf_counter()
        try:
            agreed(fault if rank() == 1 else lambda: None, what="writing x")
        except Exception as error:
            code = error.exit_code if isinstance(error, UserError) else 1
            found.append((name, type(error).__name__, code, str(error), time.perf_counter() - start))
    return found


def test_a_fault_on_rank_1_is_the_same_error_on_both_ranks() -> None:
    zero, one = run_ranks(outcomes, 2)
    assert [f[0] for f in zero] == [f[0] for f in one] == list(FAULTS)
    for on_zero, on_one in zip(zero, one, strict=True):
        name, kind, code, message, seconds = on_zero
        print(f"{name}: codes [{code}, {on_one[2]}], {max(seconds, on_one[4]):.3f} s: {message}")
        _, wanted, start = FAULTS[name]
        assert kind == wanted.__name__ and message.startswith(start) and "\n" not in message
        if name == "bug":  # the rank that has it keeps it, with its traceback
            assert on_one[1:4] == ("ZeroDivisionError", 1, "a bug")
        else:
            assert on_one[1:4] == (kind, code, message)


def test_both_ranks_with_one_problem_say_it_once_and_different_ones_both() -> None:
    def both() -> list[str]:
        found = []
        for message in ("the same", f"other {rank()}"):
            try:
                agree(DataError(message))
            except DataError as error:
                found.append(str(error))
        return found

    assert run_ranks(both, 2) == [["the same", "rank 0: other 0; rank 1: other 1"]] * 2


def test_notices_values_and_tensors_reach_all_ranks() -> None:
    def reach() -> tuple[int, int, dict[str, torch.Tensor], str, str]:
        notice = agree(notice=2 * rank())
        value = on_rank_0(lambda: 7 + rank())
        sent = broadcast_tensors({"a": torch.arange(3) + 0.5, "b": torch.tensor(2)} if rank() == 0 else {})
        errors = []
        for work in (lambda: on_rank_0(full_disk, what="writing x"), lambda: same(f"v{rank()}", "the version")):
            try:
                work()
            except UserError as error:
                errors.append(f"{error.exit_code} {error}")
        same("equal", "the version")
        return notice, value, sent, *errors

    for notice, value, sent, failed, differs in run_ranks(reach, 2):
        assert (notice, value) == (2, 7)
        assert sent["a"].tolist() == [0.5, 1.5, 2.5] and sent["b"].item() == 2 and sent["b"].dtype == torch.int64
        assert failed == "3 rank 0: writing x: No space left on device"
        assert differs == "2 rank 1: the version is v1 here and v0 on rank 0"


def test_one_process_raises_what_it_met() -> None:
    assert agree(notice=3) == 3 and agreed(lambda: 5) == on_rank_0(lambda: 5) == 5
    for collective in (agreed, on_rank_0):
        with pytest.raises(DataError, match=r"^writing x: No space left on device$"):
            collective(full_disk, what="writing x")
        with pytest.raises(ZeroDivisionError, match="a bug"):
            collective(mistake)


def test_only_what_a_user_can_mend_becomes_one_line() -> None:
    assert told(ZeroDivisionError("a bug")) is None and told(KeyError("x")) is None
    interrupted = Interrupted("x")
    assert told(interrupted) is interrupted
    assert str(told(PermissionError(errno.EACCES, "Permission denied", "/data/x"), "reading /data/x")) == (
        "reading /data/x: Permission denied"
    )


def test_a_gather_in_two_steps_is_the_gather() -> None:
    """Value and gradient, also of what is computed in between."""

    def both() -> list[torch.Tensor]:
        torch.manual_seed(rank())
        found: list[torch.Tensor] = []
        local, weights = torch.randn(3, 4, dtype=torch.float64), torch.randn(2, 6, 4, dtype=torch.float64)
        for kind in (gather, begin_gather):
            x = local.clone().requires_grad_()
            travelling = kind(2 * x)
            between = (x**2).sum()
            everyone = travelling if isinstance(travelling, torch.Tensor) else travelling()
            (between + (weights[rank()] * everyone**2).sum()).backward()
            assert x.grad is not None
            found += [everyone.detach(), x.grad]
        return found

    ranks = run_ranks(both, 2)
    for found in ranks:
        assert torch.equal(found[0], found[2]) and torch.equal(found[1], found[3])
        assert found[0].shape[0] == 6
    assert not torch.equal(ranks[0][1], ranks[1][1])
