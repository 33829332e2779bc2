"""Every setting of a run, as typed frozen dataclasses: the one source of the YAML keys, the command line and `--help`.

Invariant: nothing here imports torch, so `--help` is instant; a field's docstring says what it means, its unit and,
where the paper (Lu et al., CricaVPR, CVPR 2024) fixes it, the paper's value. Defaults are the published settings
except where the docstring says "ours".
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from typing import Any, Literal

from pipeline.common.errors import UsageError
from pipeline.config.model import AdapterConfig as AdapterConfig
from pipeline.config.model import BackboneConfig as BackboneConfig
from pipeline.config.model import CrossImageConfig as CrossImageConfig
from pipeline.config.model import ModelConfig as ModelConfig
from pipeline.config.model import PoolingConfig as PoolingConfig


@dataclass(frozen=True)
class DataConfig:
    """What is trained on, in which order, and how images are prepared."""

    shards: tuple[str, ...] | str = "data/shards"
    """Folder, or any fsspec URL, of a shard set made by jobs.prepare; or a list, `[a, b]`: one training over all."""
    shard_weights: tuple[float, ...] = ()
    """How often a place of each set comes in an epoch, above 0: 0.5 half of the places, 2 each twice (never in one
    batch); empty: 1 for each set."""
    places_per_batch: int = 72
    """Places in the global batch, over all ranks; four images each (paper: 72, so 288 images)."""
    order: Literal["city", "mixed", "blocked"] = "city"
    """Order of places: in-city batches (as published in effect), mixed over cities, or within windows of shards."""
    window_shards: int = 8
    """Shards read together by order=blocked."""
    image_size: int = 224
    """Side of the square input, in pixels; a multiple of the patch size (paper: 224)."""
    augment: Literal["rand", "light", "off"] = "rand"
    """RandAugment as published; a light colour jitter and crop; or nothing."""
    rand_ops: int = 3
    """RandAugment: operations an image (paper: 3)."""
    rand_magnitude: int = 9
    """RandAugment: magnitude out of 30 (published: 9)."""
    workers: int = 4
    """Decoding processes a rank; 0 decodes in the training process."""
    prefetch: int = 2
    """Batches each worker prepares ahead."""
    cache: str = "data/cache"
    """Local folder for shards fetched from a URL."""
    cache_gb: float = 50.0
    """Bound of that cache in GB (10^9 bytes)."""


@dataclass(frozen=True)
class LossConfig:
    """Multi-similarity loss with online mining (paper, Eq. 5)."""

    alpha: float = 1.0
    """Weight of positives (paper: 1)."""
    beta: float = 50.0
    """Weight of negatives (paper: 50)."""
    base: float = 0.0
    """The similarity threshold lambda (paper: 0)."""
    margin: float = 0.1
    """Mining margin (paper: 0.1)."""
    ignore_within: float = 0.0
    """Pairs of different places closer than this many metres are neither positive nor negative; 0: none (published)."""


@dataclass(frozen=True)
class EvaluationConfig:
    """Which sets are searched, under which protocols. A recall means nothing without these."""

    sets: tuple[str, ...] = ()
    """Folders of evaluation sets, `<dataset>/images/<split>/{database,queries}`, or a set's name under `root`."""
    root: str = "data"
    """Folder under which set names are looked up."""
    split: Literal["train", "val", "test"] = "test"
    """Split of the folder layout."""
    groups: tuple[Literal["single", "shuffled", "ordered"], ...] = ("single", "shuffled", "ordered")
    """Which images share an inference batch: each alone, seeded random groups, or neighbours in file order (the
    paper's way)."""
    group_size: int = 16
    """Images a group for shuffled and ordered (paper: 16; 8 on Pittsburgh)."""
    group_seed: int = 0
    """Seed of the shuffled grouping."""
    recalls: tuple[int, ...] = (1, 5, 10, 20)
    """The N of Recall@N."""
    radius: float = 25.0
    """Metres within which a database image is a positive, inclusive (paper: 25)."""
    frames: int | None = None
    """For sequences without positions: positives are +- this many frames instead of metres."""
    without_positives: Literal["miss", "drop"] = "miss"
    """Queries that have no positive count as a miss, or are dropped (MSLS's own tool)."""
    resize: Literal["antialias", "published"] = "antialias"
    """antialias: resize as in training, then normalise; published: normalise, then resize without antialias."""
    pca: int | None = None
    """Dimensions kept by PCA; none keeps all (paper: 4096)."""
    batch: int = 32
    """Images a forward pass of the per-image part; memory only, never the result."""
    workers: int = 4
    """Decoding processes a rank; 0 decodes in the evaluating process."""
    precision: Literal["fp32", "bf16", "fp16"] = "fp32"
    """Autocast of the per-image part; the cross-image encoder and the search stay in fp32."""
    store: Literal["none", "fp32", "fp16"] = "none"
    """Keep descriptors as Parquet under the output folder, in this type; they are reused when nothing changed."""
    pca_from: str | None = None
    """Set whose database PCA is fitted on, at most 16,384 images (paper: Pitts30k train); none: each set's own."""
    pca_whiten: bool = False
    """Scale PCA's directions to unit variance (published: no)."""
    search: Literal["exact", "ivfpq", "hnsw"] = "exact"
    """Exact L2 search, or a faiss approximation for large sets, whose recall against exact is measured and printed."""
    rerank: int = 0
    """Second stage: this many first candidates are put in order by matching patch tokens in space; 0: none. Reads the
    candidates' images again; not for validation during training."""
    rerank_layer: int | None = None
    """Block (transformer) or stage (ResNet, VGG) of the backbone whose patches are matched, from 1; none: its last."""


