"""Compare recorded runs: metrics, the settings that differ, recall curves, and whether differences are real.

    python -m jobs.compare --runs first,second,third
    python -m jobs.compare --evaluations outputs/RUN/evaluation,elsewhere/evaluation --pairs all

Runs that jobs.evaluate has evaluated are compared query by query with the first of them, or each with each: the
difference in recall with its 95 % interval (paired bootstrap), called real only where McNemar's exact test agrees.
--evaluations compares folders of evaluations (also of a released model) without MLflow. What an evaluation scored from
its stored descriptors (PCA, prefixes, codes) is compared as well, each under its own protocol.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from jobs.cli import parse, run_job
from pipeline.common.errors import DataError, UsageError
from pipeline.common.files import write_atomically


@dataclass(frozen=True)
class CompareJob:
    """Compare the runs of an MLflow experiment. The best of a row is marked with *."""

    runs: tuple[str, ...] = ()
    """Names or MLflow ids, `[a,b]`; none: the newest run of each name."""
    evaluations: tuple[str, ...] = ()
    """Folders that jobs.evaluate wrote to, instead of runs; they hold predictions/."""
    pairs: Literal["first", "all"] = "first"
    """Compare query by query with the first, or each with each."""
    experiment: str = "place-recognition"
    """MLflow experiment."""
    uri: str | None = None
    """Tracking server or store; none: MLFLOW_TRACKING_URI, else `<output>/mlflow.db`."""
    figures_also: tuple[Literal["pdf", "svg", "png"], ...] = ()
    """Write the curves in these formats as well: pdf and svg (vectors), png (300 dpi)."""
    output: str = "outputs"
    """Folder of the runs; the table (markdown, CSV) and the curves go to `<output>/comparison`."""


def main() -> None:
    """Prints the table and the paths of what was written."""
    job = parse(CompareJob, __doc__ or "")
    from pipeline.evaluation.report import significance

    if job.evaluations:
        compare_evaluations(job)
        return
    from pipeline.evaluation.report.figures import also_as
    from pipeline.training.records import comparison
    from pipeline.training.records.tracking import how_to_open, store_uri

    uri = store_uri(job.uri, job.output)
    runs = comparison.load_runs(uri, job.experiment, job.runs)
    table = comparison.table(runs)
    table.print()
    folder = Path(job.output) / "comparison"
    write_atomically(folder / "comparison.csv", table.csv())
    written = [folder / "comparison.md", folder / "comparison.csv"]
    names = list(dict.fromkeys(run.name for run in runs))
    folders = [(name, Path(job.output) / name / "evaluation") for name in names]
    found, left_out = significance.compare_folders(folders, every_pair=job.pairs == "all")
    if len(names) > 1:
        print(
            "\n"
            + "\n".join([significance.as_text(found)] * bool(found) + [f"not compared: {note}" for note in left_out])
        )
    compared = "\n" + significance.as_markdown(found) if found else ""
    write_atomically(folder / "comparison.md", table.markdown() + compared)
    if found:
        significance.write_csv(found, folder / "differences.csv")
        written.append(folder / "differences.csv")
    with also_as(job.figures_also):
        drawn = comparison.draw_curves(runs, folder / "recall_curves.png")
    if drawn:
        written.append(folder / "recall_curves.png")
    print("\nwritten: " + "  ".join(str(path) for path in written))
    print("in MLflow: " + how_to_open(uri, runs[0].experiment, *(run.run_id for run in runs)))


def compare_evaluations(job: CompareJob) -> None:
    """Query by query, what lies in the folders of `job.evaluations`."""
    from pipeline.evaluation.report import significance

    if job.runs:
        raise UsageError("give --runs or --evaluations, not both")
    if len(set(job.evaluations)) < 2:
        raise UsageError("--evaluations needs at least two different folders, one,another")
    folders = [(name, Path(name)) for name in dict.fromkeys(job.evaluations)]
    found, left_out = significance.compare_folders(folders, every_pair=job.pairs == "all")
    for note in left_out:
        print(f"not compared: {note}", file=sys.stderr)
    if not found:
        raise DataError("no two of these evaluations have the same queries of a set under the same protocol")
    print(significance.as_text(found))
    folder = Path(job.output) / "comparison"
    write_atomically(folder / "differences.md", significance.as_markdown(found))
    significance.write_csv(found, folder / "differences.csv")
    print(f"\nwritten: {folder / 'differences.md'}  {folder / 'differences.csv'}")


if __name__ == "__main__":
    run_job(main)
