"""The paper's tables as plain dicts of rows: what each row trains and under which protocol it is evaluated.

Invariant: a row differs from the paper's model in nothing but what the paper's table says. Sizes that a table varies
(places, epochs, PCA dimensions) are written as the paper has them; at another size of model or batch they keep their
proportion to the base configuration, so that a table has the same rows at every size.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from pipeline.common.errors import UsageError

PLACES, EPOCHS, DIMENSIONS, DEPTH = 72, 10, 10752, 12
"""The paper's batch, length of training, descriptor and backbone, to which a row's figures are in proportion."""


@dataclass(frozen=True)
class Row:
    """A row of a table."""

    variant: str = "CricaVPR"
    """Name of the model variant (`pipeline.model.variants`)."""
    changes: dict[str, Any] = field(default_factory=dict)
    """Settings of the run besides the variant, with dotted keys."""
    places: int | None = None
    """Places of the global batch, of the paper's 72."""
    epochs: float | None = None
    """Epochs of training, of the paper's 10; may be a fraction."""
    pca: int | None = None
    """Evaluation: dimensions kept by PCA, of the paper's 10752."""
    group: int | None = None
    """Evaluation: images that share an inference batch; None: the paper's, 8 on Pittsburgh and 16 elsewhere."""
    groups: tuple[Literal["single", "shuffled", "ordered", "bank"], ...] = ()
    """Evaluation: groupings; empty: those of the configuration."""
    paper: tuple[str, str] | None = None
    """(table, row) of the paper that stands beside it; None: the row of the same name in the table of the same name."""
    needs: str = ""
    """Option that names this row's own shards; without it the row is left out."""
    axis: float | None = None
    """Where the row lies on the table's axis; None: the rows are names."""


@dataclass(frozen=True)
class Table:
    """A table of the paper, or of ours."""

    title: str
    rows: dict[str, Row]
    axis: str = ""
    """What the rows' numbers count, where they do."""
    logarithmic: bool = False
    """Whether the axis is drawn so."""
    sets: tuple[str, ...] = ("pitts30k", "tokyo247", "msls_val")
    """The sets of the paper's table."""
    series: tuple[str, ...] = ()
    """Endings of row names that are lines of their own in the figure."""
    paired: tuple[tuple[tuple[str, str], tuple[str, str]], ...] = ()
    """Pairs of (row, grouping) whose difference is given with an interval over their common queries."""


EVERY_GROUPING: tuple[Literal["single", "shuffled", "ordered", "bank"], ...] = ("single", "shuffled", "ordered", "bank")


def _named(*names: str) -> dict[str, Row]:
    return {name: Row(variant=name) for name in names}


def _axis(values: tuple[float, ...], setting: str) -> dict[str, Row]:
    rows: dict[str, Row] = {}
    for value in values:
        varied: dict[str, Any] = {setting: value}
        rows[f"{value:g}"] = Row(axis=value, **varied)
    return rows


def _mined() -> dict[str, Row]:
    """Order of batches, and its control, each trained as published and jointly; near places count unless said."""
    orders: dict[str, dict[str, Any]] = {
        "city": {"data.order": "city"},
        "mined": {"data.order": "mined", "data.mine_from": "single"},
        "permuted": {"data.order": "mined", "data.mine_from": "permuted"},
        "mined, near ignored": {"data.order": "mined", "data.mine_from": "single", "loss.ignore_within": 25.0},
    }
    passes: dict[str, dict[str, Any]] = {"": {"train.passes": "group"}, "+joint": {"train.passes": "joint"}}
    near = {"loss.ignore_within": 0.0}
    return {
        name + ending: Row(changes=near | order | way, groups=("single", "bank"))
        for ending, way in passes.items()
        for name, order in orders.items()
    }


MINED_PAIRS = tuple(
    ((first + ending, grouping), (second + ending, grouping))
    for ending in ("", "+joint")
    for first, second in (("city", "mined"), ("permuted", "mined"), ("mined", "mined, near ignored"))
    for grouping in ("single", "bank")
)


