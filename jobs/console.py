"""Console commands: `vpr-train` is `python -m jobs.train`, and so for every job (`[project.scripts]`).

Invariant: `vpr-NAME` starts `jobs.NAME` and nothing else; only that job's module is imported.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NoReturn

from jobs.cli import run_job

JOBS = sorted(
    {path.stem for path in Path(__file__).parent.glob("*.py")}
    - {"__init__", "__main__", "cli", "console", "processes", "there"}
)


def __getattr__(name: str) -> Callable[[], NoReturn]:
    """The command of a job, such as `jobs.console:train`."""
    if name not in JOBS:
        raise AttributeError(f"there is no job '{name}'; jobs are {', '.join(JOBS)}")
    return partial(start, name)


def start(name: str) -> NoReturn:
    """Runs a job with the words of the command line; never returns."""
    run_job(importlib.import_module(f"jobs.{name}").main)
