"""Settings: each says its range and what changing it means; a value outside is refused however the config is built."""

from __future__ import annotations

import dataclasses
import math
import typing
from pathlib import Path
from typing import Any

import pytest

from jobs.cli import parse
from pipeline.common.errors import UsageError
from pipeline.config import ModelConfig, RunConfig, TrainConfig, flatten, from_dict, nested, to_dict
from pipeline.config.setting import changing, leaves, on_resume, type_hints

SETTINGS = dict(leaves(RunConfig))


def hint_of(name: str) -> Any:
    kind: Any = RunConfig
    for part in name.split("."):
        kind = type_hints(kind)[part]
    return kind


def built(name: str, value: Any) -> RunConfig:
    """The default run with one setting replaced, as a checkpoint's config would give it."""
    config: RunConfig = from_dict(RunConfig, nested({name: value}))
    return config


@pytest.mark.parametrize("name", SETTINGS)
def test_every_setting_says_what_changing_it_means_and_its_range(name: str) -> None:
    about = SETTINGS[name].metadata
    assert about.get("changes") in ("numbers", "speed", "none"), f"{name} is not a setting(..., changes=...)"
    assert on_resume(RunConfig)[name] == "free" or about["changes"] == "numbers", "only numbers are fixed"
    kinds = {hint_of(name), *typing.get_args(hint_of(name))}
    bounds = [about[key] for key in ("at_least", "at_most", "above", "below") if about[key] is not None]
    if int in kinds and not about["image_size"]:  # its range is the type's own
        assert bounds, f"{name} states no range"
    assert flatten(built(name, flatten(RunConfig())[name])) == flatten(RunConfig())


@pytest.mark.parametrize("name", SETTINGS)
def test_values_outside_a_range_are_refused_with_name_and_value(name: str) -> None:
    """Wrong types, not-a-number and infinity, and just outside each bound; the bounds themselves are inside."""
    about, hint = SETTINGS[name].metadata, hint_of(name)
    kinds = {hint, *typing.get_args(hint)}
    many = typing.get_origin(hint) is tuple
    wrong: list[Any] = [b"bytes", {"a": 1}, [[1]], 10**400]
    right: list[Any] = []
    if kinds & {int, float}:
        step = 1 if int in kinds else 0.001
        wrong += [math.nan, math.inf, -math.inf, "many", "", True]
        right += [about[key] for key in ("at_least", "at_most") if about[key] is not None]
        wrong += [about["at_least"] - step] if about["at_least"] is not None else []
        wrong += [about["at_most"] + step] if about["at_most"] is not None else []
        wrong += [about[key] for key in ("above", "below") if about[key] is not None]
    if about["image_size"]:
        wrong += ["x", "224x", "224x0", "0", 0, 8193, "224x8193", "0224", " 224", "224 x 224", -1, 224.0]
        wrong += ["native", "native640"] if about["image_size"] == "fixed" else ["native0", "native8193"]
        right += [1, 8192, "1x8192"]
    elif str in kinds:
        wrong += ["nul\0byte", "line\nbreak", "\x1b[31m", "x" * 300, "a/" * 3000, "\udcff", 3, False]
    for value in wrong:
        with pytest.raises(UsageError) as error:
            built(name, (value,) if many else value)
        told = str(error.value)
        assert told.startswith(f"{name} must be "), told
        assert told.isprintable() and len(told) < 700, told
    for value in right:
        built(name, (value,) if many else value)


def test_ranges_hold_in_python_too() -> None:
    for build in (lambda: TrainConfig(lr=-1.0), lambda: dataclasses.replace(RunConfig(), seed=-1)):
        with pytest.raises(UsageError, match="must be a"):
            build()
    assert isinstance(TrainConfig(lr=1).lr, float), "a whole number where a float is wanted"


def test_older_names_are_read() -> None:
    values = to_dict(RunConfig())
    values["train"]["clip"] = values["train"].pop("max_grad_norm") or 1.5
    values["model"]["train"] = values["model"].pop("trainable") and "full"
    read = from_dict(RunConfig, values)
    assert (read.train.max_grad_norm, read.model.trainable) == (1.5, "full")
    assert from_dict(ModelConfig, {"train": "frozen"}).trainable == "frozen"
    assert parse(RunConfig, "", ["--train.clip", "2"]).train.max_grad_norm == 2.0


