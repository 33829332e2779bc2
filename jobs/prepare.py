"""Write photos on disk into tar shards with an index.

    python -m jobs.prepare --source DIR --out DIR --rounds 4
    python -m jobs.prepare --verify DIR
    python -m jobs.prepare --source DIR --out DIR --part 3 --parts 8

The same command continues a killed run; after a finished run it says that nothing is to do. Exit codes: 0 done,
2 usage, 3 too many bad images or a damaged set.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from jobs.cli import parse, run_job
from pipeline.common.errors import DataError, UsageError


@dataclass(frozen=True)
class PrepareConfig:
    """What to prepare, or to verify."""

    source: str | None = None
    """Folder of GSV-Cities (Images/ and Dataframes/), Mapillary SLS (train_val/), @utm names, or your own places."""
    out: str | None = None
    """Folder of the shard set: new, empty, or an unfinished set of the same source and settings."""
    rounds: int = 4
    """Rounds R, each with four images of every place; epoch e reads round e mod R. ceil(n/4) rounds show n images."""
    seed: int = 0
    """Seed of the images of a round and of the order of places."""
    max_bad: float = 0.01
    """Largest share of missing or broken images; above it the run ends with code 3."""
    shard_mb: float = 64.0
    """Approximate size of a shard file in MB; smaller in a small set, so that a round has about 16 of them."""
    resize: int = 0
    """Reduce larger photos to this shorter side in pixels (JPEG quality 95); 0 copies the bytes."""
    check: Literal["decode", "header", "none"] = "decode"
    """How each JPEG is checked: decoded to its end, header and end marker only, or not at all."""
    kind: Literal["auto", "gsv_cities", "msls", "folders", "utm"] = "auto"
    """Layout of the source: auto: recognised; GSV-Cities, Mapillary SLS, a folder per place, or @utm names in cells."""
    cities: tuple[str, ...] = ()
    """gsv_cities, msls: cities to keep, for example '[PRS,Osaka]'; none keeps all (msls: all but cph and sf)."""
    cell_m: float | None = None
    """utm, msls: side of a place's cell in metres; 10 (utm) or 25 (msls) where it is not given."""
    heading_deg: float | None = None
    """utm, msls: width of a place's sector of headings in degrees; 30 (utm) or 60 (msls) where not given; 0: all."""
    workers: int = 0
    """Processes; 0: one per core, if there is work for it. The shards' bytes do not depend on it."""
    part: int = 0
    """Write only this of the `parts` shares of the shards, from 1; parts may be written at the same time on several
    machines. When all are done, the same command without part and parts adds the index."""
    parts: int = 0
    """Number of shares."""
    overwrite: bool = False
    """Delete the shard set in --out first."""
    verify: str | None = None
    """Check every byte of a shard set (folder or fsspec URL) instead; code 3 if anything is wrong."""


def main() -> None:
    """Runs the job."""
    config = parse(PrepareConfig, (__doc__ or "").split("\n\n    ")[0])
    if config.verify is not None:
        verify(config.verify)
    elif config.source is None or config.out is None:
        raise UsageError("give --source DIR and --out DIR, or --verify DIR")
    else:
        prepare(config, Path(config.source), Path(config.out))


def verify(root: str) -> None:
    """Prints what is wrong with a shard set and raises DataError, or says that all is well."""
    from shards import index

    problems = index.verify(root)
    for problem in problems:
        print(f"{root}: {problem}")
    if problems:
        raise DataError(f"{root}: {len(problems)} problem{'s' * (len(problems) > 1)}; do not train on this set")
    counts = index.read_index(root).manifest["counts"]
    print(f"{root}: all well, {counts['shards']:,} shards, {counts['bytes']:,} bytes, {counts['places']:,} places")


def prepare(config: PrepareConfig, source: Path, out: Path) -> None:
    """Reads the source, writes the shard set, prints the summary."""
    from shards.images import ImageRule
    from shards.sources.registry import SourceRule, read_source, reading_settings
    from shards.writer import WriteRule, check_writable, remove_shards, write_part, write_shards

    if config.part or config.parts:
        if config.overwrite:
            raise UsageError("--overwrite deletes what other parts have written; start it once, without --part")
        if not config.part or not config.parts:
            raise UsageError("--part and --parts go together, as --part 3 --parts 8")
    check_writable(out, shared=bool(config.part))
    reading = SourceRule(config.kind, tuple(config.cities), config.cell_m, config.heading_deg)
    catalogue = read_source(source, reading)
    for remark in catalogue.remarks:
        print(f"{source}: {remark}")
    if config.overwrite:
        remove_shards(out)
    image = ImageRule(config.check, config.resize)
    rule = WriteRule(
        config.rounds, config.seed, config.shard_mb, image, reading_settings(catalogue.kind, reading),
        config.max_bad, config.workers,
    )  # fmt: skip
    if config.part:
        done = write_part(catalogue, out, rule, config.part, config.parts)
        print(f"{out}: part {config.part} of {config.parts} is written, {done:,} groups of shards")
        return
    summary = write_shards(catalogue, out, rule)
    print(f"{out}: {'complete' if summary.seconds else 'nothing to do, complete already'} ({catalogue.kind})")
    print(summary)


if __name__ == "__main__":
    run_job(main)
