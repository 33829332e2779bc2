"""A result is found again only under everything it depends on: each field of the model's config and of the protocol."""

from __future__ import annotations

import dataclasses
import re
import typing
from pathlib import Path
from typing import Any

import pytest
import torch

from pipeline.config import (
    AdapterConfig,
    BackboneConfig,
    CrossImageConfig,
    EvaluationConfig,
    ModelConfig,
    PoolingConfig,
    from_dict,
    nested,
    to_dict,
)
from pipeline.config.setting import alternatives, leaves, on_resume, type_hints
from pipeline.evaluation.evaluate import evaluate, fit_projections
from pipeline.evaluation.identity import Identity, counted, files_digest, model_digest
from pipeline.evaluation.protocol import Protocol, metric_name, protocols, read_protocol
from pipeline.model.vpr import PlaceModel, build_model
from pipeline.model.weights.files import load_model, save_model
from tests.pipeline.evaluation.test_eval_evaluate import make_set

TINY = ModelConfig(
    backbone=BackboneConfig(name="custom", dim=16, depth=1, heads=2, patch=7, pretrain_grid=4),
    adapter=AdapterConfig(reduced=4),
    pooling=PoolingConfig(levels=(1, 2)),
    cross_image=CrossImageConfig(layers=1, heads=2, feedforward=16),
    trainable="full",
)
MODEL_SETTINGS = dict(leaves(ModelConfig))
PROTOCOL = Protocol(groups="ordered", group_size=16)
OTHER: dict[str, Any] = {
    "groups": "shuffled", "group_size": 8, "group_seed": 1, "pca": 64, "whiten": True, "pca_source": "pitts30k",
    "resize": "published", "image_size": 322, "rule": "10 m", "without_positives": "drop", "precision": "bf16",
    "stored": "fp16", "search": "hnsw", "rerank": 5, "rerank_by": "patch-netvlad",
    "rerank_layer": 2, "bank_from": "map", "prefix": 512, "refine": 50,
}  # fmt: skip


def another(name: str, config: ModelConfig) -> ModelConfig:
    """The config with one setting changed to some other value of its range."""
    hint: Any = ModelConfig
    value: Any = to_dict(config)
    for part in name.split("."):
        hint, value = type_hints(hint)[part], value[part]
    kind, about = alternatives(hint)[0], MODEL_SETTINGS[name].metadata
    if typing.get_origin(kind) is typing.Literal:
        changed: Any = next(choice for choice in typing.get_args(kind) if choice != value)
    elif kind is bool:
        changed = not value
    elif kind is str:
        changed = "elsewhere.pth"
    elif typing.get_origin(kind) is tuple:
        changed = [*value, 5]
    else:
        changed = value + 1 if kind is int else value * 0.5 + 0.01
        changed = value - 1 if about["at_most"] == value else changed
    made: ModelConfig = from_dict(ModelConfig, nested({name: changed}), base=config)
    return made


@pytest.fixture(scope="module")
def model() -> PlaceModel:
    torch.manual_seed(0)
    made = build_model(TINY, 28).eval()
    with torch.no_grad():
        for parameter in made.parameters():  # an adapter starts as zero, where its scale is nothing
            parameter.add_(0.1 * torch.randn_like(parameter))
    return made


