"""Every setting of a run, as typed frozen dataclasses: the one source of the YAML keys, the command line and `--help`.

Invariant: nothing here imports torch, so `--help` is instant; a field's docstring says what it means, its unit and,
where the paper (Lu et al., CricaVPR, CVPR 2024) fixes it, the paper's value. Defaults are the published settings
except where the docstring says "ours".
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pipeline.common.errors import UsageError
from pipeline.config.model import AdapterConfig as AdapterConfig
from pipeline.config.model import BackboneConfig as BackboneConfig
from pipeline.config.model import CrossImageConfig as CrossImageConfig
from pipeline.config.model import ModelConfig as ModelConfig
from pipeline.config.model import PoolingConfig as PoolingConfig
from pipeline.config.setting import (
    OnResume,
    SettingError,
    Settings,
    check,
    is_section,
    present_name,
    setting,
    shortened,
    type_hints,
    unknown,
)

MANY = 1024  # processes, or batches ahead, that no machine needs
SEEDS = 2**31 - 1  # the largest seed: a step's own seed has it in its upper half
MONTH = 2_592_000  # seconds
UNLESS_COSINE: OnResume = "free unless train.schedule=cosine"  # whose rate follows the length of the run


@dataclass(frozen=True)
class DataConfig(Settings):
    """What is trained on, in which order, and how images are prepared."""

    shards: tuple[str, ...] | str = setting("data/shards", changes="numbers", resume="free")
    """Folder, or any fsspec URL, of a shard set made by jobs.prepare; or a list, `[a, b]`: one training over all."""
    shard_weights: tuple[float, ...] = setting((), changes="numbers", above=0, at_most=100, may_be_empty=True)
    """How often a place of each set comes in an epoch, above 0: 0.5 half of the places, 2 each twice (never in one
    batch); empty: 1 for each set."""
    places_per_batch: int = setting(72, changes="numbers", at_least=1)
    """Places in the global batch, over all ranks; four images each (paper: 72, so 288 images)."""
    order: Literal["city", "mixed", "blocked", "mined"] = setting("city", changes="numbers")
    """Order of places: in-city batches (as published in effect), mixed over cities, within windows of shards, or
    in-city batches of places that look alike to the model (mined; the first epoch is as city)."""
    mine_from: str = setting("single", changes="numbers")
    """mined: what tells that places look alike. single: each image alone, by the model being trained; bank: beside its
    bank; permuted: single, shuffled among the places of each city, a control without hardness; or a file of jobs.mine.
    """
    mine_every: int = setting(1, changes="numbers", at_least=1)
    """mined: epochs between two minings, the first before the second epoch. Not used with a file."""
    clique: int = setting(6, changes="numbers", at_least=2)
    """mined: places that are grouped because they look alike; a batch is made of such groups."""
    mine_neighbours: int = setting(64, changes="numbers", at_least=1, at_most=1024)
    """mined: most similar places of the same city that a group is drawn from."""
    mine_radius: float = setting(25.0, changes="numbers", at_least=0)
    """mined: no two places of a group lie closer than this, in metres; 0: positions are not used."""
    mine_temperature: float = setting(0.05, changes="numbers", at_least=0, at_most=1000)
    """mined: randomness of the draw, in units of cosine similarity; 0 takes the most similar ones."""
    window_shards: int = setting(8, changes="numbers", at_least=1)
    """Shards read together by order=blocked."""
    image_size: int = setting(224, changes="numbers", at_least=1, at_most=8192)
    """Side of the square input, in pixels; a multiple of the patch size (paper: 224)."""
    augment: Literal["rand", "light", "off"] = setting("rand", changes="numbers")
    """RandAugment as published; a light colour jitter and crop; or nothing."""
    rand_ops: int = setting(3, changes="numbers", at_least=0, at_most=16)
    """RandAugment: operations an image (paper: 3)."""
    rand_magnitude: int = setting(9, changes="numbers", at_least=0, at_most=30)
    """RandAugment: magnitude out of 30 (published: 9)."""
    workers: int = setting(4, changes="speed", at_least=0, at_most=MANY)
    """Decoding processes a rank; 0 decodes in the training process."""
    prefetch: int = setting(2, changes="speed", at_least=1, at_most=MANY)
    """Batches each worker prepares ahead."""
    cache: str = setting("data/cache", changes="none")
    """Local folder for shards fetched from a URL."""
    cache_gb: float = setting(50.0, changes="speed", above=0)
    """Bound of that cache in GB (10^9 bytes)."""


@dataclass(frozen=True)
class LossConfig(Settings):
    """Multi-similarity loss with online mining (paper, Eq. 5)."""

    alpha: float = setting(1.0, changes="numbers", above=0)
    """Weight of positives (paper: 1)."""
    beta: float = setting(50.0, changes="numbers", above=0)
    """Weight of negatives (paper: 50)."""
    base: float = setting(0.0, changes="numbers", at_least=-1, at_most=1)
    """The similarity threshold lambda (paper: 0)."""
    margin: float = setting(0.1, changes="numbers", at_least=0, at_most=2)
    """Mining margin (paper: 0.1)."""
    ignore_within: float = setting(0.0, changes="numbers", at_least=0)
    """Pairs of different places closer than this many metres are neither positive nor negative; 0: none (published)."""


@dataclass(frozen=True)
class EvaluationConfig(Settings):
    """Which sets are searched, under which protocols. A recall means nothing without these."""

    sets: tuple[str, ...] = setting((), changes="numbers", may_be_empty=True)
    """Folders of evaluation sets, `<dataset>/images/<split>/{database,queries}`, or a set's name under `root`."""
    root: str = setting("data", changes="numbers")
    """Folder under which set names are looked up."""
    split: Literal["train", "val", "test"] = setting("test", changes="numbers")
    """Split of the folder layout."""
    groups: tuple[Literal["single", "shuffled", "ordered", "bank"], ...] = setting(
        ("single", "shuffled", "ordered"), changes="numbers"
    )
    """Which images share an inference batch: each alone, seeded random groups, neighbours in file order (the paper's
    way), or each image beside a fixed bank of images (ours; docs/one_photo.md)."""
    group_size: int = setting(16, changes="numbers", at_least=1)
    """Images a group for shuffled and ordered (paper: 16; 8 on Pittsburgh)."""
    group_seed: int = setting(0, changes="numbers", at_least=0, at_most=SEEDS)
    """Seed of the shuffled grouping."""
    bank: int = setting(64, changes="numbers", at_least=1, at_most=65_536)
    """Images in the bank; all there are where they are fewer. Training saves a bank of so many beside its weights."""
    bank_from: str = setting("train", changes="numbers")
    """Whose images: train (the bank saved beside the weights), map (drawn from each set's database), or a folder."""
    recalls: tuple[int, ...] = setting((1, 5, 10, 20), changes="numbers", at_least=1, at_most=10_000)
    """The N of Recall@N."""
    radius: float = setting(25.0, changes="numbers", at_least=0, at_most=100_000)
    """Metres within which a database image is a positive, inclusive (paper: 25)."""
    frames: int | None = setting(None, changes="numbers", at_least=0)
    """For sequences without positions: positives are +- this many frames instead of metres."""
    without_positives: Literal["miss", "drop"] = setting("miss", changes="numbers")
    """Queries that have no positive count as a miss, or are dropped (MSLS's own tool)."""
    resize: Literal["antialias", "published"] = setting("antialias", changes="numbers")
    """antialias: resize as in training, then normalise; published: normalise, then resize without antialias."""
    pca: int | None = setting(None, changes="numbers", at_least=1)
    """Dimensions kept by PCA; none keeps all (paper: 4096)."""
    batch: int = setting(32, changes="speed", at_least=1, at_most=65_536)
    """Images a forward pass of the per-image part; memory only, never the result."""
    workers: int = setting(4, changes="speed", at_least=0, at_most=MANY)
    """Decoding processes a rank; 0 decodes in the evaluating process."""
    precision: Literal["fp32", "bf16", "fp16"] = setting("fp32", changes="numbers")
    """Autocast of the per-image part; the cross-image encoder and the search stay in fp32."""
    store: Literal["none", "fp32", "fp16"] = setting("none", changes="numbers")
    """Keep descriptors as Parquet under the output folder, in this type; they are reused when nothing changed."""
    pca_from: str | None = setting(None, changes="numbers")
    """Set whose database PCA is fitted on, at most 16,384 images (paper: Pitts30k train); none: each set's own."""
    pca_whiten: bool = setting(False, changes="numbers")
    """Scale PCA's directions to unit variance (published: no)."""
    search: Literal["exact", "ivfpq", "hnsw"] = setting("exact", changes="numbers")
    """Exact L2 search, or a faiss approximation for large sets, whose recall against exact is measured and printed."""
    rerank: int = setting(0, changes="numbers", at_least=0, at_most=10_000)
    """Second stage: this many first candidates are put in order by matching patch tokens in space; 0: none. Reads the
    candidates' images again; not for validation during training."""
    rerank_layer: int | None = setting(None, changes="numbers", at_least=1)
    """Block (transformer) or stage (ResNet, VGG) of the backbone whose patches are matched, from 1; none: its last."""


