"""Checkpoints: folders that are either complete or absent, written once, engine-independent.

    outputs/<run>/checkpoints/step-00000123/{model.safetensors, optimizer.safetensors, state.json}
    outputs/<run>/checkpoints/last -> step-00000123      best -> step-00000100

Invariant: a kill at any moment leaves the previous checkpoint readable. A folder is written under a temporary name,
synced and renamed once; `last` and `best` are symbolic links replaced by one rename (small text files on a file system
without links). The tensors are whole (never shards) and named as in the model, so any engine and any number of ranks
can read what another wrote; nothing in here is pickled. Randomness needs no state: it is keyed by (seed, epoch, step,
rank), see `trainer`.
"""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from pipeline.common.errors import DataError, UsageError, UserError
from pipeline.common.files import sha256_of, sync_path, usual_permissions, write_atomically
from pipeline.common.text import shown
from pipeline.config import RunConfig, flatten, from_dict, nested
from pipeline.config.setting import check, on_resume

_NO_LINKS = (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL)  # exFAT and SMB say one of these
FORMAT = "checkpoint 2"  # 1 told neither its format nor the digests of its files
FILES = ("model.safetensors", "optimizer.safetensors")
STEPS = 2**40  # more than any run takes


def _bounded(default: Any, least: int = 0) -> Any:
    return dataclasses.field(default=default, metadata={"at_least": least, "at_most": STEPS})


@dataclass
class RunState:
    """Where a run stands; the JSON in a checkpoint.

    Attributes:
        step: optimiser steps taken.
        epoch: the epoch being read, from 0.
        cursor: global batches of that epoch already trained on.
        best: best validation figure so far, percent, and the step it belongs to.
        stale: epochs since then.
        run_id: MLflow run, "" when not recorded.
        index: digest of the shard set's index.
        world_size: ranks that wrote it (informative; any number may continue).
        validated: the newest validation, metric name -> value, and the step it was made at (None: not yet).
        validation: digest of the set and protocol that `best` was measured with; "" where it is not known.
        start: the same before the first step, {} where it was not measured.
        scaler: loss scale of fp16, empty otherwise.
        mined: the descriptors that the epoch is planned from: file, sha256, epoch they were made at; {}: none yet.
    """

    step: int = _bounded(0)
    epoch: int = _bounded(0)
    cursor: int = _bounded(0)
    best: float | None = dataclasses.field(default=None, metadata={"at_least": 0, "at_most": 100})
    best_step: int | None = _bounded(None)
    stale: int = _bounded(0)
    run_id: str = dataclasses.field(default="", metadata={"may_be_empty": True})
    index: str = dataclasses.field(default="", metadata={"may_be_empty": True})
    world_size: int = _bounded(1, 1)
    validated: dict[str, float] = dataclasses.field(default_factory=dict)
    validated_step: int | None = _bounded(None)
    validation: str = dataclasses.field(default="", metadata={"may_be_empty": True})
    start: dict[str, float] = dataclasses.field(default_factory=dict)
    scaler: dict[str, float] = dataclasses.field(default_factory=dict)
    mined: dict[str, str | int] = dataclasses.field(default_factory=dict)


def folder(run: Path, step: int) -> Path:
    """Where the checkpoint of a step lies."""
    return run / "checkpoints" / f"step-{step:08d}"


def write(
    run: Path, state: RunState, config: RunConfig, weights: Callable[[Path], None], optimizer: dict[str, Tensor]
) -> Path:
    """Writes one checkpoint and points `last` at it. Called on one rank, with whole tensors on the CPU.

    Args:
        run: the run's folder.
        state, config: go into state.json.
        weights: writes the model's file at a path.
        optimizer: tensors named `<parameter>/<state>`.
    """
    from safetensors.torch import save_file

    target = folder(run, state.step)
    temporary = target.with_name(f".writing-{target.name}-{os.getpid()}")
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        temporary.mkdir(parents=True)
        weights(temporary / "model.safetensors")
        save_file({k: v.contiguous() for k, v in optimizer.items()}, temporary / "optimizer.safetensors")
        usual_permissions(temporary / "optimizer.safetensors")
        told = {
            "format": FORMAT,
            "state": dataclasses.asdict(state),
            "config": flatten(config),
            "files": {name: _digest(temporary / name) for name in FILES},
        }
        (temporary / "state.json").write_text(json.dumps(told | {"digest": _own_digest(told)}, indent=1) + "\n")
        for file in temporary.iterdir():
            sync_path(file)
        sync_path(temporary)
    except BaseException:  # a full disk has room again for what tells of it
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    if target.exists():  # the same step again (an epoch's end that was also a save_every): the newer state wins
        stale = target.with_name(f".replaced-{target.name}-{os.getpid()}")
        target.rename(stale)
        temporary.rename(target)
        shutil.rmtree(stale)
    else:
        temporary.rename(target)
    point(run, "last", target)
    return target


def point(run: Path, name: str, target: Path) -> None:
    """Points `name` ("last", "best") at a checkpoint by one rename: a link, or a text file where there are none."""
    link = run / "checkpoints" / name
    temporary = link.with_name(f".{name}-{os.getpid()}")
    temporary.unlink(missing_ok=True)
    try:
        temporary.symlink_to(target.name)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        write_atomically(link, target.name + "\n")
        return
    temporary.replace(link)
    sync_path(link.parent)


def pointed(run: Path, name: str) -> Path | None:
    """The checkpoint that "last" or "best" points at, None where it points at none."""
    link = run / "checkpoints" / name
    target = link.parent / link.read_text().strip() if link.is_file() else link.resolve()
    return target if (target / "state.json").exists() else None