@pytest.mark.parametrize("name", MODEL_SETTINGS)
def test_each_setting_of_the_model_is_in_its_digest_or_says_that_it_does_not_matter(
    name: str, model: PlaceModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = model_digest(model)
    monkeypatch.setattr(model, "config", another(name, TINY))
    matters = on_resume(ModelConfig)[name] == "refused"
    assert (model_digest(model) != before) == matters
    assert matters or name in ("backbone.attention", "backbone.weights"), "how fast, and where the weights came from"


@pytest.mark.parametrize("field", [f.name for f in dataclasses.fields(Protocol) if f.metadata["short"]])
def test_each_field_of_the_protocol_changes_name_and_identity(field: str) -> None:
    """A field that joins the protocol fails here until it has a value in OTHER, and so a place in the name."""
    for base in (PROTOCOL, dataclasses.replace(PROTOCOL, **{k: v for k, v in OTHER.items() if k != field})):
        changed = dataclasses.replace(base, **{field: OTHER[field]})
        assert changed.name != base.name
        assert re.fullmatch(r"[A-Za-z0-9_.-]+", changed.name), "safe in metric names and file names"
        one, other = (Identity("database", "m", "f", protocol) for protocol in (base, changed))
        assert one.digest != other.digest
        later = Protocol.__dataclass_fields__[field].metadata["stage"] == "answers"
        assert (base.grouping == changed.grouping) == later == (base.grouping.name == changed.grouping.name)


def test_each_part_of_an_identity_is_in_its_digest() -> None:
    one = Identity("database", "m", "f", PROTOCOL)
    for field in ("of", "model", "files", "more"):
        assert dataclasses.replace(one, **{field: "other"}).digest != one.digest  # type: ignore[arg-type]
    assert Identity("database", "m", "f", PROTOCOL).digest == one.digest


def test_names_of_default_fields_are_short_and_odd_values_are_told_apart() -> None:
    def name(**fields: Any) -> str:
        return dataclasses.replace(PROTOCOL, **fields).name

    assert (name(), name(pca=4096), Protocol(groups="single").name) == ("ordered16", "ordered16_pca4096", "single")
    assert name(groups="shuffled", group_seed=3) == "shuffled16s3"
    assert name(pca=512, whiten=True, pca_source="pitts30k") == "ordered16_pca512w_from-pitts30k"
    assert name(image_size=322, rule="10 m") == "ordered16_322px_10m"
    assert name(rule="+-2 frames") == "ordered16_2frames" and name(rerank=9, rerank_layer=2) == "ordered16_rerank9l2"
    odd = ["a b", "a-b", "a/b", "../x", "a\nb", "x" * 300, "x" * 301, "é", "=1", "", "2frames", "10m"]
    names = {name(pca_source=value) for value in odd} | {name(rule=value) for value in odd}
    assert len(names) == 2 * len(odd)
    assert all(len(n) < 100 and re.fullmatch(r"[A-Za-z0-9_.-]+", metric_name("set", PROTOCOL, 1)) for n in names)


def test_the_issues_two_protocols_have_two_names() -> None:
    """25 m, own PCA, 224 px; and 10 m, Pitts30k's PCA, 320 px: both were `ordered16_pca4096`."""
    ours = protocols(EvaluationConfig(groups=("ordered",), pca=4096), 224, "25 m")[0]
    other = protocols(EvaluationConfig(groups=("ordered",), pca=4096, pca_from="pitts30k", radius=10), 320, "10 m")[0]
    assert ours.name == "ordered16_pca4096" != other.name
    assert read_protocol(ours.to_dict(), "here") == ours


@pytest.mark.parametrize(
    "change",
    [{"cross_image": {"alone": True}}, {"adapter": {"scale": 0.9}}, {"pooling": {"normalise": False}},
     {"cross_image": {"heads": 4}}],
)  # fmt: skip
def test_the_same_tensors_under_another_config_never_share_descriptors(
    change: dict[str, Any], model: PlaceModel, tmp_path: Path
) -> None:
    """With a store, one model read the other's descriptors (true distance 0.13, reported 0)."""
    altered = build_model(from_dict(ModelConfig, change, base=TINY), 28).eval()
    altered.load_state_dict(model.state_dict())
    evaluated = make_set(tmp_path, 12, 4)
    config = EvaluationConfig(groups=("ordered",), group_size=4, recalls=(1,), workers=0, store="fp32")
    first = evaluate(model, [evaluated], config, "cpu", output=tmp_path / "out", progress=False)[0]
    second = evaluate(altered, [evaluated], config, "cpu", output=tmp_path / "out", progress=False)[0]
    plain = dataclasses.replace(config, store="none")
    truth = evaluate(altered, [evaluated], plain, "cpu", progress=False)[0]
    assert (second.distances == truth.distances).all() and not (second.distances == first.distances).all()


def test_a_files_own_digest_does_not_depend_on_where_the_weights_came_from(model: PlaceModel, tmp_path: Path) -> None:
    save_model(model, tmp_path / "model.safetensors", TINY, 28, everything=True)
    assert model_digest(load_model(tmp_path / "model.safetensors")) == model_digest(model)
    assert counted(object()) == {}


def test_a_fitted_pca_is_not_found_after_its_photos_changed(model: PlaceModel, tmp_path: Path) -> None:
    evaluated = make_set(tmp_path, 12, 4)
    config = EvaluationConfig(groups=("single",), pca=4, pca_from="fields", workers=0)
    digest = model_digest(model)

    def fit() -> torch.Tensor:
        fitted = fit_projections(model, evaluated, config, "cpu", False, tmp_path / "kept", digest)
        (only,) = fitted.values()
        return only.mean

    first = fit()
    assert torch.equal(fit(), first) and len(list((tmp_path / "kept").iterdir())) == 1
    before = files_digest(evaluated.database)
    make_set(tmp_path / "new", 12, 4)
    evaluated.database[3].write_bytes(evaluated.database[5].read_bytes())
    assert files_digest(evaluated.database) != before and not torch.equal(fit(), first)
