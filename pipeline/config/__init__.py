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
from pipeline.common.text import without_passwords
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
SearchKind = Literal["exact", "int8", "binary", "ivfpq", "hnsw"]
UNLESS_COSINE: OnResume = "free unless train.schedule=cosine"  # whose rate follows the length of the run


@dataclass(frozen=True)
class DataConfig(Settings):
    """What is trained on, in which order, and how images are prepared."""

    shards: tuple[str, ...] | str = setting("data/shards", changes="numbers", resume="free")
    """Folder, or any fsspec URL, of a shard set made by jobs.prepare; or a list, `[a, b]`: one training over all."""
    shard_weights: tuple[float, ...] = setting((), changes="numbers", above=0, at_most=100, may_be_empty=True)
    """How often a place of each set comes in an epoch: 0.5 uses half of the places, 2 uses each place twice (in
    different batches); empty: 1 for each set."""
    places_per_batch: int = setting(72, changes="numbers", at_least=1)
    """Places in the global batch, over all ranks; four images each (paper: 72, so 288 images)."""
    order: Literal["city", "mixed", "blocked", "mined"] = setting("city", changes="numbers")
    """Order of places. city: each batch from one city (as published in effect); mixed: over all cities; blocked: within
    windows of shards; mined: as city, from places that look alike to the model (the first epoch is as city)."""
    mine_from: str = setting("single", changes="numbers")
    """mined: whose descriptors find places that look alike. single: the trained model's, each image alone; bank: beside
    its bank; permuted: single, shuffled among the places of each city (the control); or a file of jobs.mine."""
    mine_every: int = setting(1, changes="numbers", at_least=1)
    """mined: epochs between two minings, the first before the second epoch. Not used with a file."""
    clique: int = setting(6, changes="numbers", at_least=2)
    """mined: places in a group of places that look alike; a batch is made of such groups."""
    mine_neighbours: int = setting(64, changes="numbers", at_least=1, at_most=1024)
    """mined: a group is drawn from this many most similar places of the same city."""
    mine_radius: float = setting(25.0, changes="numbers", at_least=0)
    """mined: no two places of a group lie closer than this, in metres; 0: positions are not used."""
    mine_temperature: float = setting(0.05, changes="numbers", at_least=0, at_most=1000)
    """mined: randomness of the draw, in units of cosine similarity; 0 draws the most similar places."""
    window_shards: int = setting(8, changes="numbers", at_least=1)
    """Shards read together by order=blocked."""
    image_size: str | int = setting(224, changes="numbers", image_size="fixed")
    """Size of the input in pixels: a side (`224`, paper), or height x width (`224x308`); multiples of the patch."""
    augment: Literal["rand", "light", "off"] = setting("rand", changes="numbers")
    """rand: RandAugment as published; light: small changes of colour and crop; off: nothing."""
    rand_ops: int = setting(3, changes="numbers", at_least=0, at_most=16)
    """RandAugment: operations per image (paper: 3)."""
    rand_magnitude: int = setting(9, changes="numbers", at_least=0, at_most=30)
    """RandAugment: magnitude out of 30 (published: 9)."""
    workers: int = setting(4, changes="speed", at_least=0, at_most=MANY)
    """Decoding processes per rank; 0 decodes in the training process."""
    prefetch: int = setting(2, changes="speed", at_least=1, at_most=MANY)
    """Batches each worker prepares ahead."""
    cache: str = setting("data/cache", changes="none")
    """Local folder for shards fetched from a URL."""
    cache_gb: float = setting(50.0, changes="speed", above=0)
    """Largest size of that cache in GB (10^9 bytes)."""


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
    prefixes: tuple[int, ...] = setting((), changes="numbers", at_least=1, may_be_empty=True)
    """Also the loss of the first so many dimensions of each descriptor, of unit length again, added for each number
    (Matryoshka, Kusupati et al. 2022): descriptors can then be cut there; empty: none (published)."""


