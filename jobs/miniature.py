"""Draws the miniature city: `python -m jobs.miniature --out data/miniature --places 300 --seed 0`.

Invariant: running it again draws only what is missing.
"""

from __future__ import annotations

from jobs.cli import parse, run_job
from shards.sources.miniature import MiniatureConfig, draw


def main() -> None:
    """Draws what is missing and says what is there."""
    config = parse(MiniatureConfig, "Draw the miniature city in GSV-Cities' and the evaluation folders' layouts.")
    print(f"{config.out}: {draw(config).describe()}")


if __name__ == "__main__":
    run_job(main)
