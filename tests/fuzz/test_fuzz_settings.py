"""Edited checkpoints, edited config files and odd values of settings: each ends in one line with code 2 or 3, or works.

The small versions run in `make test`, the large ones, and real processes, in `make test-slow`.
"""

from __future__ import annotations

import json
import math
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from jobs.cli import parse
from pipeline.common.errors import DataError
from pipeline.config import RunConfig, flatten, to_dict
from pipeline.config.setting import leaves
from pipeline.config.words import read_config
from pipeline.model.weights.files import check_digest, load_model, load_trainable, save_model
from pipeline.training import checkpoint
from pipeline.training.checkpoint import RunState
from pipeline.training.schedule import learning_rate
from tests.pipeline.evaluation.test_eval_identity import TINY
from tests.support.mutations import ODD, Tally, edited_bytes, edited_json

FILES = ("state.json", "model.safetensors", "optimizer.safetensors")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with a real checkpoint of a tiny model."""
    from pipeline.model.vpr import build_model

    run = tmp_path_factory.mktemp("whole")
    torch.manual_seed(0)
    model = build_model(TINY, 28)
    config = RunConfig(model=TINY)
    state = RunState(step=7, epoch=1, cursor=3, best=50.0, best_step=4, index="ab" * 32, validated={"a": 50.0})
    moments = {f"{name}/exp_avg": torch.zeros_like(p) for name, p in model.named_parameters()}
    checkpoint.write(run, state, config, lambda path: save_model(model, path, TINY, 28, True), moments)
    return run


def resume(run: Path) -> None:
    """What `jobs.train` does with a checkpoint before its first step."""
    from pipeline.model.vpr import build_model

    path = checkpoint.find(run, "auto")
    if path is None:
        raise AssertionError("starts anew beside a checkpoint")
    state, config, _ = checkpoint.read(path)
    now = RunConfig(model=TINY)
    checkpoint.check_same(config, now, state, "ab" * 32)
    assert math.isfinite(learning_rate(now.train, state.step, 10, 100))
    load_trainable(build_model(TINY, 28), path)


def edited_checkpoints(whole: Path, folder: Path, cases: int, tally: Tally) -> None:
    """Edits of state.json as JSON, with and without its digest made right again, and of each file as bytes."""
    told = json.loads((whole / "checkpoints/last/state.json").read_text())

    def attempt(what: str, name: str, content: bytes | None, action: Callable[[Path], object], harmless: bool) -> None:
        run = folder / "run"
        shutil.rmtree(run, ignore_errors=True)
        shutil.copytree(whole, run, symlinks=True)
        target = (run / "checkpoints/last").resolve() / name
        if content is None:
            target.unlink()
        else:
            target.write_bytes(content)
        tally.run(f"{name}: {what}", lambda: action(run), (2, 3), harmless)

    for what, changed in edited_json(told, 1, cases):
        attempt(what, "state.json", json.dumps(changed).encode(), resume, changed == told)
    for what, changed in edited_json({k: v for k, v in told.items() if k != "digest"}, 2, cases):
        forged = changed
        if isinstance(changed, dict):
            forged = changed | {"digest": checkpoint._own_digest(changed)}
        # a forger who knows the digest can still only write what some run could have written
        harmless = isinstance(changed, dict) and possible(changed)
        attempt(f"forged {what}", "state.json", json.dumps(forged).encode(), resume, harmless)
    for number, name in enumerate(FILES):
        attempt("removed", name, None, resume, False)
        content = (whole / "checkpoints/last" / name).read_bytes()
        for what, edit in edited_bytes(content, 10 + number, cases // 2):
            same = name == "state.json" and as_json(edit) == told  # white space
            attempt(what, name, edit, resume, same)
            if name == "model.safetensors":
                attempt(f"load, {what}", name, edit, load_model, False)


def as_json(content: bytes) -> Any:
    try:
        return json.loads(content)
    except (ValueError, RecursionError):
        return None


def possible(told: dict[str, Any]) -> bool:
    """Whether a state.json tells of a state and a config that a run of this model can have; a plain restatement."""
    state, config = told.get("state"), told.get("config")
    if not isinstance(state, dict) or not isinstance(config, dict) or told.get("format") != checkpoint.FORMAT:
        return False
    whole_numbers = ("step", "epoch", "cursor", "stale", "world_size")
    if any(type(state.get(name, 1)) is not int or not 0 <= state.get(name, 1) < 2**41 for name in whole_numbers):
        return False
    return state.get("epoch", 0) <= state.get("step", 0)


def test_edited_checkpoints(whole: Path, tmp_path: Path) -> None:
    tally = Tally()
    edited_checkpoints(whole, tmp_path, 40, tally)
    print(f"\nedited checkpoints: {tally}")
    assert not tally.faults, "\n".join(tally.faults[:20])


@pytest.mark.slow
def test_many_edited_checkpoints(whole: Path, tmp_path: Path) -> None:
    tally = Tally()
    edited_checkpoints(whole, tmp_path, 300, tally)
    print(f"\nedited checkpoints: {tally}")
    assert not tally.faults, "\n".join(tally.faults[:20])


def test_an_untouched_checkpoint_is_resumed_and_loaded(whole: Path) -> None:
    resume(whole)
    load_model(whole)
    check_digest(whole / "checkpoints/last/model.safetensors")
    with pytest.raises(DataError, match="was changed after it was written"):
        copied = whole.parent / "changed"
        shutil.copytree(whole, copied, symlinks=True)
        note = copied / "checkpoints/last/state.json"
        note.write_text(note.read_text().replace('"step": 7', '"step": 8'))
        checkpoint.read(copied / "checkpoints/last")


def edited_configs(folder: Path, cases: int, tally: Tally) -> None:
    """A complete config file, edited as bytes, as values and line by line, read as `jobs.train --config` does."""
    import yaml

    config = to_dict(RunConfig())
    text = yaml.safe_dump(config)
    file = folder / "run.yaml"

    def attempt(what: str, content: bytes) -> None:
        file.write_bytes(content)
        # what is still a config of known settings in their ranges is a config; that it is, is what `parse` checks
        tally.run(what, lambda: rebuilt(parse(RunConfig, "", ["--config", str(file)])), (2,), harmless=True)

    for what, changed in edited_bytes(text.encode(), 20, cases):
        attempt(f"bytes: {what}", changed)
    for what, value in edited_json(config, 21, cases):
        attempt(f"values: {what}", yaml.safe_dump(value, allow_unicode=True).encode("utf-8", "surrogatepass"))
    draw = random.Random(22)
    words = ["on", "Off", "0o17", "0x10", "1_0", "1:30", "2026-01-01", "~", "!!int x", "&a [*a]", "*none", "|", ">",
             "'", "{", "[", "- a", "? a", "%TAG", "---", "...", "\t", "<<: {}", "\u2028", "\ufeff", "é"]  # fmt: skip
    lines = text.splitlines()
    for number in range(cases):
        at, word = draw.randrange(len(lines)), draw.choice(words)
        edit = draw.choice(["replace", "append", "line", "twice"])
        name = lines[at].partition(":")[0]
        new = {"replace": [f"{name}: {word}"], "append": [f"{lines[at]} {word}"], "line": [lines[at], word],
               "twice": [lines[at], lines[at]]}[edit]  # fmt: skip
        attempt(f"line {number}: {edit} {word!r} at {at}", "\n".join(lines[:at] + new + lines[at + 1 :]).encode())


def rebuilt(config: RunConfig) -> None:
    """A config that was accepted is whole: what is saved of it builds it again."""
    from pipeline.config import from_dict

    assert from_dict(RunConfig, json.loads(json.dumps(to_dict(config)))) == config


def test_edited_config_files(tmp_path: Path) -> None:
    tally = Tally()
    edited_configs(tmp_path, 60, tally)
    print(f"\nedited config files: {tally}")
    assert not tally.faults, "\n".join(tally.faults[:20])
    assert tally.ends["one line"] > tally.ends.total() / 3


@pytest.mark.slow
def test_many_edited_config_files(tmp_path: Path) -> None:
    tally = Tally()
    edited_configs(tmp_path, 1000, tally)
    print(f"\nedited config files: {tally}")
    assert not tally.faults, "\n".join(tally.faults[:20])


def test_odd_values_of_every_setting() -> None:
    """As options: what is accepted is the value that was asked for, in its range."""
    tally, odd = Tally(), [value for value in ODD if isinstance(value, (str, int, float))]

    def give(name: str, text: str) -> None:
        config = parse(RunConfig, "", [f"--{name}={text}"])
        rebuilt(config)
        got = flatten(config)[name]
        told = "none" if got is None else str(got[0] if isinstance(got, list) and got else got)
        assert told.lower() in (text.lower(), "none", "[]") or float(told) == float(text), f"{name}={text} became {got}"

    for name, _ in leaves(RunConfig):
        for value in odd:
            text = "1" + "0" * 400 if value == 10**400 else str(value)
            tally.run(f"--{name}={text[:40]!r}", lambda n=name, t=text: give(n, t), (2,), harmless=True)
    print(f"\nodd values: {tally}")
    assert not tally.faults, "\n".join(tally.faults[:20])


@pytest.mark.slow
def test_odd_values_in_real_processes(tmp_path: Path) -> None:
    """The job itself, where a value reaches further than the parser: addresses, folders, files."""
    tally = Tally()
    tiny = ["--model.backbone.name", "custom", "--tracking.enabled", "false", "--output", str(tmp_path)]
    for name, value in [
        ("data.shards", "https://127.0.0.1:9/none"), ("data.shards", "s3://nowhere/none"), ("data.shards", "abc://x/y"),
        ("data.shards", "/dev/null"), ("data.shards", "x\ny"), ("data.shards", "a/" * 2000), ("config", "/dev/zero"),
        ("config", "/proc"), ("config", "x" * 5000), ("data.workers", "-1"), ("data.cache_gb", "-1"),
        ("data.rand_ops", "100"), ("data.prefetch", "-1"), ("name", "../x"), ("output", "/proc/x"),
    ]:  # fmt: skip
        arguments = ["jobs.train", *tiny, f"--{name}", value]
        tally.run_process(f"--{name} {value[:40]!r}", arguments, (2, 3))
    print(f"\nodd values in real processes: {tally}")
    assert not tally.faults, "\n".join(tally.faults[:20])


def test_a_config_file_that_is_no_file_is_not_waited_for(tmp_path: Path) -> None:
    import os

    os.mkfifo(tmp_path / "pipe")
    tally = Tally(seconds=5)
    for path in (tmp_path / "pipe", tmp_path, Path("/dev/zero"), tmp_path / "nul\0", tmp_path / ("x" * 300)):
        tally.run(repr(str(path)[-20:]), lambda p=path: read_config(str(p)), (2,))
    assert not tally.faults, "\n".join(tally.faults)