TABLES: dict[str, Table] = {
    "ablation_crica": Table(
        "Ablation on cross-image awareness",
        _named(
            "FrozenDINOv2-SPM",
            "AdaptGeM",
            "AdaptSPMG",
            "AdaptSPM",
            "AdaptGeM+Crica",
            "AdaptSPMG+Crica",
            "AdaptSPM+Crica",
        ),
    ),
    "ablation_adaptation": Table(
        "Ablation on adaptation of the backbone",
        _named(
            "FrozenDINOv2-GeM",
            "MulConvAdapter-GeM",
            "FrozenDINOv2",
            "FullTunedDINOv2",
            "VanillaAdapter",
            "ConvAdapter",
            "MulConvAdapter",
        ),
    ),
    "dimensions": Table(
        "Descriptor dimensions kept by PCA",
        {**_axis((512, 1024, 2048, 4096), "pca"), "10752": Row(axis=10752)},
        axis="dimensions at the paper's size",
        logarithmic=True,
    ),
    "epochs": Table("Training epochs", _axis((10, 5, 1, 0.1), "epochs"), axis="epochs", logarithmic=True),
    "encoder_layers": Table(
        "Layers of the cross-image encoder",
        {str(n): Row(changes={"model.cross_image.layers": n}, axis=n) for n in range(4)},
        axis="encoder layers",
    ),
    "train_batch": Table(
        "Places of a training batch, without and with the cross-image encoder",
        {
            f"{places}{ending}": Row(variant=name, places=places, axis=places)
            for name, ending in (("AdaptSPM", ""), ("CricaVPR", "+Crica"))
            for places in (16, 32, 64, 72)
        },
        axis="places of a batch at the paper's size",
        series=("", "+Crica"),
    ),
    "inference_batch": Table(
        "Images of an inference batch", _axis((1, 4, 8, 16, 32), "group"), axis="images", logarithmic=True
    ),
    "kernels": Table("Kernels of the adapter", {**_named("1x1", "3x3", "5x5"), "MulConv": Row()}),
    "spm": Table(
        "Spatial pyramid without the cross-image encoder",
        _named("FrozenDINOv2-GeM", "FrozenDINOv2-SPM", "AdaptGeM", "AdaptSPM"),
    ),
    "same_data": Table(
        "Methods trained on the same data",
        {
            "NetVLAD": Row(variant="NetVLAD", paper=("", "NetVLAD-GSV-Cities")),
            "CosPlace": Row(variant="CosPlace", paper=("", "CosPlace-GSV-Cities")),
            "GeM": Row(variant="GeM"),
            "MixVPR": Row(variant="MixVPR"),
            "SALAD": Row(variant="SALAD"),
            "BoQ": Row(variant="BoQ"),
            "CricaVPR": Row(paper=("sota", "CricaVPR")),
            "CricaVPR on Pitts30k": Row(needs="pitts30k_shards", paper=("", "CricaVPR*")),
        },
        sets=("pitts30k", "pitts250k", "msls_val"),
    ),
    "one_photo": Table(
        "One photo is enough (a table of ours)",
        {
            "group": Row(changes={"train.passes": "group"}, groups=EVERY_GROUPING),
            "alone": Row(changes={"model.cross_image.alone": True}, groups=("single",)),
            "joint": Row(changes={"train.passes": "joint"}, groups=EVERY_GROUPING),
        },
        paired=(
            (("group", "single"), ("group", "bank")),
            (("group", "single"), ("joint", "single")),
            (("alone", "single"), ("joint", "single")),
            (("joint", "single"), ("joint", "bank")),
            (("group", "bank"), ("joint", "bank")),
            (("group", "shuffled"), ("joint", "single")),
            (("group", "ordered"), ("joint", "single")),
            (("group", "ordered"), ("joint", "bank")),
        ),
    ),
    "parts": Table(
        "What each part is worth (a table of ours)",
        {
            "CricaVPR, Kaiming init": Row(
                changes={"model.adapter.init": "kaiming"}, paper=("ablation_crica", "AdaptSPM+Crica")
            ),
            "CricaVPR, published init": Row(
                changes={"model.adapter.init": "published"}, paper=("ablation_crica", "AdaptSPM+Crica")
            ),
            "VanillaAdapter": Row(variant="VanillaAdapter", paper=("ablation_adaptation", "VanillaAdapter")),
            "encoder, each image alone": Row(
                changes={"model.adapter.init": "kaiming", "model.cross_image.alone": True},
            ),
            "no cross-image encoder": Row(
                variant="AdaptSPM", changes={"model.adapter.init": "kaiming"}, paper=("ablation_crica", "AdaptSPM")
            ),
        },
    ),
    "mined": Table("Mined batches, and what they are compared with (a table of ours)", _mined(), paired=MINED_PAIRS),
}


def table(name: str) -> Table:
    """A table by its name. Raises `UsageError` with the nearest known one."""
    if name in TABLES:
        return TABLES[name]
    near = difflib.get_close_matches(name, TABLES, n=1, cutoff=0.5)
    hint = f"did you mean '{near[0]}'? " if near else ""
    raise UsageError(f"unknown table '{name}'; {hint}known: {', '.join(TABLES)}, sota, challenging")


def check_rows(names: Sequence[str], known: Collection[str]) -> None:
    """Raises `UsageError` for a row that a table does not have."""
    for name in names:
        if name not in known:
            raise UsageError(f"--rows: the table has no row '{name}'; it has {', '.join(map(repr, known))}")


def with_rows(whole: Table, names: Sequence[str]) -> Table:
    """The table with the rows of these names alone, in its own order. Raises `UsageError` for one it does not have."""
    check_rows(names, whole.rows)
    return dataclasses.replace(whole, rows={name: row for name, row in whole.rows.items() if name in names})
