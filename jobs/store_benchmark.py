"""What a descriptor store costs at size: peak memory and seconds of writing, reading, search, PCA and recalls from it.

    python -m jobs.store_benchmark                           64 and 1,344 dimensions, each at N and at 4 N rows
    python -m jobs.store_benchmark --sizes 20000x10752,80000x10752 --dims 4096 --folder /large/disk

Made descriptors, in a store as an evaluation writes it. Every step runs in a process of its own, so that its peak
memory is its own; what does not grow from N to 4 N rows does not depend on them.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from jobs.cli import parse, run_job
from pipeline.common.errors import DataError, UsageError


@dataclass(frozen=True)
class StoreBenchmarkJob:
    """Measure a store of each of `sizes`."""

    sizes: tuple[str, ...] = ("500000x64", "2000000x64", "60000x1344", "240000x1344")
    """Rows x dimensions of the database."""
    queries: int = 64
    """Queries, each another view of a known row."""
    stored: Literal["fp32", "fp16"] = "fp16"
    """Type of the stored descriptors."""
    dims: int = 32
    """Dimensions that PCA keeps."""
    recall: int = 10
    """Neighbours searched."""
    folder: str | None = None
    """Where the store is written and removed again; none: the temporary folder."""
    timeout: float = 1800.0
    """Seconds after which a step is given up, and said so."""


def main() -> None:
    """Writes each store, measures every step, prints a line a step."""
    job = parse(StoreBenchmarkJob, __doc__ or "")
    sizes = []
    for text in job.sizes:
        found = re.fullmatch(r"(\d+)x(\d+)", text)
        if found is None:
            raise UsageError(f"--sizes {text}: give rows x dimensions, such as 100000x256")
        sizes.append((int(found[1]), int(found[2])))
    from pipeline.benchmark import store_size
    from pipeline.benchmark.own_process import alone

    for rows, _ in sizes:
        if (job.queries - 1) * store_size.APART >= rows:
            raise UsageError(f"--queries {job.queries} needs more than {(job.queries - 1) * store_size.APART:,} rows")
    base = alone(store_size.baseline, job.timeout).peak
    print(f"threads {os.environ.get('OMP_NUM_THREADS', 'all')}, {job.queries} queries, stored {job.stored}, PCA to "
          f"{job.dims}; libraries alone {base / 1e6:,.0f} MB\n\n{'rows x dim':>18}  {'step':<14}{'peak MB':>9}"
          f"{'above libraries':>17}{'seconds':>10}", flush=True)  # fmt: skip
    for rows, dim in sizes:
        with tempfile.TemporaryDirectory(dir=job.folder) as folder:
            need = rows * (dim * (2 if job.stored == "fp16" else 4) + 200)
            if shutil.disk_usage(folder).free < 1.1 * need:
                raise DataError(f"{folder}: {rows} x {dim} need {need / 1e9:.1f} GB; give another --folder")
            for name, work, arguments in steps(job, Path(folder), rows, dim):
                got = alone(work, job.timeout, *arguments)
                seconds, note = (got.answer, "") if isinstance(got.answer, float) else (got.answer or (0.0, ""))
                if note:
                    note = "  R@1 " + " / ".join(f"{value:.1f}" for value in note)
                if name == "write" and not got.problem:
                    note = f"  {sum(f.stat().st_size for f in Path(folder).rglob('*.parquet')) / 1e6:,.0f} MB on disk"
                figures = f"{got.peak / 1e6:9,.0f}{(got.peak - base) / 1e6:17,.0f}{seconds:10,.1f}{note}"
                print(f"{f'{rows:,} x {dim:,}':>18}  {name:<14}{got.problem or figures}", flush=True)
                if got.problem and name == "write":
                    break


def steps(job: StoreBenchmarkJob, folder: Path, rows: int, dim: int) -> list[tuple[str, Callable[..., Any], Any]]:
    """(Name, work, its arguments) of every step."""
    from pipeline.benchmark import store_size

    return [
        ("write", store_size.write, (folder, rows, job.queries, dim, job.stored)),
        ("read", store_size.read, (folder,)),
        ("exact search", store_size.find, (folder, job.recall)),
        ("PCA, sample", store_size.fit, (folder, job.dims, False)),
        ("PCA, all rows", store_size.fit, (folder, job.dims, True)),
        ("project", store_size.project, (folder, job.dims)),
        ("recalls", store_size.recalls, (folder, job.dims, job.recall)),
    ]


if __name__ == "__main__":
    run_job(main)
