"""Recall of a checkpoint with its protocol, on every set that is there, in all three groupings.

    python -m jobs.evaluate --checkpoint outputs/RUN --sets pitts30k,msls_val --root data
    accelerate launch --config_file jobs/accelerate/ddp.yaml -m jobs.evaluate --checkpoint outputs/RUN --sets pitts30k

Prints one table and writes results.json, results.md, results.csv, predictions/, figures/ and report.html. The number of
processes changes nothing but the time. Sets that are missing are named and left out; exit code 3 when none is there.
"""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path

from jobs.cli import parse, run_job
from pipeline.common.errors import UsageError
from pipeline.config import EvaluationConfig, to_dict


@dataclass(frozen=True)
class EvaluateJob(EvaluationConfig):
    """Evaluate a checkpoint. Without `sets`, every set found under `root`."""

    checkpoint: str = ""
    """A run folder (its best checkpoint), a checkpoint folder, a .safetensors file, or a released .pth."""
    output: str | None = None
    """Folder of all results; none: `<run>/evaluation`."""
    track: bool = True
    """Record the recalls in the checkpoint's MLflow run, where it has one."""
    figures: bool = True
    """Draw figures and the HTML report."""
    timeout: float = 1800.0
    """Seconds that a process waits for the others."""


def main() -> None:
    """Parses, evaluates, reports."""
    job = parse(EvaluateJob, __doc__ or "")
    if not job.checkpoint:
        raise UsageError("--checkpoint is missing: a run folder such as outputs/cricavpr, or a model file")
    config = EvaluationConfig(**{f.name: getattr(job, f.name) for f in dataclasses.fields(EvaluationConfig)})
    from pipeline.training.launch import launched

    with launched(job.timeout) as accelerator:
        run(job, config, accelerator)


def run(job: EvaluateJob, config: EvaluationConfig, accelerator: object) -> None:
    """The evaluation on this process; rank 0 writes."""
    from pipeline.evaluation.evaluate import evaluate, fit_projections, model_fingerprint
    from pipeline.evaluation.predictions import save_results
    from pipeline.evaluation.report import html, tables
    from pipeline.evaluation.sets.load import available, load_set, load_sets
    from pipeline.model.weights.files import checkpoint_file, read_metadata
    from pipeline.model.weights.load import load_any

    device, first = accelerator.device, accelerator.is_main_process  # type: ignore[attr-defined]
    file = checkpoint_file(job.checkpoint)
    names = config.sets or tuple(a.name for a in available(config.root, config.split) if a.folder is not None)
    sets, left_out = load_sets(names, config)
    for line in left_out if first else ():
        print(f"left out: {line}", file=sys.stderr)
    model = load_any(file, device)
    runs = [parent.parent for parent in file.parents if parent.name == "checkpoints"]
    output = Path(job.output) if job.output else (runs[0] if runs else file.parent) / "evaluation"
    fingerprint = model_fingerprint(model)
    projections = None
    if config.pca and config.pca_from:
        source = load_set(config.pca_from, dataclasses.replace(config, split="train"))
        projections = fit_projections(model, source, config, device, beside=file.parent, fingerprint=fingerprint)
    results = evaluate(model, sets, config, device, output, True, projections, fingerprint)
    if not first:
        return
    tables.show(results)
    about = {"checkpoint": str(file), "fingerprint": fingerprint, "descriptor_dim": model.descriptor_dim}
    plain = {**about, "model": to_dict(model.config), "evaluation": to_dict(config), "left_out": left_out}
    save_results(results, sets, output, plain)
    if job.figures:
        pictures = html.draw(results, sets, output / "figures", model)
        facts = {key: str(value) for key, value in about.items()}
        title = f"Evaluation of {(runs[0] if runs else file).name}"
        html.write_report(results, pictures, output / "report.html", title, facts)
    if job.track and runs:
        from pipeline.training.tracking import record_evaluation

        values = {name: value for entry in tables.as_dicts(results) for name, value in entry["metrics"].items()}
        record_evaluation(runs[0], read_metadata(file)["extra"], values, output)
    print(f"\nwritten to {output}/" + (": open report.html in a browser" if job.figures else ""))


if __name__ == "__main__":
    run_job(main)
