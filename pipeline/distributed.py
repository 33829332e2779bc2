"""The global batch over processes: slices, gather with gradient, global sums, agreement. Identity at world size 1.

Invariant: with equal slices on every rank and a data-parallel wrapper that *averages* gradients (DDP, FSDP2, ZeRO),
a loss that is each rank's mean over its own images has exactly the gradient of the mean over the global batch.
The backward of `gather` is therefore a plain sum over ranks (reduce-scatter), with no extra factor.

What can fail or be decided on one rank alone goes through `agree`, `agreed` or `on_rank_0`: all ranks then end with
the same error, or goes on with the same decision.

Shapes: `B` images in the global batch, `b = B / W` on this rank, rank r holds rows [r*b, (r+1)*b).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Any, NamedTuple, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from pipeline.common.errors import Unexpected, UsageError, UserError, told

Value = TypeVar("Value")


def is_distributed() -> bool:
    """Whether a process group of more than one rank runs."""
    return dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1


def world_size() -> int:
    """W, 1 without a process group."""
    return dist.get_world_size() if is_distributed() else 1


def rank() -> int:
    """This process's rank, 0 without a process group."""
    return dist.get_rank() if is_distributed() else 0


def rank_slice(total: int, r: int | None = None, w: int | None = None) -> slice:
    """The contiguous part of `total` items that rank r of w owns; parts differ by at most one item.

    For training `total` is a multiple of w (checked by the config), so all parts are equal.
    """
    r = rank() if r is None else r
    w = world_size() if w is None else w
    return slice(total * r // w, total * (r + 1) // w)


# torch 2.13 renamed the two and warns about the old names; earlier ones know only those
_all_gather = getattr(dist, "all_gather_single", None) or dist.all_gather_into_tensor
_reduce_scatter = getattr(dist, "reduce_scatter_single", None) or dist.reduce_scatter_tensor


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, local: Tensor) -> Tensor:
        w = dist.get_world_size()
        local = local.contiguous()
        gathered = local.new_empty((w * local.shape[0], *local.shape[1:]))
        _all_gather(gathered, local)
        return gathered

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:  # [B, ...] -> [b, ...]
        grad = grads[0].contiguous()
        own = grad.new_empty((grad.shape[0] // dist.get_world_size(), *grad.shape[1:]))
        _reduce_scatter(own, grad, op=dist.ReduceOp.SUM)
        return own


class _Started:
    """A gather on its way, forward or backward, and the tensors that it works on."""

    work: Any
    tensors: tuple[Tensor, ...] = ()

    def wait(self) -> None:
        self.work.wait()
        self.tensors = ()


class _Begin(torch.autograd.Function):
    """Starts the exchange forward; backward waits for the one that `_End` started."""

    @staticmethod
    def forward(ctx: Any, local: Tensor, exchange: _Started) -> Tensor:
        ctx.exchange = exchange
        local = local.contiguous()
        gathered = local.new_empty((dist.get_world_size() * local.shape[0], *local.shape[1:]))
        exchange.tensors = (gathered, local)
        exchange.work = _all_gather(gathered, local, async_op=True)
        return local.view_as(local)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        ctx.exchange.wait()
        return grads[0], None


class _End(torch.autograd.Function):
    """Waits for what `_Begin` started; backward starts the exchange of the gradient."""

    @staticmethod
    def forward(ctx: Any, begun: Tensor, exchange: _Started) -> Tensor:
        ctx.exchange = exchange
        gathered = exchange.tensors[0]
        exchange.wait()
        return gathered

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:  # [B, ...] -> [b, ...], complete in _Begin.backward
        grad = grads[0].contiguous()
        own = grad.new_empty((grad.shape[0] // dist.get_world_size(), *grad.shape[1:]))
        ctx.exchange.tensors = (own, grad)
        ctx.exchange.work = _reduce_scatter(own, grad, op=dist.ReduceOp.SUM, async_op=True)
        return own, None


class _Sum(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, local: Tensor) -> Tensor:
        total = local.clone()
        dist.all_reduce(total, op=dist.ReduceOp.SUM)
        return total

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        grad = grads[0].clone()
        dist.all_reduce(grad, op=dist.ReduceOp.SUM)
        return grad


_statistics_group: Any = None


def open_statistics_group() -> None:
    """Gives BatchNorm's small exchanges a process group of their own: in backward they then do not queue behind the
    gradients that DDP reduces meanwhile. Without it they take the default group. Collective; once after the start."""
    global _statistics_group
    _statistics_group = dist.new_group() if is_distributed() else None


@torch.no_grad()
def gather_statistics(local: Tensor) -> Tensor:
    """As `gather`, without gradient, in the group of `open_statistics_group`."""
    gathered = local.new_empty((world_size() * local.shape[0], *local.shape[1:]))
    _all_gather(gathered, local.contiguous(), group=_statistics_group)
    return gathered


@torch.no_grad()
def sum_statistics(local: Tensor) -> Tensor:
    """As `global_sum`, without gradient and into `local` itself, in the group of `open_statistics_group`."""
    dist.all_reduce(local, op=dist.ReduceOp.SUM, group=_statistics_group)
    return local


def gather(local: Tensor) -> Tensor:
    """Rows of all ranks in rank order, with gradient: [b, ...] -> [B, ...]. All ranks hold the same b.

    Cost a rank: receives (W-1)*b rows forward, reduce-scatters B rows backward.
    """
    return _Gather.apply(local) if is_distributed() else local


def begin_gather(local: Tensor) -> Callable[[], Tensor]:
    """As `gather`, in two steps: what is computed before the returned function is called overlaps with the exchange,
    and its backward with the exchange of the gradient. Call it once."""
    if not is_distributed():
        return lambda: local
    exchange = _Started()
    begun: Tensor = _Begin.apply(local, exchange)
    return lambda: _End.apply(begun, exchange)


def global_sum(local: Tensor) -> Tensor:
    """Sum over ranks of a tensor of the same shape on each, with gradient (backward: sum over ranks)."""
    return _Sum.apply(local) if is_distributed() else local


class OnItsWay:
    """Numbers of a device, copied to the host while both go on; `read` waits for what was computed before them."""

    def __init__(self, numbers: Tensor) -> None:
        self.numbers = numbers.detach().to("cpu", non_blocking=True)  # pinned memory; on a CPU the tensor itself
        self.copied = torch.cuda.Event() if numbers.is_cuda else None
        if self.copied is not None:
            self.copied.record()

    def read(self) -> list[float]:
        """The numbers."""
        if self.copied is not None:
            self.copied.synchronize()
        found: list[float] = self.numbers.tolist()
        return found


@torch.no_grad()
def gather_uneven(local: Tensor) -> Tensor:
    """Rows of all ranks in rank order where ranks hold different numbers of rows; no gradient."""
    if not is_distributed():
        return local
    count = torch.tensor([local.shape[0]], device=local.device)
    counts = [torch.zeros_like(count) for _ in range(world_size())]
    dist.all_gather(counts, count)
    longest = int(max(int(c) for c in counts))
    padded = local.new_zeros((longest, *local.shape[1:]))
    padded[: local.shape[0]] = local
    parts = [torch.empty_like(padded) for _ in counts]
    dist.all_gather(parts, padded)
    return torch.cat([part[: int(c)] for part, c in zip(parts, counts, strict=True)])


def barrier() -> None:
    """Waits for all ranks."""
    if is_distributed():
        dist.barrier()


def agree(problem: BaseException | None = None, notice: int = 0, what: str = "") -> int:
    """Ends every rank alike where one has a problem; otherwise returns the largest `notice`. Collective.

    The happy path costs one all-reduce of one integer; texts are gathered only when there is a problem.

    Args:
        problem: what this rank's work raised, or None.
        notice: a small non-negative number that all ranks should know ("asked to stop"); the largest counts.
        what: what was being done, for errors that name no file ("writing the checkpoint outputs/x").

    Raises:
        UserError: the same class and message on all ranks, each text after the rank it comes from. A full disk, a
            missing permission and the like are `DataError` (`errors.told`). An error that no user can mend keeps its
            traceback on its own rank and is `Unexpected` on the others.
    """
    mine = None if problem is None else told(problem, what)
    if not is_distributed():
        if problem is not None:
            raise (mine if mine is not None else problem)
        return notice
    largest = torch.tensor([_PROBLEM if problem is not None else notice], device=collective_device())
    dist.all_reduce(largest, op=dist.ReduceOp.MAX)
    if int(largest.item()) != _PROBLEM:
        return int(largest.item())
    record = None if problem is None else _record(problem, mine)
    records: list[Any] = [None] * world_size()
    dist.all_gather_object(records, record)
    raise _joined({r: found for r, found in enumerate(records) if found is not None}, problem, mine)


def agreed(work: Callable[[], Value], what: str = "") -> Value:
    """This rank's `work()`; where it fails on any rank, the same error on every rank (`agree`). Collective.

    `work` holds no collective that a failing rank would leave out: the others would wait for it.
    """
    problem: BaseException | None = None
    value: Any = None
    try:
        value = work()
    except Exception as error:
        problem = error
    agree(problem, what=what)
    return value


def on_rank_0(work: Callable[[], Value], what: str = "") -> Value:
    """Rank 0's `work()` on all ranks: its value is sent (pickled, made by ourselves), its failure is everyone's."""
    value: Any = None
    problem: BaseException | None = None
    if rank() == 0:
        try:
            value = work()
        except Exception as error:
            problem = error
    mine = None if problem is None else told(problem, what)
    if is_distributed():
        box = [(value, None if problem is None else _record(problem, mine))]
        dist.broadcast_object_list(box, src=0)
        value, record = box[0]
        if record is not None:
            raise _joined({0: record}, problem, mine)
    elif problem is not None:
        raise (mine if mine is not None else problem)
    return value


@contextmanager
def held_on_rank_0(make: Callable[[], AbstractContextManager[Any]], what: str = "") -> Iterator[None]:
    """Rank 0 enters the context that `make` gives (a lock); all ranks raise where it cannot. Collective."""
    with ExitStack() as held:

        def enter() -> None:
            held.enter_context(make())

        on_rank_0(enter, what)
        yield


def lost(error: BaseException) -> Unexpected | None:
    """The one line for a collective that failed because another rank ended or did not answer; None for other errors."""
    text = str(error)
    network = isinstance(error, (dist.DistBackendError, dist.DistNetworkError, dist.DistStoreError))
    if not is_distributed() or not isinstance(error, RuntimeError) or not (network or "gloo/transport" in text):
        return None
    reason = text.strip().splitlines()[0].split("] ")[-1].split(". This is typically")[0]  # gloo adds a guess
    return Unexpected(f"rank {rank()}: another rank ended or did not answer ({reason}); its own messages say why")


def same(value: str, what: str) -> None:
    """Asserts that all ranks hold rank 0's `value`. Collective.

    Raises:
        UsageError: on all ranks, naming those that differ and both values.
    """
    first = broadcast_object(value)
    differs = None if value == first else UsageError(f"{what} is {value} here and {first} on rank 0")
    agree(differs)


def broadcast_object(value: Any) -> Any:
    """Rank 0's value on all ranks (a small picklable object made by ourselves)."""
    if not is_distributed():
        return value
    box = [value]
    dist.broadcast_object_list(box, src=0)
    return box[0]


@torch.no_grad()
def broadcast_tensors(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Rank 0's tensors by name on all ranks, on the CPU; what the others pass is ignored. Collective."""
    if not is_distributed():
        return dict(tensors)
    shapes = broadcast_object({name: (tuple(t.shape), t.dtype) for name, t in tensors.items()})
    sent: dict[str, Tensor] = {}
    for name, (shape, dtype) in shapes.items():
        first = rank() == 0
        tensor = (
            tensors[name].detach().to(collective_device()).contiguous()
            if first
            else torch.empty(shape, dtype=dtype, device=collective_device())
        )
        dist.broadcast(tensor, src=0)
        sent[name] = tensor.cpu()
    return sent


_PROBLEM = 1 << 30  # above every notice


class _Record(NamedTuple):
    """One rank's problem on its way to the others."""

    kind: type[UserError]
    message: str


def _record(problem: BaseException, mine: UserError | None) -> _Record:
    if mine is not None:
        return _Record(type(mine), str(mine))
    line = (str(problem).strip().splitlines() or [""])[0]
    return _Record(Unexpected, f"{type(problem).__name__}: {line} (its traceback is with that rank's messages)")


def _joined(records: dict[int, _Record], problem: BaseException | None, mine: UserError | None) -> BaseException:
    """What this rank raises; its own exception, with its traceback, where no user could mend that."""
    if problem is not None and mine is None:
        return problem
    kinds = [record.kind for record in records.values()]
    kind = Unexpected if Unexpected in kinds else kinds[0]
    messages = list(dict.fromkeys(record.message for record in records.values()))
    if len(messages) == 1 and len(records) == world_size():
        error = kind(messages[0])
    else:
        error = kind("; ".join(f"rank {r}: {record.message}" for r, record in records.items()))
    error.__cause__ = problem
    return error


def collective_device() -> torch.device:
    """Where collectives want their tensors: NCCL this rank's GPU, gloo the CPU (it takes a GPU's, too)."""
    if not is_distributed():
        return torch.device("cpu")
    if torch.cuda.is_available() and "nccl" in dist.get_backend():
        return torch.device("cuda", torch.cuda.current_device())
    return torch.device("cpu")