@dataclass(frozen=True)
class EvaluationConfig(Settings):
    """Which sets are evaluated, under which protocols."""

    sets: tuple[str, ...] = setting((), changes="numbers", may_be_empty=True)
    """Folders of evaluation sets, `<dataset>/images/<split>/{database,queries}`, or a set's name under `root`."""
    root: str = setting("data", changes="numbers")
    """Folder under which set names are looked up."""
    split: Literal["train", "val", "test"] = setting("test", changes="numbers")
    """Split of the folder layout."""
    groups: tuple[Literal["single", "shuffled", "ordered", "bank"], ...] = setting(
        ("single", "shuffled", "ordered"), changes="numbers"
    )
    """Images that are described together. single: each alone; shuffled: seeded random groups; ordered: neighbours in
    file order (paper); bank: each beside a fixed bank of images (ours; docs/one_photo.md)."""
    group_size: int = setting(16, changes="numbers", at_least=1)
    """Images per group for shuffled and ordered (paper: 16; 8 on Pittsburgh)."""
    group_seed: int = setting(0, changes="numbers", at_least=0, at_most=SEEDS)
    """Seed of the shuffled grouping."""
    bank: int = setting(64, changes="numbers", at_least=1, at_most=65_536)
    """Largest number of images in the bank. Training saves a bank of this size beside its weights."""
    bank_from: str = setting("train", changes="numbers")
    """Images of the bank: train (saved beside the weights), map (drawn from each set's database), or a folder."""
    recalls: tuple[int, ...] = setting((1, 5, 10, 20), changes="numbers", at_least=1, at_most=10_000)
    """The N of Recall@N."""
    radius: float = setting(25.0, changes="numbers", at_least=0, at_most=100_000)
    """Metres within which a database image is a positive, inclusive (paper: 25)."""
    frames: int | None = setting(None, changes="numbers", at_least=0)
    """Sequences without positions: database images within this many frames are positives."""
    without_positives: Literal["miss", "drop"] = setting("miss", changes="numbers")
    """Queries without a positive: count them as a miss, or drop them (as MSLS's own tool does)."""
    resize: Literal["antialias", "published"] = setting("antialias", changes="numbers")
    """antialias: resize as in training, then normalise; published: normalise, then resize without antialias."""
    pca: int | None = setting(None, changes="numbers", at_least=1)
    """Dimensions kept by PCA; none keeps all (paper: 4096)."""
    prefix: int | None = setting(None, changes="numbers", at_least=1)
    """Dimensions kept from the beginning of the descriptor (of a model trained with `loss.prefixes`), not with pca;
    none keeps all."""
    batch: int = setting(32, changes="speed", at_least=1, at_most=65_536)
    """Images per forward pass of the per-image part; changes memory, not the result."""
    workers: int = setting(4, changes="speed", at_least=0, at_most=MANY)
    """Decoding processes per rank; 0 decodes in the evaluating process."""
    precision: Literal["fp32", "bf16", "fp16"] = setting("fp32", changes="numbers")
    """Autocast of the per-image part; the cross-image encoder and the search stay in fp32."""
    store: Literal["none", "fp32", "fp16"] = setting("none", changes="numbers")
    """Write descriptors as Parquet under the output folder, in this type; they are reused when nothing changed."""
    pca_from: str | None = setting(None, changes="numbers")
    """PCA is fitted on this set's database, at most 16,384 images (paper: Pitts30k train); none: each set's own."""
    pca_whiten: bool = setting(False, changes="numbers")
    """Scale the PCA dimensions to unit variance (published: no)."""
    search: SearchKind = setting("exact", changes="numbers")
    """Exact L2 search, or one by faiss whose recall against exact is measured and printed: of codes of a byte (int8) or
    a bit (binary) a dimension, or for large sets (ivfpq, hnsw)."""
    refine: int = setting(0, changes="numbers", at_least=0, at_most=10_000)
    """int8, binary, ivfpq: float descriptors put so many first candidates in order anew; 0: none."""
    rerank: int = setting(0, changes="numbers", at_least=0, at_most=10_000)
    """Re-rank this many first candidates by matching patches in space; 0: none. Reads their images again; not for
    validation during training."""
    rerank_by: Literal["patches", "patch-netvlad", "patch-netvlad-rss", "transvpr"] = setting(
        "patches", changes="numbers"
    )
    """rerank: how. patches (ours): patch tokens of any backbone; patch-netvlad: NetVLAD of patches of three sizes, with
    RANSAC (needs OpenCV) or rapid spatial scoring (-rss); transvpr: its key patches, with RANSAC."""
    rerank_layer: int | None = setting(None, changes="numbers", at_least=1)
    """rerank: block (transformer) or stage (ResNet, VGG) whose patches are matched, from 1; none: the last
    (patches) or the fourth (transvpr)."""


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
    """Learning rate. step: halved every `step_epochs` (paper); cosine: decays to 0; constant. Set at each step."""
    step_epochs: float = setting(3.0, changes="numbers", above=0)
    """schedule=step: epochs between two reductions (paper: 3)."""
    step_factor: float = setting(0.5, changes="numbers", above=0, at_most=1)
    """schedule=step: factor of each reduction (paper: 0.5)."""
    warmup_steps: int = setting(0, changes="numbers", at_least=0)
    """Linear warm-up in steps (published: 0)."""
    max_grad_norm: float | None = setting(None, changes="numbers", above=0, formerly="clip")
    """Largest norm of the gradient; none: no clipping (published: none)."""
    passes: Literal["group", "joint"] = setting("group", changes="numbers")
    """group: each image is described in the global batch (paper). joint (ours): also alone, with one loss over both
    descriptions of all images, so that the weights also serve a single photo. The backbone runs once. joint needs a
    cross-image encoder."""
    validate_first: bool = setting(True, changes="none")
    """Evaluate the untrained model before the first step, so that a run shows what training added."""
    patience: int = setting(3, changes="numbers", at_least=0, resume="free")
    """Stop after this many epochs without a better validation R@5 (paper: 3); 0 never stops early."""
    encode_chunk: int | None = setting(None, changes="speed", at_least=1)
    """Images encoded at a time on a rank, recomputed in backward; none: all at once. Always exact. Memory of the
    per-image part then does not grow with the batch for adapter.norm group or none; for batch it grows more slowly."""
    compile: bool = setting(False, changes="speed")
    """Compile the backbone's blocks (torch.compile): one process or DDP, without encode_chunk; not in validation."""
    tf32: bool = setting(False, changes="numbers")
    """On a GPU, compute float32 products and convolutions with TF32's 10 bits: faster; validation stays in float32.
    Parts that accelerate's bf16 or fp16 computes are not concerned."""
    deterministic: bool = setting(False, changes="speed")
    """On a GPU, only deterministic kernels, so that the same run gives the same bits; slower. An operation that has
    none ends the run."""
    engine: Literal["auto", "ddp", "fsdp2"] = setting("auto", changes="speed")
    """auto: the engine that accelerate was launched with (DDP, DeepSpeed); fsdp2 shards parameters (fully_shard)."""
    save_every: int = setting(200, changes="none", at_least=1)
    """Steps between two saves of the last checkpoint; also at each epoch's end and on SIGTERM or SIGUSR1."""
    keep: int = setting(2, changes="none", at_least=1)
    """Number of step checkpoints that are kept beside the best one."""
    resume: str = setting("auto", changes="none")
    """auto: continue from the run folder's last checkpoint if it exists; never: start a new run (refused if one
    exists); or the path of a checkpoint to start from."""
    log_every: int = setting(10, changes="none", at_least=1)
    """Steps between two progress lines and metric records."""
    timeout: float = setting(600.0, changes="none", above=0, at_most=MONTH)
    """Seconds a rank waits for the others in a collective before the job ends with an error."""
    log_samples: bool = setting(False, changes="none")
    """Write the sample keys of each step to samples.rank<r>.jsonl; they show that nothing is repeated or skipped."""


