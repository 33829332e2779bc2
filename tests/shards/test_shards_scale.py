"""Preparing at the true scale of GSV-Cities: 470,834 rows of the real data frames, each with a tiny photo."""

from __future__ import annotations

import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from shards import index, schema
from shards.sources.frames import read_frame
from shards.sources.gsv_cities import COLUMNS

PLACES = 57_462  # with at least four images, of 59,342
ROWS = 470_834
STARTER = """
import resource, subprocess, sys
code = subprocess.run(sys.argv[1:]).returncode
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
sys.exit(code)
"""


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_all_places_of_gsv_cities(shared_dir: Path, tmp_path: Path, photo: Callable[[int], bytes]) -> None:
    """Every place is there in every round; prints seconds and the peak memory of the largest process."""
    frames = sorted((shared_dir / "data" / "gsv_cities_metadata").glob("*.csv.gz"))
    if not frames:
        pytest.skip("no real data frames beside this checkout")
    source = tmp_path / "source"
    (source / "Dataframes").mkdir(parents=True)
    for n in range(64):
        (source / f"{n}.bytes").write_bytes(photo(n))
    for frame in frames:
        (source / "Dataframes" / frame.name).symlink_to(frame)
        _link_photos(source, frame)
    out, before = tmp_path / "out", time.monotonic()
    command = [sys.executable, "-m", "jobs.prepare", "--source", source, "--out", out, "--rounds", "2"]
    # Linux counts the memory of the process that forked as the child's: a small one in between, not this test's
    starter = [sys.executable, "-c", STARTER, *map(str, command)]
    done = subprocess.run(starter, stdout=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 0
    told, _, largest = done.stdout.rstrip().rpartition("\n")
    seconds = time.monotonic() - before
    print(f"\n{told}\nwhole job {seconds:.1f} s, largest process {int(largest) / 1e3:.0f} MB")
    started = time.monotonic()
    opened = index.read_index(str(out))
    print(f"read_index: {time.monotonic() - started:.2f} s, {(out / schema.INDEX).stat().st_size / 1e6:.1f} MB on disk")
    counts = opened.manifest["counts"]
    assert opened.table.num_rows == 2 * PLACES
    assert counts["places"] == PLACES and counts["places_under_four"] == 59_342 - PLACES
    assert counts["places_fallen"] == 0 and counts["images_bad"] == 0
    named = Counter(
        (row["city_id"], row["place_id"]) for frame in frames for row in read_frame(frame, COLUMNS).to_pylist()
    )
    pairs = list(zip(opened.table["city"].to_pylist(), opened.table["place_id"].to_pylist(), strict=True))
    assert Counter(pairs) == Counter({place: 2 for place, n in named.items() if n >= 4})
    assert counts["images_named"] + counts["duplicates"] == ROWS
    assert int(largest) < 1_500_000  # kB


def _link_photos(source: Path, frame: Path) -> None:
    """A link for each row, named as the data set names its photos; extensions mixed."""
    rows = read_frame(frame, COLUMNS).to_pylist()
    for n, row in enumerate(rows):
        folder = source / "Images" / row["city_id"]
        if n == 0:
            folder.mkdir(parents=True, exist_ok=True)
        numbers = [int(row[name]) for name in ("place_id", "year", "month", "northdeg")]
        head = f"{row['city_id']}_{numbers[0] % 100_000:07d}_{numbers[1]:04d}_{numbers[2]:02d}_{numbers[3]:03d}"
        name = f"{head}_{row['lat']}_{row['lon']}_{row['panoid']}" + (".jpg", ".JPG")[n % 2]
        link = folder / name
        if not link.is_symlink():
            link.symlink_to(f"../../{n % 64}.bytes")