@dataclass(frozen=True)
class TrainConfig(Settings):
    """Optimisation, checkpoints and stopping."""

    epochs: int = setting(10, changes="numbers", at_least=1, resume=UNLESS_COSINE)
    """Epochs over the plan (paper: 10)."""
    steps: int | None = setting(None, changes="numbers", at_least=1, resume=UNLESS_COSINE)
    """Stop after this many steps, whatever the epochs; none: no limit."""
    optimizer: Literal["adam", "adamw", "sgd"] = setting("adam", changes="numbers")
    """Optimiser (paper: Adam)."""
    lr: float = setting(1e-4, changes="numbers", above=0)
    """Learning rate (paper: 1e-4)."""
    weight_decay: float = setting(0.0, changes="numbers", at_least=0)
    """Weight decay (published: 0)."""
    schedule: Literal["step", "cosine", "constant"] = setting("step", changes="numbers")
    """step halves the rate every `step_epochs` (paper); cosine decays to 0; both stepped per iteration."""
    step_epochs: float = setting(3.0, changes="numbers", above=0)
    """schedule=step: epochs between two reductions (paper: 3)."""
    step_factor: float = setting(0.5, changes="numbers", above=0, at_most=1)
    """schedule=step: factor of a reduction (paper: 0.5)."""
    warmup_steps: int = setting(0, changes="numbers", at_least=0)
    """Linear warm-up in steps (published: 0)."""
    max_grad_norm: float | None = setting(None, changes="numbers", above=0, formerly="clip")
    """Largest norm of the gradient; none: no clipping (published: none)."""
    passes: Literal["group", "joint"] = setting("group", changes="numbers")
    """group: each image is described in the global batch (paper). joint (ours): from the same regions also alone, and
    one loss is taken over both descriptions of all images, so that the weights also serve a single photo. The backbone
    runs once; needs a cross-image encoder."""
    validate_first: bool = setting(True, changes="none")
    """Evaluate the untrained model before the first step, so that a run shows what training added."""
    patience: int = setting(3, changes="numbers", at_least=0, resume="free")
    """Stop after this many epochs without a better validation R@5 (paper: 3); 0 never stops early."""
    encode_chunk: int | None = setting(None, changes="speed", at_least=1)
    """Images encoded at a time on a rank, recomputed in backward; none: all at once. Always exact. Memory then does not
    grow with the batch for adapter.norm group or none; with batch it grows slower, as BatchNorm needs all images."""
    compile: bool = setting(False, changes="speed")
    """torch.compile the backbone's blocks; for one process and DDP, without encode_chunk. Not used in validation."""
    engine: Literal["auto", "ddp", "fsdp2"] = setting("auto", changes="speed")
    """auto: what accelerate was launched with (DDP, DeepSpeed); fsdp2 shards parameters with fully_shard."""
    save_every: int = setting(200, changes="none", at_least=1)
    """Steps between two saves of the last checkpoint; also at each epoch's end and on SIGTERM or SIGUSR1."""
    keep: int = setting(2, changes="none", at_least=1)
    """Step checkpoints kept beside the best one."""
    resume: str = setting("auto", changes="none")
    """auto continues the run folder's last checkpoint where there is one; never starts anew (and refuses to
    overwrite); or the path of a checkpoint."""
    log_every: int = setting(10, changes="none", at_least=1)
    """Steps between two progress lines and metric records."""
    timeout: float = setting(600.0, changes="none", above=0, at_most=MONTH)
    """Seconds a rank waits for the others in a collective before the job ends with an error."""
    log_samples: bool = setting(False, changes="none")
    """Write the sample keys of each step to samples.rank<r>.jsonl, the proof that nothing is repeated or skipped."""