@dataclass(frozen=True)
class TrackingConfig(Settings):
    """MLflow."""

    uri: str | None = setting(None, changes="none")
    """Tracking server or store; none: MLFLOW_TRACKING_URI, else sqlite in `<output>/mlflow.db`."""
    experiment: str = setting("place-recognition", changes="none")
    """Experiment name."""
    register: str | None = setting(None, changes="none", file_name=True)
    """Name in MLflow's model registry: when the run is done, its best checkpoint, whole, is a new version there."""
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
    """Evaluated after each epoch; R@5 of the first set and grouping chooses the best checkpoint. Empty `sets`: none."""
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


def recorded(config: Any) -> dict[str, Any]:
    """`to_dict` for what others may read: without the passwords of URLs."""

    def clean(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: clean(inner) for key, inner in value.items()}
        if isinstance(value, list):
            return [clean(inner) for inner in value]
        return without_passwords(value) if isinstance(value, str) else value

    cleaned: dict[str, Any] = clean(to_dict(config))
    return cleaned


def flatten(config: Any) -> dict[str, Any]:
    """`recorded` as one level with dotted keys, `data.places_per_batch`."""
    flat: dict[str, Any] = {}

    def walk(prefix: str, value: Any) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                walk(f"{prefix}.{key}" if prefix else key, inner)
        else:
            flat[prefix] = value

    walk("", recorded(config))
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
                raise UsageError(f"{shortened(name)} cannot be set: {shortened(section)} is a setting, not a section")
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
