"""Compare recorded runs - metrics, the settings that differ, recall curves: `python -m jobs.compare [--runs a,b]`."""

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
    if comparison.draw_curves(runs, folder / "recall_curves.png"):
        written.append(folder / "recall_curves.png")
    print("\nwritten: " + "  ".join(str(path) for path in written))


if __name__ == "__main__":
    run_job(main)