@dataclass(frozen=True)
class TrackingConfig(Settings):
    """MLflow."""

    uri: str | None = setting(None, changes="none")
    """Tracking server or store; none: MLFLOW_TRACKING_URI, else sqlite in `<output>/mlflow.db`."""
    experiment: str = setting("place-recognition", changes="none")
    """Experiment name."""
    enabled: bool = setting(True, changes="none")
    """False records nothing."""


@dataclass(frozen=True)
class RunConfig(Settings):
    """A training run."""

    name: str = setting("cricavpr", changes="none", file_name=True)
    """Name of the run and of its folder under `output`."""
    output: str = setting("outputs", changes="none")
    """Folder of all runs."""
    seed: int = setting(0, changes="numbers", at_least=0, at_most=SEEDS)
    """Seed of initialisation, plan, augmentation and dropout."""
    data: DataConfig = field(default_factory=DataConfig)
    """Training data."""
    model: ModelConfig = field(default_factory=ModelConfig)
    """Model."""
    loss: LossConfig = field(default_factory=LossConfig)
    """Loss."""
    train: TrainConfig = field(default_factory=TrainConfig)
    """Training."""
    validate: EvaluationConfig = field(
        default_factory=lambda: EvaluationConfig(split="val", groups=("shuffled",)),
        metadata={"resume": "free"},  # no step depends on it
    )
    """Evaluated after each epoch, best checkpoint chosen by R@5 of the first set and grouping; empty `sets`: none."""
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    """Where runs are recorded."""

    @classmethod
    def from_yaml(cls, path: str | Path, changes: Mapping[str, Any] | None = None) -> RunConfig:
        """The config of a file, what it leaves out by default; then `changes`, such as {"train.epochs": 1}.

        Raises:
            UsageError: no such file, not YAML, an unknown setting, or a value outside its type or range.
        """
        from pipeline.config.words import file_settings

        built: RunConfig = from_dict(cls, nested(dict(file_settings(cls, str(path))) | dict(changes or {})))
        return built


