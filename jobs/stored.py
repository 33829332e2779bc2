"""New recalls, and tables of PCA dimensions, from stored descriptors alone: no model, no GPU, no photo is opened.

    python -m jobs.evaluate --checkpoint outputs/RUN --sets pitts30k --store fp16       once, with the model
    python -m jobs.stored --stores outputs/RUN/evaluation --dimensions 4096,1024,256
    python -m jobs.stored --stores outputs/RUN/evaluation --radius 10 --search hnsw

Every stored grouping is scored whole and with each of the dimensions. Prints one table and writes results.json,
results.md, results.csv and predictions/. The sets lie where they lay, since they tell what is correct.
"""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from jobs.cli import parse, run_job
from pipeline.common.errors import UsageError


@dataclass(frozen=True)
class StoredJob:
    """Score stored descriptors."""

    stores: str = ""
    """Folder that an evaluation with --store wrote to, such as outputs/RUN/evaluation; it holds descriptors/."""
    sets: tuple[str, ...] = ()
    """Names below `root`, or paths; none: every set that has descriptors."""
    root: str = "data"
    """Folder under which set names are looked up."""
    split: Literal["train", "val", "test"] = "test"
    """Split of the folder layout."""
    dimensions: tuple[int, ...] = ()
    """PCA dimensions, a row each beside the whole descriptors; fitted on each set's own database."""
    pca_whiten: bool = False
    """Scale PCA's directions to unit variance (published: no)."""
    recalls: tuple[int, ...] = (1, 5, 10, 20)
    """The N of Recall@N."""
    radius: float = 25.0
    """Metres within which a database image is a positive, inclusive (paper: 25)."""
    frames: int | None = None
    """For sequences without positions: positives are +- this many frames instead of metres."""
    without_positives: Literal["miss", "drop"] = "miss"
    """Queries that have no positive count as a miss, or are dropped (MSLS's own tool)."""
    search: Literal["exact", "ivfpq", "hnsw"] = "exact"
    """Exact L2 search, or a faiss approximation, whose recall against exact is measured and printed."""
    output: str | None = None
    """Folder of the results; none: `<stores>/from_store`."""


def main() -> None:
    """Parses, scores, writes."""
    job = parse(StoredJob, __doc__ or "")
    if not job.stores:
        raise UsageError("--stores is missing: the folder an evaluation with --store wrote to, outputs/RUN/evaluation")
    if any(number < 1 for number in (*job.dimensions, *job.recalls)):
        raise UsageError("--dimensions and --recalls start at 1")
    from pipeline.config import EvaluationConfig, to_dict
    from pipeline.evaluation.describe.stored import evaluate_stores, stored_sets
    from pipeline.evaluation.predictions import save_results
    from pipeline.evaluation.report import tables
    from pipeline.evaluation.sets.load import load_sets

    shared = {f.name for f in dataclasses.fields(EvaluationConfig)} & {f.name for f in dataclasses.fields(StoredJob)}
    config = EvaluationConfig(**{name: getattr(job, name) for name in shared})
    folder = Path(job.stores)
    sets, left_out = load_sets(job.sets or stored_sets(folder), config)
    for line in left_out:
        print(f"left out: {line}", file=sys.stderr)
    results = evaluate_stores(folder, sets, config, (None, *job.dimensions))
    tables.show(results)
    output = Path(job.output) if job.output else folder / "from_store"
    about = {"stores": str(folder), "evaluation": to_dict(config), "left_out": left_out}
    save_results(results, sets, output, about)
    print(f"\nwritten to {output}/")


if __name__ == "__main__":
    run_job(main)
