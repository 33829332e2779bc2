"""Edited data frames and photos: refused in one line, or read so that nothing is lost without a word."""

from __future__ import annotations

import io
import os
import random
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.common.errors import DataError
from pipeline.data.images import decode, load_image
from shards.images import ImageRule, Refused, admit
from shards.sources import gsv_cities
from tests.support.mutations import Tally, edited_bytes

VALUES = [
    "", "abc", "nan", "inf", "-1e999", "9" * 400, "1.5", "0x10", "1,5", '"', '""', "\0", "\x1b[31m", "../..", "/etc",
    "..", "a/b", "a\\b", "é", "\u202e", "=1+1", "x" * 100_000, "None", "-0", "1e3", " 7 ", "\ufeff", "91", "181",
    "PRS\n1",
]  # fmt: skip
PLACES, VIEWS = 3, 4


def source(root: Path) -> tuple[Path, bytes]:
    """A small GSV-Cities folder, and the content of its data frame."""
    lines = [",".join(gsv_cities.COLUMNS)]
    (root / "Images" / "PRS").mkdir(parents=True)
    (root / "Dataframes").mkdir()
    for place in range(PLACES):
        for month in range(1, VIEWS + 1):
            lines.append(f"{place},2015,{month},{month * 90},PRS,48.{place}{month},2.5,pano_{month}")
            name = f"PRS_{place:07d}_2015_{month:02d}_{month * 90:03d}_48.{place}{month}_2.5_pano_{month}.jpg"
            (root / "Images" / "PRS" / name).write_bytes(b"1")
    return root / "Dataframes" / "PRS.csv", ("\n".join(lines) + "\n").encode()


def edited_frame(content: bytes, rng: random.Random) -> tuple[str, bytes]:
    rows = [line.split(",") for line in content.decode().splitlines()]
    row, column, value = rng.randrange(len(rows)), rng.randrange(8), rng.choice(VALUES)
    how = rng.choice(["value", "value", "value", "value", "less", "more", "header", "encoding", "separator"])
    if how == "value":
        rows[row][column] = value
    elif how == "less":
        del rows[row][column]
    elif how == "more":
        rows[row].insert(column, value)
    elif how == "header":
        rows[0][column] = rng.choice([rows[0][column - 1], rows[0][column].upper(), "#1", value])
    separator = rng.choice([";", "\t", "|", " "]) if how == "separator" else ","
    text = rng.choice(["\n", "\r\n", "\n\n"]).join(separator.join(cells) for cells in rows)
    if how == "encoding":
        return how, text.encode(rng.choice(["utf-16", "utf-32", "utf-8-sig", "cp037"]))
    return f"{how} row {row} column {column} {value[:20]!r}", text.encode()


@pytest.mark.parametrize("cases", [60, pytest.param(400, marks=pytest.mark.slow)])
def test_edited_data_frames(cases: int, tmp_path: Path) -> None:
    """Where a frame is accepted, each of its photos is found in the folder, named as missing, or counted as unnamed."""
    frame, content = source(tmp_path)
    photos = PLACES * VIEWS
    tally = Tally()

    def read() -> None:
        found = gsv_cities.read(tmp_path)
        paths = found.table["path"].to_pylist()
        assert len(paths) + found.unlisted == photos, "a photo is neither read nor counted"
        for path in paths:
            assert os.path.realpath(tmp_path / path).startswith(f"{os.path.realpath(tmp_path)}/Images/")
        assert all(item.reason == "missing" for item in found.left_out)

    edits = [edited_frame(content, random.Random(f"frame {seed}")) for seed in range(cases * 2 // 3)]
    for what, changed in [*edits, *edited_bytes(content, 7, cases // 3)]:
        frame.write_bytes(changed)
        tally.run(what, read, (3,), harmless=True)
    print(f"\nedited data frames: {tally}")
    assert not tally.faults, "\n".join(tally.faults)
    assert tally.ends["one line"] > cases / 3


def photos() -> dict[str, bytes]:
    noise = np.random.default_rng(1).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    picture = Image.fromarray(noise).resize((80, 60), Image.Resampling.BICUBIC)
    exif = Image.Exif()
    exif[0x0112], exif[0x010E] = 6, "a street"
    kinds = {
        "baseline": ("JPEG", {"quality": 80}), "progressive": ("JPEG", {"progressive": True}),
        "turned": ("JPEG", {"exif": exif}), "png": ("PNG", {}), "webp": ("WEBP", {}), "tiff": ("TIFF", {}),
        "gif": ("GIF", {}), "turned png": ("PNG", {"exif": exif}),
    }  # fmt: skip
    made = {}
    for name, (kind, options) in kinds.items():
        target = io.BytesIO()
        picture.save(target, kind, **options)
        made[name] = target.getvalue()
    return made


@pytest.mark.parametrize("cases", [20, pytest.param(120, marks=pytest.mark.slow)])
def test_edited_photos(cases: int, tmp_path: Path) -> None:
    """`cases` of each kind. What preparing admits, training decodes; and evaluation refuses in a line or reads."""
    tally = Tally()
    path = tmp_path / "photo.jpg"
    for kind, data in photos().items():
        for what, changed in edited_bytes(data, 3, cases):
            for rule in (ImageRule(convert=True), ImageRule(resize=30, convert=True)):

                def prepare(changed: bytes = changed, rule: ImageRule = rule) -> None:
                    stored = admit(changed, rule)
                    if isinstance(stored, Refused):
                        raise DataError(f"photo.jpg: {stored.reason}")
                    assert decode(stored).ndim == 3

                tally.run(f"{kind} {what}, prepared", prepare, (3,), harmless=True)
            path.write_bytes(changed)
            tally.run(f"{kind} {what}, evaluated", lambda: load_image(path), (3,), harmless=True)
    print(f"\nedited photos: {tally}")
    assert not tally.faults, "\n".join(tally.faults)
