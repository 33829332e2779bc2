"""Draws the miniature city: `python -m jobs.miniature --out data/miniature --places 300 --seed 0`.

Invariant: running it again draws only what is missing.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.cli import parse, run_job


@dataclass(frozen=True)
class MiniatureConfig:
    """What to draw, and where."""

    out: str = "data/miniature"
    """Folder that gets gsv/ (GSV-Cities' layout) and eval/miniature/ (database and queries)."""
    places: int = 300
    """Training places, spread evenly over four towns."""
    seed: int = 0
    """Seed of everything; the same seed gives the same bytes."""
    width: int = 320
    """Width of a photo in pixels."""
    height: int = 240
    """Height of a photo in pixels."""
    val_places: int | None = None
    """Places of the validation folder; none: a fifth of --places."""
    test_places: int | None = None
    """Places of the test folder; none: a third of --places."""
    workers: int | None = None
    """Processes; none: one a core."""


def main() -> None:
    config = parse(MiniatureConfig, "Draw the miniature city in GSV-Cities' and the evaluation folders' layouts.")
    from pathlib import Path

    from shards.sources.miniature import draw

    summary = draw(
        Path(config.out), config.places, config.seed, (config.width, config.height), config.workers,
        config.val_places, config.test_places,
    )  # fmt: skip
    print(summary.describe())


if __name__ == "__main__":
    run_job(main)