def to_dict(config: Any) -> dict[str, Any]:
    """The config as plain YAML-able values: nested dicts, tuples as lists."""
    plain: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(config)))
    return plain


def flatten(config: Any) -> dict[str, Any]:
    """The config as one level with dotted keys, `data.places_per_batch`, as logged to MLflow."""
    flat: dict[str, Any] = {}

    def walk(prefix: str, value: Any) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                walk(f"{prefix}.{key}" if prefix else key, inner)
        else:
            flat[prefix] = value

    walk("", to_dict(config))
    return flat


def changed(config: Any, default: Any) -> dict[str, Any]:
    """Dotted name -> value of the settings in which a config differs from another."""
    before = flatten(default)
    return {name: value for name, value in flatten(config).items() if value != before.get(name)}


def nested(flat: Any) -> dict[str, Any]:
    """The opposite of `flatten`: `{"data.order": x}` -> `{"data": {"order": x}}`.

    Raises:
        UsageError: it is no such dict.
    """
    if not isinstance(flat, dict):
        raise UsageError(f"the config must be settings with dotted names; it is {shortened(flat)}")
    values: dict[str, Any] = {}
    for name, value in flat.items():
        *sections, last = str(name).split(".")
        inner: Any = values
        for section in sections:
            inner = inner.setdefault(section, {})
            if not isinstance(inner, dict):
                raise UsageError(f"{shortened(name)} stands beside a setting {shortened(section)}")
        inner[last] = value
    return values


def from_dict(kind: type, values: Any, where: str = "", base: Any = None) -> Any:
    """Builds dataclass `kind` from plain values, as in a checkpoint, also one written under a setting's former name.

    Args:
        kind: a config class.
        values: a dict of its settings and, nested, its sections.
        where: dotted prefix of the settings' names in errors, for example "validate.".
        base: gives what `values` leave out; the defaults where it is None.

    Raises:
        UsageError: an unknown setting (with the nearest known name), or a value outside its type or range.
    """
    if not isinstance(values, dict):
        raise UsageError(
            f"{where.rstrip('.') or 'the config'} must be a section of settings; it is {shortened(values)}"
        )
    hints, built, base = type_hints(kind), {}, kind() if base is None else base
    for given, value in values.items():
        name = present_name(kind, str(given))
        if name not in hints:
            raise unknown(f"{where}{given}", [f"{where}{known}" for known in hints])
        if is_section(hints[name]) and not is_section(value):
            value = from_dict(hints[name], value, f"{where}{name}.", getattr(base, name))
        built[name] = value
    try:
        config = dataclasses.replace(base, **built)
        check(config)  # a job's own class may be a plain dataclass
        return config
    except SettingError as error:
        raise error.prefix(where) from None
