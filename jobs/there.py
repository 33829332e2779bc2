"""What a job reads, looked for before the imports that take seconds: a mistyped path is told at once.

Only paths are looked at; what is in them is the job's own to check. Under a launcher nothing is looked for here: its
ranks tell a missing file once, together, and their imports are paid by then.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from pipeline.common.errors import DataError
from pipeline.config import EvaluationConfig, ModelConfig
from pipeline.evaluation.sets.registry import published_name
from pipeline.model.weights.where import check_weights, checkpoint_file


def launched() -> bool:
    """Whether this process is one of several."""
    return os.environ.get("WORLD_SIZE", "1") != "1"


def need_model(path: str) -> None:
    """A run, a checkpoint or a file. Raises `UsageError`."""
    if not launched():
        checkpoint_file(path)


def need_weights(model: ModelConfig) -> None:
    """The backbone's weights, where a setting names some. Raises `UsageError`."""
    if model.backbone.weights is not None and not launched():
        check_weights(model.backbone.weights)


def need_shards(shards: Sequence[str] | str) -> None:
    """Shard sets on this machine; what lies behind a URL is not asked. Raises `DataError`."""
    for name in [shards] if isinstance(shards, str) else shards:
        if "://" not in name and not launched() and not Path(name).expanduser().exists():
            raise DataError(f"{name}: there is no such folder of shards; jobs.prepare makes it")


def need_sets(config: EvaluationConfig) -> None:
    """The folder below which published sets are looked up, and the path of each other set. Raises `DataError`."""
    for name in () if launched() else config.sets:
        path = name.rpartition(":")[0] if "->" in name and ":" in name else name
        below = Path(config.root).expanduser()
        if published_name(path) is not None and not below.is_dir():
            raise DataError(f"{name}: it is looked up in the folder {below}, which is not there; set root")
        own = published_name(path) is None and path.lower() != "nordland"
        if own and not Path(path).expanduser().exists() and not (below / path).exists():
            raise DataError(f"{name}: neither a path, nor a folder in {below}, nor a set with a known name")
