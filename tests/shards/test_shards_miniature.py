"""The miniature city: real layouts to the letter, the same bytes on any number of processes, disjoint places."""

from __future__ import annotations

import csv
import hashlib
import io
import math
import re
import subprocess
import sys
from collections import Counter, defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.common.errors import DataError, UsageError
from shards.sources.miniature import MiniatureConfig, draw
from shards.sources.miniature.photograph import Studio
from shards.sources.miniature.plan import STEP, degrees, plan_photos

PLACES, VAL, TEST, SIZE = 10, 2, 4, (96, 72)
CITY = MiniatureConfig(places=PLACES, seed=3, width=96, height=72, workers=1, val_places=VAL, test_places=TEST)
COLUMNS = ["place_id", "year", "month", "northdeg", "city_id", "lat", "lon", "panoid"]


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, int]]:
    """The folder, and its photos by part."""
    out = tmp_path_factory.mktemp("miniature")
    return out, draw(replace(CITY, out=str(out))).photos


def digests(out: Path) -> dict[str, str]:
    files = (path for path in out.rglob("*") if path.is_file())
    return {p.relative_to(out).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def utm_of(path: Path) -> tuple[float, float]:
    fields = path.name.split("@")
    return float(fields[1]), float(fields[2])


def test_every_row_of_the_data_frames_names_a_photo_and_every_photo_a_row(city: tuple[Path, dict[str, int]]) -> None:
    """The name is rebuilt from the CSV's strings by the published rule; only the suffix may differ."""
    root, photos = city[0] / "gsv", city[1]
    named = set()
    for table in (root / "Dataframes").glob("*.csv"):
        with table.open(newline="") as lines:
            rows = list(csv.DictReader(lines))
        assert list(rows[0]) == COLUMNS
        for r in rows:
            stem = (
                f"{r['city_id']}_{int(r['place_id']) % 10**5:07d}_{int(r['year']):04d}_{int(r['month']):02d}"
                f"_{int(r['northdeg']):03d}_{r['lat']}_{r['lon']}_{r['panoid']}"
            )
            found = [s for s in (".jpg", ".JPG") if (root / "Images" / r["city_id"] / (stem + s)).is_file()]
            assert len(found) == 1, stem
            named.add(stem + found[0])
    assert named == {p.name for p in (root / "Images").rglob("*") if p.is_file()}
    assert len(named) == photos["gsv"]
    assert {Path(n).suffix for n in named} == {".jpg", ".JPG"}
    assert any("_" in n.split("_", 7)[7] for n in named) and any("-" in n.split("_", 7)[7] for n in named)


def test_places_have_four_to_twelve_photos_and_a_few_have_fewer() -> None:
    counts = Counter(len(p.photos) for p in plan_photos(0, (400, 0, 0)))
    few = sum(n for size, n in counts.items() if size < 4)
    assert min(counts) >= 2 and max(counts) == 12
    assert 0 < few < 0.08 * 400
    assert 5.5 < sum(size * n for size, n in counts.items()) / 400 < 8


def test_evaluation_names_hold_fourteen_fields_in_the_common_format(city: tuple[Path, dict[str, int]]) -> None:
    photos = sorted((city[0] / "eval/miniature/images").rglob("*.jpg"))
    assert len(photos) == 6 * (VAL + TEST)
    for path in photos:
        fields = path.name.split("@")
        assert len(fields) == 16 and fields[0] == "" and fields[15] == ".jpg"
        assert all(re.fullmatch(r"\d{7}\.\d{2}", f) for f in fields[1:3])
        assert fields[3:5] == ["27", "S"]
        assert degrees(*utm_of(path)) == pytest.approx((float(fields[5]), float(fields[6])), abs=1e-5)


def test_latitude_and_longitude_are_those_of_zone_27() -> None:
    """The `utm` package's own example (51.2 N, 7.5 E of zone 32), 30 degrees farther west; the central meridian."""
    assert degrees(395201.3103811303, 5673135.241182375) == pytest.approx((51.2, 7.5 - 30), abs=2e-7)
    assert degrees(500000.0, 0.0) == pytest.approx((0.0, -21.0), abs=1e-9)


def test_places_of_a_street_are_neighbours_that_show_the_same_houses() -> None:
    """10 to 20 m apart, so some different places are within 25 m, on 12 a street; streets are far from each other."""
    planned = plan_photos(0, (48, 0, 24), a_street=12)
    assert len({p.seed for p in planned}) == 6 and len({f.file for p in planned for f in p.photos}) > 300
    where: dict[tuple[int, ...], list[np.ndarray]] = defaultdict(list)
    for place in planned:
        fields = [Path(f.file).name.split("_" if f.row else "@") for f in place.photos]
        at = np.array([[float(v) for v in f[5:7]] for f in fields])
        metres = at * [111_000, 111_000 * math.cos(math.radians(at[0, 0]))]
        assert np.abs(metres - metres.mean(axis=0)).max() < 12
        where[place.seed].append(metres.mean(axis=0))
    steps = np.concatenate([np.linalg.norm(np.diff(np.stack(w), axis=0), axis=1) for w in where.values()])
    assert steps.min() > 5 and steps.max() < 26 and 12 < steps.mean() < 18
    centres = [np.stack(w).mean(axis=0) for w in where.values()]
    gaps = [np.linalg.norm(a - b) for k, a in enumerate(centres) for b in centres[:k]]
    assert min(gaps) > 2 * STEP[1] * 12
    studios = [Studio(p.town, p.seed, p.length) for p in planned[:13:12]]
    assert studios[0].place != studios[1].place


@pytest.mark.parametrize("split", ["val", "test"])
def test_queries_lie_near_their_place_and_far_from_the_others(city: tuple[Path, dict[str, int]], split: str) -> None:
    """All four database photos of a query's place, and no other, are within 25 m; file order keeps them together."""
    root = city[0] / "eval/miniature/images" / split
    database, queries = sorted((root / "database").glob("@*")), sorted((root / "queries").glob("@*"))
    assert len(database) == 2 * len(queries)
    there = np.array([utm_of(p) for p in database])
    used: Counter[int] = Counter()
    for query in queries:
        distance = np.linalg.norm(there - np.array(utm_of(query)), axis=1)
        near = np.flatnonzero(distance <= 25)
        assert len(near) == 4 and near.tolist() == list(range(near[0], near[0] + 4)) and near[0] % 4 == 0
        assert np.delete(distance, near).min() > 35
        used[int(near[0])] += 1
    assert set(used.values()) == {2} and len(used) == len(queries) // 2


def test_training_and_evaluation_places_are_disjoint() -> None:
    planned = plan_photos(0, (200, 60, 60))
    assert len({p.seed for p in planned}) == 320
    houses: dict[int, int] = defaultdict(int)
    for place in (planned[0], planned[4], planned[200], planned[260]):
        for building in Studio(place.town, place.seed).place.buildings:
            houses[building.seed] += 1
    assert max(houses.values()) == 1
    corners = [Path(photo.file).name.split("_") for p in planned[:200] for photo in p.photos]
    train = {(round(float(c[5]), 3), round(float(c[6]), 3)) for c in corners}
    for place in planned[200:]:
        for photo in place.photos:
            fields = photo.file.split("@")
            assert (round(float(fields[5]), 3), round(float(fields[6]), 3)) not in train


def test_photos_decode_to_the_size_asked_and_are_not_flat(city: tuple[Path, dict[str, int]]) -> None:
    for path in [p for p in city[0].rglob("*") if p.suffix.lower() == ".jpg"]:
        with Image.open(path) as image:
            assert image.format == "JPEG" and image.size == SIZE and image.mode == "RGB"
            assert np.asarray(image).std() > 6, path


def test_bytes_do_not_depend_on_the_processes_and_a_killed_run_is_finished(
    city: tuple[Path, dict[str, int]], tmp_path: Path
) -> None:
    truth = digests(city[0])
    first = draw(replace(CITY, out=str(tmp_path), workers=2))
    assert digests(tmp_path) == truth and first.drawn == len([n for n in truth if n.lower().endswith(".jpg")])
    lost = [n for n in sorted(truth) if n.lower().endswith(".jpg")][::7]
    for name in lost:
        (tmp_path / name).unlink()
    (tmp_path / "gsv/Dataframes/Portalba.csv").unlink()
    again = draw(replace(CITY, out=str(tmp_path)))
    assert again.drawn == len(lost) and digests(tmp_path) == truth
    third = draw(replace(CITY, out=str(tmp_path)))
    assert third.drawn == 0 and "nothing to do" in third.describe()


def test_another_seed_is_another_city_and_another_folder(city: tuple[Path, dict[str, int]]) -> None:
    one, other = ({p.photos[0].file for p in plan_photos(seed, (8, 0, 0))} for seed in (1, 2))
    assert one.isdisjoint(other)
    with pytest.raises(DataError, match="seed 3 there, 4 asked"):
        draw(replace(CITY, out=str(city[0]), seed=4))


def test_counts_scale_with_places_and_nonsense_is_refused(tmp_path: Path) -> None:
    small = MiniatureConfig(str(tmp_path / "small"), places=10, width=64, height=48, workers=1)
    photos = draw(small).photos
    assert photos.pop("gsv") > 40
    assert photos == {"val/database": 8, "val/queries": 4, "test/database": 12, "test/queries": 6}
    for name, value in (("places", 0), ("places", 5000), ("width", 8), ("workers", 0), ("street_places", 0)):
        with pytest.raises(UsageError, match=f"{name} = {value}" + (".*1100 streets" if value == 5000 else "")):
            draw(replace(small, out=str(tmp_path / "wrong"), **{name: value}))  # type: ignore[arg-type]
    assert not (tmp_path / "wrong").exists()


def test_photos_of_a_place_show_the_same_place() -> None:
    """Two fair-weather photos of a place, a few metres and another day apart, agree more than photos of two places."""
    planned = plan_photos(5, (1, 0, 32))[1:]

    def look(index: int, view: int) -> np.ndarray:
        place = planned[index]
        data = Studio(place.town, place.seed).photograph(place.photos[view], (96, 72))
        grey = np.asarray(Image.open(io.BytesIO(data)).convert("L").resize((16, 12)), dtype=np.float64)
        return (grey - grey.mean()) / grey.std()

    views = np.stack([[look(k, v) for v in (1, 2)] for k in range(len(planned))])
    views -= views.mean(axis=(0, 1))  # what all streets share: sky above, road below
    likeness = np.einsum("ahw,bhw->ab", views[:, 0], views[:, 1]) / views[0, 0].size
    same, others = np.diag(likeness), likeness[~np.eye(len(planned), dtype=bool)]
    assert same.mean() > others.mean() + 0.06, (same.mean(), others.mean())


def test_the_camera_keeps_the_rules_of_perspective() -> None:
    """A wall's corners land where the pinhole equation puts them, on either side of a turn of the head."""
    from shards.sources.miniature.camera import Camera, faces, lay, upright

    camera = Camera(1.0, 1.7, -2.0, 0.3, 200.0, 120.0, 320, 240)
    wall = upright(2.0, 18.0, 8.0, 18.0, 0.0, 5.0)
    assert faces(wall, camera) and not faces(upright(8.0, 18.0, 2.0, 18.0, 0.0, 5.0), camera)
    expected = []
    for x, y, z in wall:
        right, ahead = x - 1.0, z + 2.0
        across = right * math.cos(0.3) - ahead * math.sin(0.3)
        depth = right * math.sin(0.3) + ahead * math.cos(0.3)
        expected.append((160 + 200 * across / depth, 120 - 200 * (y - 1.7) / depth))
    assert np.array(camera.polygon(wall)) == pytest.approx(np.array(expected))
    canvas = Image.new("RGB", (320, 240))
    chequer = Image.new("RGB", (64, 64), (255, 0, 0))
    chequer.paste((0, 255, 0), (32, 0, 64, 64))
    lay(canvas, camera, wall, chequer, None)
    spot = camera.project([(5.0, 2.5, 18.0)])[0]  # the seam between the halves, at the wall's centre
    u, v = int(spot[0] / spot[2]), int(spot[1] / spot[2])
    assert canvas.getpixel((u - 3, v)) == (255, 0, 0) and canvas.getpixel((u + 3, v)) == (0, 255, 0)


def test_the_job_draws_from_the_command_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "jobs.miniature", "--out", str(tmp_path / "city"), "--places", "4"]
    small = ["--width", "64", "--height", "48", "--val_places", "0", "--test_places", "1", "--workers", "1"]
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run([*command, *small], cwd=root, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "photos in gsv" in done.stdout and len(list((tmp_path / "city/gsv/Dataframes").glob("*.csv"))) == 4
    wrong = subprocess.run([*command, "--seed", "9"], cwd=root, capture_output=True, text=True, timeout=120)
    assert wrong.returncode == 3 and "other settings" in wrong.stderr and "Traceback" not in wrong.stderr
