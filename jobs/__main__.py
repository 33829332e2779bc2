"""Any job by its name: `python -m jobs train --config FILE` is `python -m jobs.train --config FILE`.

The container's entry point: `docker run IMAGE demo`.
"""

from __future__ import annotations

import difflib
import runpy
import sys

from jobs.cli import run_job
from jobs.console import JOBS
from pipeline.common.errors import UsageError


def main() -> None:
    """Runs the job that the first word names, as if it were started by itself."""
    words = sys.argv[1:]
    if not words or words[0] in ("-h", "--help"):
        print(f"usage: JOB [options]\n\njobs: {', '.join(JOBS)}\n\nJOB --help tells a job's options")
        raise SystemExit(0 if words else 2)
    if words[0] not in JOBS:
        near = difflib.get_close_matches(words[0], JOBS, n=1)
        hint = f" (did you mean '{near[0]}'?)" if near else ""
        raise UsageError(f"there is no job '{words[0]}'{hint}; jobs are {', '.join(JOBS)}")
    sys.argv = words
    runpy.run_module(f"jobs.{words[0]}", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    run_job(main)
