"""Recall of a checkpoint, with its protocol: on the given sets or all that are found, in three groupings.

    python -m jobs.evaluate --checkpoint outputs/RUN --sets pitts30k,msls_val --root data
    python -m jobs.evaluate --checkpoint outputs/RUN --sets pitts30k --processes 4
    python -m jobs.evaluate --from_store outputs/RUN/evaluation --dimensions 512 --searches int8,binary --refine 100

Prints one table and writes results.json, results.md, results.csv, predictions/, figures/ and report.html. The number of
processes changes nothing but the time. Sets that are missing are named and left out; exit code 3 when none is there.

--from_store needs no model and no GPU, and opens no photo: every grouping that an evaluation with --store wrote is
scored again: whole, and made small by each of --dimensions (PCA), --prefixes and --searches, with bytes an image, time
a query, and the difference to the whole descriptors. The sets must still be in their folders.
"""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from jobs.cli import parse, run_job
from jobs.processes import Processes, check_processes, spread
from jobs.there import need_model, need_sets
from pipeline.common.errors import UsageError
from pipeline.common.files import check_writable
from pipeline.config import EvaluationConfig, SearchKind, recorded, to_dict
from pipeline.config.setting import setting


@dataclass(frozen=True)
class EvaluateJob(EvaluationConfig, Processes):
    """Evaluate a checkpoint. Without `sets`, every set found under `root`."""

    checkpoint: str = ""
    """A run folder (its best checkpoint), a checkpoint folder, a .safetensors file, or a released .pth or .pth.tar."""
    image_size: str | int | None = setting(None, changes="numbers", image_size="any")
    """Photos are brought to: a side (224), height x width (480x640), or native, their own shape, longest side at most
    640 (native800: 800); none: what the checkpoint says, for a release that of its authors' evaluation."""
    output: str | None = None
    """Folder of all results; none: `<run>/evaluation`."""
    track: bool = True
    """Record the recalls in the checkpoint's MLflow run, where it has one."""
    figures: bool = True
    """Draw figures and the HTML report."""
    figures_also: tuple[Literal["pdf", "svg", "png"], ...] = ()
    """Write every figure in these formats as well: pdf and svg (vectors, photos at 300 dpi), png (300 dpi)."""
    timeout: float = 1800.0
    """Seconds that a process waits for the others."""
    from_store: str | None = None
    """Score stored descriptors instead of a checkpoint: the folder that an evaluation with --store wrote to."""
    dimensions: tuple[int, ...] = ()
    """from_store: PCA dimensions, a row for each; PCA is fitted on each set's own database."""
    prefixes: tuple[int, ...] = ()
    """from_store: numbers of first dimensions, a row for each."""
    searches: tuple[SearchKind, ...] = ()
    """from_store: kinds of search beside --search, a row for each; those of codes with --refine two."""


# what a store's descriptors leave open; all other settings of an evaluation were decided when they were made
OPEN = ("sets", "root", "split", "recalls", "radius", "frames", "without_positives", "pca_whiten", "search", "refine")


def main() -> None:
    """Parses, evaluates, reports."""
    job = parse(EvaluateJob, __doc__ or "")
    check_processes(job)
    config = EvaluationConfig(**{f.name: getattr(job, f.name) for f in dataclasses.fields(EvaluationConfig)})
    if job.from_store is not None:
        stored(job, Path(job.from_store), config)
        return
    for name, instead in (("dimensions", "pca"), ("prefixes", "prefix"), ("searches", "search")):
        if getattr(job, name):
            raise UsageError(f"--{name} goes with --from_store; with a checkpoint give --{instead}")
    if not job.checkpoint:
        raise UsageError("--checkpoint is missing: a run folder such as outputs/cricavpr, or a model file")
    need_model(job.checkpoint)
    if len(config.sets) == 1:  # of several, those that are not there are left out
        need_sets(config)
    spread(job, "jobs.evaluate")
    from pipeline.training.launch import launched

    with launched(job.timeout) as accelerator:
        run(job, config, accelerator)


