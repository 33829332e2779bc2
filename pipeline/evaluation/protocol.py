"""The protocol of a recall: everything that changes the number and is not the model or the photographs.

Invariant: groups are formed from positions in the dataset's sorted order, database and queries apart, before any work
is dealt to processes; so a descriptor depends on the protocol and never on the number of processes. The last group of
an evaluation set holds what is left over and may be short, as in the published evaluation.
"""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from pipeline.config import EvaluationConfig
from pipeline.model.bank import Bank

Side = Literal["database", "queries"]


@dataclass(frozen=True)
class Protocol:
    """How descriptors were computed and compared (paper, section 4.1, and the batch that its code implies)."""

    groups: str
    """single: each image alone; shuffled: seeded random groups; ordered: neighbours in file order (as published);
    bank: each image beside a fixed bank of images."""
    group_size: int
    """Images that share one pass of the cross-image encoder; 1 for single; for bank the images of the bank."""
    group_seed: int
    """Seed of the shuffled groups; 0 and without effect otherwise."""
    image_size: int
    """Side of the square input, pixels."""
    resize: str
    """antialias, or published: normalised first, then bilinear without antialias."""
    pca: int | None
    """Dimensions kept by PCA; None keeps all."""
    rule: str
    """What counts as a positive, for example "25 m"."""
    without_positives: str
    """miss or drop: what happens to queries that have no positive."""
    whiten: bool = False
    """Whether PCA also scales each direction to unit variance."""
    pca_source: str | None = None
    """Whose database descriptors PCA was fitted on; None: the evaluated set's own."""
    precision: str = "fp32"
    """Arithmetic of the per-image part: fp32, bf16 or fp16 autocast."""
    stored: str = "fp32"
    """Type in which descriptors were kept before the search: fp32 or fp16."""
    search: str = "exact"
    """exact L2, or the approximate index used."""
    rerank: int = 0
    """Candidates put in order anew by matching patches in space (a second stage); 0: none, one stage."""
    rerank_layer: int | None = None
    """Block or stage of the backbone whose patches were matched; None: its last."""

    bank_from: str = ""
    """bank: train, map, or the folder's name."""
    bank_digest: str = ""
    """bank: sixteen hex digits of its regions; empty before it is known."""

    @property
    def name(self) -> str:
        """Short and safe in metric names, for example "shuffled16" or "ordered8_pca4096"."""
        parts = [self.groups if self.groups == "single" else f"{self.groups}{self.group_size}"]
        if self.groups == "shuffled" and self.group_seed:
            parts[0] += f"s{self.group_seed}"
        if self.groups == "bank" and self.bank_from != "train":
            parts[0] += re.sub(r"[^A-Za-z0-9-]", "-", self.bank_from)  # "bank64map"
        if self.pca:
            parts.append(f"pca{self.pca}{'w' if self.whiten else ''}")
        if self.resize != "antialias":
            parts.append(self.resize)
        if self.without_positives == "drop":
            parts.append("drop")
        parts += [value for value in (self.precision, self.search) if value not in ("fp32", "exact")]
        if self.rerank:
            parts.append(f"rerank{self.rerank}" + (f"l{self.rerank_layer}" if self.rerank_layer else ""))
        if self.stored != "fp32":
            parts.append(f"{self.stored}store")
        return "_".join(parts)

    @property
    def grouping(self) -> Protocol:
        """The same protocol without what happens after the descriptors: PCA, positives, search."""
        return dataclasses.replace(
            self,
            pca=None,
            whiten=False,
            pca_source=None,
            rule="",
            without_positives="",
            search="exact",
            rerank=0,
            rerank_layer=None,
        )

    def describe(self) -> str:
        """One line for people."""
        known = f" ({self.bank_digest})" if self.bank_digest else ""
        groups = {
            "single": "each image alone",
            "shuffled": f"random groups of {self.group_size} (seed {self.group_seed})",
            "ordered": f"groups of {self.group_size} neighbours in file order",
            "bank": f"each image beside a bank of {self.group_size} images from {self.bank_from}{known}",
        }[self.groups]
        interpolation = "antialiased" if self.resize == "antialias" else "resized after normalising, no antialias"
        pca = "no PCA"
        if self.pca:
            pca = (
                f"PCA {self.pca}{' whitened' if self.whiten else ''} fitted on {self.pca_source or 'its own database'}"
            )
        missing = "a miss" if self.without_positives == "miss" else "dropped"
        layer = f" of layer {self.rerank_layer}" if self.rerank_layer else ""
        second = f", first {self.rerank} re-ranked by matching patches{layer} in space" if self.rerank else ""
        kept = self.precision if self.stored == self.precision else f"{self.precision}, stored {self.stored}"
        return (
            f"{groups}; {self.image_size} px {interpolation}; {pca}; {kept}; {self.search} L2 search{second}; "
            f"positives {self.rule}; queries without positives {missing}"
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as written beside every result."""
        return dataclasses.asdict(self)

    def form(self, images: int, side: Side, together: int = 1) -> list[np.ndarray]:
        """The groups of `images` images as arrays of positions (int64), covering each position once.

        `together` consecutive groups share an array: an array an image takes more memory than the image's row number.

        Shuffled groups of database and queries come from different streams: were they the same, paired sets (frame i
        of the queries is frame i of the database) would group both sides alike and leak the answer.
        """
        order = np.arange(images, dtype=np.int64)
        if self.groups == "shuffled":
            # the raw stream of Philox is fixed for ever, where numpy's own shuffles may change between versions
            bits = np.random.Philox(key=[self.group_seed, int(side == "queries")]).random_raw(images)
            order = np.argsort(bits, kind="stable").astype(np.int64)
        size = together if self.groups == "bank" else self.group_size * together
        return [order[first : first + size] for first in range(0, images, size)]


def protocols(config: EvaluationConfig, image_size: int, rule: str, bank: Bank | None = None) -> list[Protocol]:
    """The protocols that the configuration asks for, in its order; `bank`: the one that `groups` bank is beside."""
    sizes = {"single": 1, "bank": config.bank if bank is None else len(bank.regions)}
    return [
        Protocol(
            groups=groups,
            group_size=sizes.get(groups, config.group_size),
            group_seed=config.group_seed if groups == "shuffled" else 0,
            image_size=image_size,
            resize=config.resize,
            pca=config.pca,
            rule=rule,
            without_positives=config.without_positives,
            whiten=config.pca_whiten and config.pca is not None,
            pca_source=config.pca_from if config.pca else None,
            precision=config.precision,
            stored="fp16" if config.store == "fp16" else "fp32",
            search=config.search,
            rerank=config.rerank,
            rerank_layer=config.rerank_layer if config.rerank else None,
            bank_from="" if groups != "bank" else config.bank_from if bank is None else bank.source,
            bank_digest=bank.digest if groups == "bank" and bank is not None else "",
        )
        for groups in dict.fromkeys(config.groups)
    ]


def metric_name(set_name: str, protocol: Protocol, k: int) -> str:
    """`<set>.<protocol>.recall_at_<k>`: MLflow accepts no '@' in names."""
    return f"{set_name}.{protocol.name}.recall_at_{k}"