def prune(run: Path, keep: int) -> None:
    """Removes all but the newest `keep` checkpoints, the one `best` points at, and left-overs of killed writes."""
    parent = run / "checkpoints"
    kept = [found.name for name in ("last", "best") if (found := pointed(run, name)) is not None]
    steps = sorted(p for p in parent.glob("step-*") if p.is_dir())
    for path in [p for p in steps[: max(0, len(steps) - keep)] if p.name not in kept]:
        doomed = path.with_name(f".removing-{path.name}")  # renamed first: a half-removed folder must not look whole
        path.rename(doomed)
    for leftover in [*parent.glob(".writing-*"), *parent.glob(".removing-*"), *parent.glob(".replaced-*")]:
        shutil.rmtree(leftover)


def find(run: Path, resume: str) -> Path | None:
    """The checkpoint to continue from, or None to start anew.

    Args:
        run: the run's folder.
        resume: "auto", "never", or the path of a checkpoint (or of a run folder).

    Raises:
        UsageError: "never" on a run that has checkpoints, or a path that holds none.
        DataError: a damaged checkpoint.
    """
    last = pointed(run, "last")
    if resume == "never":
        if last is not None:
            raise UsageError(f"{run} already holds a run; choose another --name, or --train.resume auto to continue it")
        return None
    if resume == "auto":
        damaged = [p for p in (run / "checkpoints").glob("step-*") if p.is_dir() and not (p / "state.json").exists()]
        if damaged:  # a folder is complete or absent, so somebody took it away
            raise DataError(f"checkpoint {max(damaged)} has no state.json; remove it to resume from an older one")
        # between the two renames of a rewrite only the newest complete folder may be there, not the link's target
        complete = sorted((run / "checkpoints").glob("step-*/state.json"))
        return last if last is not None else (complete[-1].parent.resolve() if complete else None)
    given = Path(resume)
    for path in (given, pointed(given, "last"), pointed(given.parent.parent, given.name)):
        if path is not None and (path / "state.json").exists():
            found = path.resolve()
            later = [p for p in (run / "checkpoints").glob("step-*") if p.name > found.name]
            if found.parent == (run / "checkpoints").resolve() and later:
                raise UsageError(f"{run} has checkpoints after {found.name}; continue from it under another --name")
            return found
    raise UsageError(f"{resume} holds no checkpoint (no state.json)")


def read(path: Path) -> tuple[RunState, dict[str, Any], dict[str, Tensor]]:
    """State, flat config (under today's names) and optimiser tensors of a checkpoint, checked against its own digests.

    Its weights are read by `pipeline.model.weights.files`.

    Raises:
        DataError: a file is missing, not what was written, or holds a value that no run has.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        state, config = _told(path)
        return state, config, load_file(path / "optimizer.safetensors")
    except (OSError, SafetensorError, UserError, ValueError, KeyError, TypeError, RecursionError) as error:
        told = error if isinstance(error, UserError) else shown(error)
        raise DataError(f"checkpoint {path} cannot be read ({told}); remove it to resume from an older one") from error


def _told(path: Path) -> tuple[RunState, dict[str, Any]]:
    """`state.json`, checked. Raises what `read` makes one line of."""
    told = json.loads((path / "state.json").read_bytes())
    if not isinstance(told, dict) or not isinstance(told.get("state"), dict):
        raise DataError("state.json is not that of a checkpoint")
    if set(told) != {"state", "config"}:  # format 1
        if told.get("format") != FORMAT:
            raise DataError(f"state.json is of format {shown(told.get('format'))}, this is {FORMAT}")
        if told.pop("digest", None) != _own_digest(told):
            raise DataError("state.json was changed after it was written")
        for name in FILES:
            if told["files"][name] != _digest(path / name):
                raise DataError(f"{name} is not the file that was written with it")
    surplus = set(told["state"]) - {field.name for field in dataclasses.fields(RunState)}
    if surplus:
        raise DataError(f"state.json has an unknown value {shown(min(surplus))}")
    state = RunState(**told["state"])
    check(state)
    last = max(state.epoch, state.cursor, state.best_step or 0, state.validated_step or 0)
    if last > state.step:
        raise DataError(f"state.json cannot be right: step {state.step}, epoch {state.epoch}, batch {state.cursor}")
    return state, flatten(from_dict(RunConfig, nested(told["config"])))


def _digest(path: Path) -> dict[str, Any]:
    return {"bytes": path.stat().st_size, "sha256": sha256_of(path)}


def _own_digest(told: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()


def check_same(saved: dict[str, Any], config: RunConfig, state: RunState, index: str) -> None:
    """Refuses to continue a run under settings that would change what a step computes.

    Args:
        saved: the flat config of the checkpoint, from `read`: a setting that is younger than it has its default.
        config: of the run that wants to continue.
        state: of the checkpoint.
        index: digest of the shard set's index now.

    Raises:
        UsageError: names the first setting that differs, with both values.
    """
    now, rules = flatten(config), on_resume(RunConfig)
    for key in sorted(set(saved) | set(now)):
        rule = rules.get(key, "refused")
        if rule == "free" or (rule != "refused" and config.train.schedule != "cosine"):
            continue
        if saved.get(key) != now.get(key):
            why = "" if rule == "refused" else ", and the rate of train.schedule cosine follows from it"
            raise UsageError(
                f"cannot resume {config.name}: {key} was {saved.get(key)!r} and is now {now.get(key)!r}{why}; "
                "put it back, or choose another --name"
            )
    if state.index != index:
        raise UsageError(
            f"cannot resume {config.name}: the shards in {config.data.shards} are not those it started with "
            f"(index {_short(index)}, was {_short(state.index)}); choose another --name"
        )


def _short(digest: str) -> str:
    """The first digits of each set's digest (of several sets they are joined by "+")."""
    return " + ".join(part[:12] for part in digest.split("+"))