@dataclass(frozen=True)
class TrainConfig:
    """Optimisation, checkpoints and stopping."""

    epochs: int = 10
    """Epochs over the plan (paper: 10)."""
    steps: int | None = None
    """Stop after this many steps, whatever the epochs; none: no limit."""
    optimizer: Literal["adam", "adamw", "sgd"] = "adam"
    """Optimiser (paper: Adam)."""
    lr: float = 1e-4
    """Learning rate (paper: 1e-4)."""
    weight_decay: float = 0.0
    """Weight decay (published: 0)."""
    schedule: Literal["step", "cosine", "constant"] = "step"
    """step halves the rate every `step_epochs` (paper); cosine decays to 0; both stepped per iteration."""
    step_epochs: float = 3.0
    """schedule=step: epochs between two reductions (paper: 3)."""
    step_factor: float = 0.5
    """schedule=step: factor of a reduction (paper: 0.5)."""
    warmup_steps: int = 0
    """Linear warm-up in steps (published: 0)."""
    max_grad_norm: float | None = None
    """Largest norm of the gradient; none: no clipping (published: none)."""
    passes: Literal["group", "joint"] = "group"
    """group: each image is described in the global batch (paper). joint (ours): from the same regions also alone, and
    one loss is taken over both descriptions of all images, so that the weights also serve a single photo. The backbone
    runs once; needs a cross-image encoder."""
    validate_first: bool = True
    """Evaluate the untrained model before the first step, so that a run shows what training added."""
    patience: int = 3
    """Stop after this many epochs without a better validation R@5 (paper: 3); 0 never stops early."""
    encode_chunk: int | None = None
    """Images encoded at a time on a rank, recomputed in backward; none: all at once. Always exact. Memory then does not
    grow with the batch for adapter.norm group or none; with batch it grows slower, as BatchNorm needs all images."""
    compile: bool = False
    """torch.compile the backbone's blocks; for one process and DDP, without encode_chunk. Not used in validation."""
    engine: Literal["auto", "ddp", "fsdp2"] = "auto"
    """auto: what accelerate was launched with (DDP, DeepSpeed); fsdp2 shards parameters with fully_shard."""
    save_every: int = 200
    """Steps between two saves of the last checkpoint; also at each epoch's end and on SIGTERM or SIGUSR1."""
    keep: int = 2
    """Step checkpoints kept beside the best one."""
    resume: str = "auto"
    """auto continues the run folder's last checkpoint where there is one; never starts anew (and refuses to
    overwrite); or the path of a checkpoint."""
    log_every: int = 10
    """Steps between two progress lines and metric records."""
    timeout: float = 600.0
    """Seconds a rank waits for the others in a collective before the job ends with an error."""
    log_samples: bool = False
    """Write the sample keys of each step to samples.rank<r>.jsonl, the proof that nothing is repeated or skipped."""


@dataclass(frozen=True)
class TrackingConfig:
    """MLflow."""

    uri: str | None = None
    """Tracking server or store; none: MLFLOW_TRACKING_URI, else sqlite in `<output>/mlflow.db`."""
    experiment: str = "place-recognition"
    """Experiment name."""
    enabled: bool = True
    """False records nothing."""


@dataclass(frozen=True)
class RunConfig:
    """A training run."""

    name: str = "cricavpr"
    """Name of the run and of its folder under `output`."""
    output: str = "outputs"
    """Folder of all runs."""
    seed: int = 0
    """Seed of initialisation, plan, augmentation and dropout."""
    data: DataConfig = field(default_factory=DataConfig)
    """Training data."""
    model: ModelConfig = field(default_factory=ModelConfig)
    """Model."""
    loss: LossConfig = field(default_factory=LossConfig)
    """Loss."""
    train: TrainConfig = field(default_factory=TrainConfig)
    """Training."""
    validate: EvaluationConfig = field(default_factory=lambda: EvaluationConfig(split="val", groups=("shuffled",)))
    """Evaluated after each epoch, best checkpoint chosen by R@5 of the first set and grouping; empty `sets`: none."""
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    """Where runs are recorded."""


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


def from_dict(kind: type, values: dict[str, Any], where: str = "") -> Any:
    """Builds dataclass `kind` from plain values (a checkpoint's config.json). Unknown keys raise `UsageError`."""
    import typing

    hints = typing.get_type_hints(kind)
    unknown = set(values) - set(hints)
    if unknown:
        raise UsageError(f"unknown setting '{where}{sorted(unknown)[0]}'; known here: {', '.join(hints)}")
    built: dict[str, Any] = {}
    for key, value in values.items():
        if dataclasses.is_dataclass(hints[key]) and isinstance(value, dict):
            built[key] = from_dict(typing.cast(type, hints[key]), value, f"{where}{key}.")
        else:
            built[key] = tuple(value) if isinstance(value, list) else value
    return kind(**built)
