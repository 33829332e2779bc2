"""Compare recorded runs: metrics, the settings that differ, recall curves, and whether differences are real.

    python -m jobs.compare --runs first,second

Runs that jobs.evaluate has predictions of are compared query by query with the first of them: the difference in recall
with its 95 % interval (paired bootstrap), called real only where McNemar's exact test agrees.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from jobs.cli import parse, run_job


@dataclass(frozen=True)
class CompareJob:
    """Compare the runs of an MLflow experiment. The best of a row is marked with *."""

    runs: tuple[str, ...] = ()
    """Names or MLflow ids, `[a,b]`; none: the newest run of each name."""
    experiment: str = "place-recognition"
    """MLflow experiment."""
    uri: str | None = None
    """Tracking server or store; none: MLFLOW_TRACKING_URI, else `<output>/mlflow.db`."""
    output: str = "outputs"
    """Folder of the runs; the table (markdown, CSV) and the curves go to `<output>/comparison`."""


def main() -> None:
    """Prints the table and the paths of what was written."""
    job = parse(CompareJob, __doc__ or "")
    from pipeline.evaluation import bootstrap
    from pipeline.training import comparison
    from pipeline.training.tracking import store_uri

    runs = comparison.load_runs(store_uri(job.uri, job.output), job.experiment, job.runs)
    table = comparison.cells(runs)
    print(comparison.as_text(table))
    folder = Path(job.output) / "comparison"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "comparison.md").write_text(comparison.as_markdown(table))
    comparison.write_csv(table, folder / "comparison.csv")
    written = [folder / "comparison.md", folder / "comparison.csv"]
    names = list(dict.fromkeys(run.name for run in runs))
    found, left_out = bootstrap.compare_folders([(n, Path(job.output) / n / "evaluation/predictions") for n in names])
    if len(names) > 1:
        print(
            "\n" + "\n".join([bootstrap.as_text(found)] * bool(found) + [f"not compared: {note}" for note in left_out])
        )
    if found:
        with (folder / "comparison.md").open("a") as file:
            file.write("\n" + bootstrap.as_markdown(found))
        bootstrap.write_csv(found, folder / "differences.csv")
        written.append(folder / "differences.csv")
    if comparison.draw_curves(runs, folder / "recall_curves.png"):
        written.append(folder / "recall_curves.png")
    print("\nwritten: " + "  ".join(str(path) for path in written))


if __name__ == "__main__":
    run_job(main)
