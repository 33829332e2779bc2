"""Protocols: groupings that cover the set, are fixed for ever, and names that tell them apart."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pipeline.common.errors import UsageError
from pipeline.config import EvaluationConfig
from pipeline.evaluation.protocol import Protocol, metric_name, protocols

CONFIG = EvaluationConfig(group_size=16)


def by_name(config: EvaluationConfig = CONFIG) -> dict[str, Protocol]:
    return {p.name: p for p in protocols(config, 224, "25 m")}


@pytest.mark.parametrize("images", [1, 15, 16, 17, 315, 1000])
@pytest.mark.parametrize("side", ["database", "queries"])
def test_each_position_is_in_one_group(images: int, side: str) -> None:
    for protocol in by_name().values():
        groups = protocol.form(images, side)  # type: ignore[arg-type]
        assert sorted(np.concatenate(groups)) == list(range(images))
        assert {len(g) for g in groups[:-1]} <= {protocol.group_size}
        assert len(groups[-1]) == (images - 1) % protocol.group_size + 1


def test_ordered_groups_are_neighbours_and_shuffled_ones_are_not() -> None:
    ordered, shuffled = by_name()["ordered16"], by_name()["shuffled16"]
    assert all((np.diff(g) == 1).all() for g in ordered.form(160, "database"))
    gaps = np.concatenate([np.diff(np.sort(g)) for g in shuffled.form(1600, "database")])
    assert np.median(gaps) > 20


def test_shuffled_groups_never_change() -> None:
    """A recall of last year must be repeatable: these numbers are part of the protocol."""
    shuffled = by_name()["shuffled16"]
    assert shuffled.form(20, "database")[0][:6].tolist() == FIRST_DATABASE
    assert shuffled.form(20, "queries")[0][:6].tolist() == FIRST_QUERIES
    other = by_name(dataclasses.replace(CONFIG, group_seed=1))["shuffled16s1"]
    assert other.form(20, "database")[0].tolist() != shuffled.form(20, "database")[0].tolist()


def test_names_differ_where_the_number_may() -> None:
    variants = [
        {}, {"group_size": 8}, {"group_seed": 5}, {"pca": 512}, {"pca": 512, "pca_whiten": True}, {"precision": "bf16"},
        {"resize": "published"}, {"without_positives": "drop"}, {"search": "hnsw"}, {"store": "fp16"},
        {"search": "int8"}, {"search": "binary"}, {"search": "binary", "refine": 50}, {"prefix": 512},
    ]  # fmt: skip
    names = [list(by_name(dataclasses.replace(CONFIG, **v)))[1] for v in variants]  # type: ignore[arg-type]
    assert len(set(names)) == len(names) and all("@" not in name for name in names)
    assert list(by_name()) == ["single", "shuffled16", "ordered16"]


def test_what_makes_descriptors_small_is_named_and_must_go_together() -> None:
    config = dataclasses.replace(CONFIG, prefix=512, search="binary", refine=100)
    protocol = by_name(config)["shuffled16_prefix512_binary_refine100"]
    line = protocol.describe()
    assert "the first 512 dimensions" in line and "binary L2 search, first 100 ordered anew by float" in line
    assert protocol.grouping.prefix is None and protocol.grouping.refine == 0
    assert list(by_name(dataclasses.replace(CONFIG, refine=100))) == list(by_name())  # floats have no codes to refine
    with pytest.raises(UsageError, match="pca or prefix"):
        by_name(dataclasses.replace(CONFIG, pca=8, prefix=8))
    with pytest.raises(UsageError, match=r"refine 10 orders fewer candidates than are asked for \(20\)"):
        by_name(dataclasses.replace(CONFIG, search="int8", refine=10))


def test_description_names_everything_and_the_dict_rebuilds_it() -> None:
    config = dataclasses.replace(CONFIG, pca=4096, pca_from="pitts30k", resize="published", without_positives="drop")
    protocol = protocols(config, 322, "25 m")[2]
    line = protocol.describe()
    assert all(
        word in line for word in ("16 neighbours", "322", "no antialias", "PCA 4096", "pitts30k", "25 m", "dropped")
    )
    assert Protocol(**protocol.to_dict()) == protocol
    assert (
        metric_name("pitts30k", protocol, 5)
        == "pitts30k.ordered16_pca4096_from-pitts30k_published_322px_drop.recall_at_5"
    )
    assert protocol.grouping.pca is None and protocol.grouping.resize == "published"


FIRST_DATABASE = [0, 2, 11, 17, 9, 1]
FIRST_QUERIES = [17, 16, 14, 15, 5, 12]
