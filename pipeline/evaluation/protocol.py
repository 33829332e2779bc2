"""The protocol of a recall: everything that changes the number and is not the model or the photographs.

Invariant: groups are formed from positions in the dataset's sorted order, database and queries apart, before any work
is dealt to processes; so a descriptor depends on the protocol and never on the number of processes. The last group of
an evaluation set holds what is left over and may be short, as in the published evaluation.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np

from pipeline.common.errors import DataError, UsageError
from pipeline.config import EvaluationConfig
from pipeline.config.image_size import ImageSize
from pipeline.evaluation.search.approximate import CODES
from pipeline.model.bank import Bank

METRIC = re.compile(
    r"(?P<kind>\w+)/(?P<set>.+)\.(?P<protocol>(?:single|shuffled|ordered|bank).*)\.recall_at_(?P<k>\d+)"
)

SECOND_STAGES = {
    "patches": "matching patches in space",
    "patch-netvlad": "Patch-NetVLAD (RANSAC)",
    "patch-netvlad-rss": "Patch-NetVLAD (rapid spatial scoring)",
    "transvpr": "TransVPR's key patches (RANSAC)",
}
Side = Literal["database", "queries"]
WORD = 40  # characters of a value in a protocol's name


Stage = Literal["descriptors", "answers"]


def named(short: str, stage: Stage, default: Any = dataclasses.MISSING) -> Any:
    """A field of a protocol.

    Args:
        short: how a value other than the default stands in the protocol's name; `{}` is the value.
        stage: whether descriptors depend on it, or only what is answered from them.
        default: not told in the name; a field without one always is.
    """
    return dataclasses.field(default=default, metadata={"short": short, "stage": stage})


@dataclass(frozen=True)
class Protocol:
    """How descriptors were computed and compared (paper, section 4.1, and the batch that its code implies).

    Invariant: protocols that differ have different names, because the name is made of all fields that differ from
    their defaults. Only the digest of a bank is not in the name; it is in the `Identity` of what is kept.
    """

    groups: str = named("{}", "descriptors")
    """single: each image alone; shuffled: seeded random groups; ordered: neighbours in file order (as published);
    bank: each image beside a fixed bank of images."""
    group_size: int = named("{}", "descriptors", 1)
    """Images that share one pass of the cross-image encoder; 1 for single; for bank the images of the bank."""
    group_seed: int = named("s{}", "descriptors", 0)
    """Seed of the shuffled groups; 0 and without effect otherwise."""
    bank_from: str = named("{}", "descriptors", "train")
    """bank: train, map, or the folder's name."""
    bank_digest: str = named("", "descriptors", "")
    """bank: sixteen hex digits of its regions; empty before it is known. It is in the identity, not in the name."""
    pca: int | None = named("_pca{}", "answers", None)
    """Dimensions kept by PCA; None keeps all."""
    whiten: bool = named("w", "answers", False)
    """Whether PCA also scales each direction to unit variance."""
    pca_source: str | None = named("_from-{}", "answers", None)
    """Whose database descriptors PCA was fitted on; None: the evaluated set's own."""
    prefix: int | None = named("_prefix{}", "answers", None)
    """Dimensions kept from the beginning of the descriptor, of unit length again; None keeps all."""
    resize: str = named("_{}", "descriptors", "antialias")
    """antialias, or published: normalised first, then bilinear without antialias."""
    image_size: int | str = named("_{}px", "descriptors", 224)
    """Of the input, pixels: a side (224), "480x640", or "native640": the photo's own shape, at most 640 long."""
    rule: str = named("_{}", "answers", "25 m")
    """What counts as a positive, for example "25 m"."""
    without_positives: str = named("_{}", "answers", "miss")
    """miss or drop: what happens to queries that have no positive."""
    precision: str = named("_{}", "descriptors", "fp32")
    """Arithmetic of the per-image part: fp32, bf16 or fp16 autocast."""
    stored: str = named("_{}store", "descriptors", "fp32")
    """Type in which descriptors were kept before the search: fp32 or fp16."""
    search: str = named("_{}", "answers", "exact")
    """exact L2, or the approximate index used."""
    refine: int = named("_refine{}", "answers", 0)
    """Candidates of an index of codes that float descriptors put in order anew; 0: none."""
    rerank: int = named("_rerank{}", "answers", 0)
    """Candidates put in order anew by matching patches in space (a second stage); 0: none, one stage."""
    rerank_by: str = named("-{}", "answers", "patches")
    """How they were matched: one of `pipeline.evaluation.search.rerank.RERANKERS`."""
    rerank_layer: int | None = named("l{}", "answers", None)
    """Block or stage of the backbone whose patches were matched; None: its last."""

    @property
    def name(self) -> str:
        """Short, and safe in metric names and file names: "shuffled16", "ordered8_pca4096", "single_322px_10m"."""
        told = ((field.metadata["short"], getattr(self, field.name), field.default) for field in fields(self))
        return "".join(short.format(_word(value)) for short, value, default in told if value != default)

    @property
    def grouping(self) -> Protocol:
        """The same protocol without what happens after the descriptors: PCA, positives, search."""
        later: dict[str, Any] = {f.name: f.default for f in fields(self) if f.metadata["stage"] == "answers"}
        return dataclasses.replace(self, **later)

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
        elif self.prefix:
            pca = f"the first {self.prefix} dimensions"
        missing = "a miss" if self.without_positives == "miss" else "dropped"
        layer = f", layer {self.rerank_layer}" if self.rerank_layer else ""
        second = f", first {self.rerank} re-ranked by {SECOND_STAGES[self.rerank_by]}{layer}" if self.rerank else ""
        floats = f", first {self.refine} ordered anew by float descriptors" if self.refine else ""
        kept = self.precision if self.stored == self.precision else f"{self.precision}, stored {self.stored}"
        size = ImageSize.of(self.image_size).text
        return (
            f"{groups}; {size} px {interpolation}; {pca}; {kept}; {self.search} L2 search{floats}{second}; "
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


def read_protocol(values: Any, where: str) -> Protocol:
    """The protocol of a file. Raises `DataError` where it is none of this version."""
    try:
        return Protocol(**values)
    except TypeError:
        raise DataError(f"{where}: not a protocol of this version; evaluate again") from None


def candidates(kind: str, config: EvaluationConfig) -> int:
    """The candidates that floats order anew in a search of this kind: 0 for one that has no codes.

    Raises:
        UsageError: fewer than are asked for.
    """
    wanted = max(*config.recalls, config.rerank)
    if kind in CODES and 0 < config.refine < wanted:
        raise UsageError(f"refine {config.refine} orders fewer candidates than are asked for ({wanted}); raise it")
    return config.refine if kind in CODES else 0


def protocols(config: EvaluationConfig, image_size: int | str, rule: str, bank: Bank | None = None) -> list[Protocol]:
    """The protocols that the configuration asks for, in its order; `bank`: the one that `groups` bank is beside.

    Raises:
        UsageError: settings that do not go together.
    """
    if config.pca and config.prefix:
        raise UsageError("give pca or prefix, not both")
    sizes = {"single": 1, "bank": config.bank if bank is None else len(bank.regions)}
    return [
        Protocol(
            groups=groups,
            group_size=sizes.get(groups, config.group_size),
            group_seed=config.group_seed if groups == "shuffled" else 0,
            image_size=image_size,
            resize=config.resize,
            pca=config.pca,
            prefix=config.prefix,
            rule=rule,
            without_positives=config.without_positives,
            whiten=config.pca_whiten and config.pca is not None,
            pca_source=config.pca_from if config.pca else None,
            precision=config.precision,
            stored="fp16" if config.store == "fp16" else "fp32",
            search=config.search,
            refine=candidates(config.search, config),
            rerank=config.rerank,
            rerank_by=config.rerank_by if config.rerank else "patches",
            rerank_layer=config.rerank_layer if config.rerank else None,
            bank_from="train" if groups != "bank" else config.bank_from if bank is None else bank.source,
            bank_digest=bank.digest if groups == "bank" and bank is not None else "",
        )
        for groups in dict.fromkeys(config.groups)
    ]


def _word(value: Any) -> str:
    """A value as letters, digits, points and hyphens; what that loses stands in six digits of its hash."""
    text = str(value)
    plain = re.sub(
        r"[^A-Za-z0-9.]+", "-", text.replace(" m", "m").replace("+-", "").replace(" frames", "frames")
    ).strip("-.")[:WORD]
    lossless = plain == text or re.fullmatch(r"[0-9.e]+ m|\+-[0-9]+ frames|listed positives|no ground truth", text)
    return plain if lossless else f"{plain}-{hashlib.sha256(text.encode()).hexdigest()[:6]}"


def metric_name(set_name: str, protocol: Protocol, k: int) -> str:
    """`<set>.<protocol>.recall_at_<k>`: MLflow accepts no '@' in names."""
    return f"{set_name}.{protocol.name}.recall_at_{k}"


def read_metric_name(name: str) -> tuple[str, str, str, int] | None:
    """(kind, set, protocol's name, k) of `<kind>/` and a `metric_name`, as MLflow holds it; None for other metrics.

    Names of sets and protocols may hold points; a protocol's name begins with its grouping.
    """
    found = METRIC.fullmatch(name)
    return None if found is None else (found["kind"], found["set"], found["protocol"], int(found["k"]))
