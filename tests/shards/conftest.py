"""Small sources with every trap of the real ones, made of photos that are all different."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
import simplejpeg

Photo = Callable[[int], bytes]
Gsv = Callable[..., Path]


@pytest.fixture(scope="session")
def photo() -> Photo:
    """`photo(n)`: the bytes of the n-th JPEG, 40 x 30 pixels of noise; all different."""

    def make(n: int) -> bytes:
        pixels = np.random.default_rng(n).integers(0, 256, (30, 40, 3), dtype=np.uint8)
        return bytes(simplejpeg.encode_jpeg(pixels, quality=85))

    return make


@pytest.fixture
def gsv(tmp_path: Path, photo: Photo) -> Gsv:
    """`gsv({"PRS": [5, 4, 3]})`: a GSV-Cities folder with places of so many photos, ids 7, 100008, 200009, ..."""

    def make(cities: Mapping[str, Sequence[int]], name: str = "source") -> Path:
        root = tmp_path / name
        (root / "Dataframes").mkdir(parents=True)
        serial = 0
        for city, counts in cities.items():
            (root / "Images" / city).mkdir(parents=True)
            with (root / "Dataframes" / f"{city}.csv").open("w", newline="") as stream:
                rows = csv.writer(stream)
                rows.writerow(["place_id", "year", "month", "northdeg", "city_id", "lat", "lon", "panoid"])
                for place, count in enumerate(counts):
                    for view in range(count):
                        serial += 1
                        place_id, northdeg = place * 100_001 + 7, (-10, 5, 90, 731, 359)[serial % 5]
                        lat, lon, pano = f"48.{serial:014d}", f"-2.{serial}", f"-a_{serial}-_Gg"
                        month = view % 12 + 1
                        rows.writerow([place_id, 2015, month, northdeg, city, lat, lon, pano])
                        stem = f"{city}_{place_id % 100_000:07d}_2015_{month:02d}_{northdeg:03d}_{lat}_{lon}_{pano}"
                        suffix = (".jpg", ".JPG")[serial % 2]
                        (root / "Images" / city / (stem + suffix)).write_bytes(photo(serial))
        return root

    return make