def test_a_section_keeps_its_own_defaults() -> None:
    assert from_dict(RunConfig, {"validate": {"group_size": 4}}).validate.split == "val"
    assert parse(RunConfig, "", ["--validate.group_size", "4"]).validate.groups == ("shuffled",)


@pytest.mark.parametrize(
    ("text", "name", "value"),
    [
        ("data: {augment: off}", "data.augment", "off"),
        ("name: 123", "name", "123"),
        ("name: 007", "name", "007"),
        ("name: 2026-01-01", "name", "2026-01-01"),
        ("name: on", "name", "on"),
        ("name: 1e3", "name", "1e3"),
        ("train: {lr: 1e-4}", "train.lr", 1e-4),
        ("train: {lr: '1e-3'}", "train.lr", 1e-3),
        ("train: {validate_first: no}", "train.validate_first", False),
        ("train: {compile: On}", "train.compile", True),
        ("validate: {sets: [on, 123, 2026-01-01]}", "validate.sets", ["on", "123", "2026-01-01"]),
        ("validate: {sets: a}", "validate.sets", ["a"]),
        ("validate: {store: none, pca: none}", "validate.pca", None),
        ("validate: {pca: }", "validate.pca", None),
        ("train: {clip: 1}", "train.max_grad_norm", 1.0),
        ("data:\n  # nothing\n", "data.augment", "rand"),
    ],
)
def test_words_that_yaml_turns_into_other_types(text: str, name: str, value: Any, tmp_path: Path) -> None:
    file = tmp_path / "run.yaml"
    file.write_text(text)
    assert flatten(parse(RunConfig, "", ["--config", str(file)]))[name] == value


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"seed: 010", "seed must be a whole number"),
        (b"seed: 1:30", "seed must be a whole number"),
        (b"seed: 3.0", "seed must be a whole number"),
        (b"train: {lr: .nan}", "train.lr must be a number, above 0; it is '.nan'"),
        (b"data: 3", "data is a section"),
        (b"- a", "settings are written as"),
        (b"seed: 1\nseed: 2", "line 2: not YAML ('seed' comes twice)"),
        (b"\tseed: 1", "not YAML"),
        (b"name: \xff\xfe", "not YAML"),
        (b"name: a\n---\nname: b", "not YAML"),
        (b"data: {shards: [" * 2000, "not YAML"),
        (b"name: &a [*a]", "not YAML"),
        (b"name: !!python/object:os.system x\nseed: -1", "seed must be"),
        (b"? [a, b]\n: 1", "not YAML"),
        (b"a: &a [x,x,x,x,x,x,x,x,x,x]\n", "there is no setting a"),
        (b"name: %s\n" % (b"x" * (1 << 20)), "no config file"),
    ],
)
def test_odd_files_end_in_one_line(content: bytes, told: str, tmp_path: Path) -> None:
    file = tmp_path / "run.yaml"
    file.write_bytes(content)
    with pytest.raises(UsageError) as error:
        parse(RunConfig, "", ["--config", str(file)])
    assert told in str(error.value)
    assert str(error.value).isprintable()


def test_nested_aliases_do_not_explode(tmp_path: Path) -> None:
    """Nine lists of nine times the one before: 10^8 items if anybody unrolled them."""
    lines = ["x0: &x0 [lol]", *(f"x{i}: &x{i} [{', '.join([f'*x{i - 1}'] * 9)}]" for i in range(1, 9))]
    file = tmp_path / "run.yaml"
    file.write_text("validate: {sets: *x8}\n")
    for text in ("\n".join(lines), "validate:\n  sets: &x0 [a]\n" + "\n".join(lines[1:])):
        file.write_text(text)
        with pytest.raises(UsageError, match="there is no setting"):
            parse(RunConfig, "", ["--config", str(file)])


def test_what_a_training_computes_is_in_one_list() -> None:
    """What may change on resume and what names a training are both read from the fields."""
    numbers = changing(RunConfig, "numbers")
    assert {"train.epochs", "validate.radius", "data.shards", "model.backbone.weights"} <= numbers
    assert not numbers & {"data.cache_gb", "train.compile", "model.backbone.attention", "name", "validate.batch"}
    rules = on_resume(RunConfig)
    assert rules["data.cache_gb"] == rules["validate.radius"] == rules["data.shards"] == "free"
    assert rules["train.lr"] == rules["model.adapter.scale"] == "refused"