def run(job: EvaluateJob, config: EvaluationConfig, accelerator: object) -> None:
    """The evaluation on this process; rank 0 writes."""
    from pipeline.distributed import agreed, on_rank_0
    from pipeline.evaluation.evaluate import evaluate, projections_from
    from pipeline.evaluation.identity import model_digest
    from pipeline.evaluation.predictions import save_results
    from pipeline.evaluation.report import tables
    from pipeline.evaluation.report.figures import also_as
    from pipeline.evaluation.report.page import write_page
    from pipeline.evaluation.report.pictures import draw
    from pipeline.evaluation.sets.evaluation_set import EvaluationSet
    from pipeline.evaluation.sets.load import available, load_sets
    from pipeline.model.weights.files import checkpoint_file, read_metadata
    from pipeline.model.weights.load import load_any

    device, first = accelerator.device, accelerator.is_main_process  # type: ignore[attr-defined]
    file = agreed(partial(checkpoint_file, job.checkpoint))
    runs = [parent.parent for parent in file.parents if parent.name == "checkpoints"]
    output = Path(job.output) if job.output else (runs[0] if runs else file.parent) / "evaluation"
    on_rank_0(partial(check_writable, output, "--output"))

    def find() -> tuple[list[EvaluationSet], list[str]]:
        there = tuple(a.name for a in available(config.root, config.split) if a.folder is not None)
        return load_sets(config.sets or there, config)

    sets, left_out = agreed(find, what="reading the sets")
    for line in left_out if first else ():
        print(f"left out: {line}", file=sys.stderr)
    model = agreed(partial(load_any, file, device, job.image_size), what=f"loading {file}")
    fingerprint = model_digest(model)
    projections = projections_from(model, config, device, beside=file.parent, fingerprint=fingerprint)
    results = evaluate(model, sets, config, device, output, True, projections, fingerprint)

    def write() -> None:
        tables.show(results)
        about = {"checkpoint": str(file), "fingerprint": fingerprint, "descriptor_dim": model.descriptor_dim}
        plain = {**about, "model": to_dict(model.config), "evaluation": recorded(config), "left_out": left_out}
        save_results(results, sets, output, plain)
        if job.figures:
            with also_as(job.figures_also):
                pictures = draw(results, sets, output / "figures", model)
            facts = {key: str(value) for key, value in about.items()}
            title = f"Evaluation of {(runs[0] if runs else file).name}"
            write_page(results, pictures, output / "report.html", title, facts)
        if job.track and runs:
            from pipeline.training.records.tracking import record_evaluation

            values = {name: value for entry in tables.as_dicts(results) for name, value in entry["metrics"].items()}
            record_evaluation(runs[0], read_metadata(file)["extra"], values, output)
        print(f"\nwritten to {output}/" + (": open report.html in a browser" if job.figures else ""))

    on_rank_0(write, what=f"writing the results into {output}")


def stored(job: EvaluateJob, folder: Path, config: EvaluationConfig) -> None:
    """Scores the descriptors below `folder`, in this process alone."""
    if job.checkpoint:
        raise UsageError("give --checkpoint or --from_store, not both")
    if job.image_size is not None:
        raise UsageError("--image_size: stored descriptors have their own; leave it out, or evaluate again")
    for field in dataclasses.fields(EvaluationConfig):
        if field.name not in OPEN and getattr(config, field.name) != field.default:
            raise UsageError(f"--{field.name}: stored descriptors have their own; leave it out, or evaluate again")
    if any(number < 1 for number in (*job.dimensions, *job.prefixes, *job.recalls)):
        raise UsageError("--dimensions, --prefixes and --recalls start at 1")
    from pipeline.evaluation.describe.stored import evaluate_stores, stored_sets
    from pipeline.evaluation.predictions import save_results
    from pipeline.evaluation.report import tables
    from pipeline.evaluation.sets.load import load_sets

    output = Path(job.output) if job.output else folder / "from_store"
    check_writable(output, "--output")
    sets, left_out = load_sets(config.sets or stored_sets(folder), config)
    for line in left_out:
        print(f"left out: {line}", file=sys.stderr)
    results = evaluate_stores(folder, sets, config, job.dimensions, job.prefixes, job.searches)
    tables.show(results)
    save_results(results, sets, output, {"stores": str(folder), "evaluation": recorded(config), "left_out": left_out})
    print(f"\nwritten to {output}/")


if __name__ == "__main__":
    run_job(main)
