"""Edited evaluation folders, lists, manifests, predictions and weights: each ends in one line, or in a whole set."""

from __future__ import annotations

import csv
import io
import json
import random
from pathlib import Path

import numpy as np
import pytest
import torch
from mutations import ODD, Tally, as_json, edited_bytes, edited_json
from safetensors.torch import save_file
from tiny_checkpoint import save_tiny

from pipeline.config import EvaluationConfig
from pipeline.evaluation.evaluate import Answers, score
from pipeline.evaluation.predictions import load_predictions, save_predictions
from pipeline.evaluation.protocol import protocols
from pipeline.evaluation.report import tables
from pipeline.evaluation.sets.load import load_set
from pipeline.locate.photos import find_photos
from pipeline.model.weights.files import read_metadata
from pipeline.model.weights.load import load_any
from pipeline.model.weights.pretrained import read_tensors

CODES = (2, 3)
COUNTS = [8, pytest.param(150, marks=pytest.mark.slow)]
PHOTOS = [f"{side}/@{583400 + 30 * i}.00@4477100.00@.jpg" for side in ("database", "queries") for i in range(4)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Four database photos and four queries, 30 m apart."""
    for name in PHOTOS:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"\xff\xd8\xff\xd9")
    return tmp_path


def whole(path: Path) -> None:
    """Loads a set; what is accepted must hold together: photos on disk, positives in range, plain remarks."""
    loaded = load_set(str(path), EvaluationConfig(root=str(path.parent)))
    assert all(photo.exists() for photo in (*loaded.database, *loaded.queries))
    assert all(remark.isprintable() for remark in loaded.remarks) and len(loaded.positives) == len(loaded.queries)


def finish(tally: Tally, least: int) -> None:
    print(tally)
    assert not tally.faults, "\n".join(tally.faults[:5])
    assert tally.ends["one line"] >= least, f"{tally}: the edits do no harm, so they test nothing"


@pytest.mark.parametrize("count", COUNTS)
def test_fixed_lists(folder: Path, count: int) -> None:
    """An edited number in a list of positives is another list; anything else is refused."""
    ragged = np.empty(4, object)
    ragged[:] = [np.array([i, (i + 1) % 4]) for i in range(4)]
    np.save(folder / "walk_dbImages.npy", np.array(PHOTOS[:4]))
    np.save(folder / "walk_qImages.npy", np.array(PHOTOS[4:]))
    np.save(folder / "walk_gt.npy", ragged, allow_pickle=True)
    whole(folder)
    tally = Tally()
    for seed, name in enumerate(("walk_dbImages.npy", "walk_qImages.npy", "walk_gt.npy")):
        content = (folder / name).read_bytes()
        for what, changed in edited_bytes(content, seed, count):
            (folder / name).write_bytes(changed)
            tally.run(f"{name}: {what}", lambda: whole(folder), CODES, harmless=True)
        (folder / name).write_bytes(content)
    finish(tally, count)


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_manifests(folder: Path, suffix: str, count: int) -> None:
    table = {
        "image": PHOTOS,
        "role": ["database"] * 4 + ["query"] * 4,
        "utm_east": [583400.0 + 30 * i for i in range(8)],
        "utm_north": [4477100.0] * 8,
    }
    path = folder / f"set{suffix}"

    def write(columns: dict[str, list[object]]) -> None:
        if suffix == ".parquet":
            import pyarrow as pa
            from pyarrow import parquet

            parquet.write_table(pa.table({name: list(map(str, column)) for name, column in columns.items()}), path)
            return
        rows = io.StringIO()
        csv.writer(rows).writerows([list(columns), *zip(*columns.values(), strict=True)])
        path.write_bytes(rows.getvalue().encode(errors="surrogatepass"))

    write(table)  # type: ignore[arg-type]
    whole(path)
    tally, content, draw = Tally(), path.read_bytes(), random.Random(1)
    for what, changed in edited_bytes(content, 0, count):
        path.write_bytes(changed)
        tally.run(what, lambda: whole(path), CODES, harmless=True)
        tally.run(f"{what}, to locate", lambda: find_photos([path], progress=False), CODES, harmless=True)
    for _ in range(count):
        column, row, odd = draw.choice(list(table)), draw.randrange(8), draw.choice(ODD)
        if isinstance(odd, str) and "\udcff" in odd and suffix == ".parquet":
            continue
        changed_table = {name: list(values) for name, values in table.items()}
        changed_table[column][row] = odd
        write(changed_table)  # type: ignore[arg-type]
        tally.run(f"{column}[{row}] = {odd!r}"[:80], lambda: whole(path), CODES, harmless=True)
    finish(tally, count)


@pytest.mark.parametrize("count", COUNTS)
def test_names_in_folders(folder: Path, count: int) -> None:
    """Photos of odd names beside the others: positions that are none, markup, escapes, bytes that are no text."""
    draw, tally = random.Random(2), Tally()
    fields = [
        "nan",
        "inf",
        "1e999",
        "",
        "-",
        "583400",
        "4477100",
        "2.35",
        "48.85",
        "\x1b[31m",
        "=1",
        "ü",
        "\udcff",
        "\n",
    ]
    for number in range(2 * count):
        name = "@".join(["", *draw.choices(fields, k=draw.randint(1, 6)), ".jpg"])
        photo = folder / draw.choice(["database", "queries"]) / (name if number % 3 else name.strip("@"))
        photo.write_bytes(b"")
        tally.run(repr(photo.name), lambda: whole(folder), CODES, harmless=True)
        photo.unlink()
    finish(tally, count // 2)


@pytest.mark.parametrize("count", COUNTS)
def test_results_and_predictions(folder: Path, count: int) -> None:
    config = EvaluationConfig(recalls=(1,), groups=("single",))
    evaluated = load_set(str(folder), config)
    rows, distances = np.tile(np.arange(4), (4, 1)), np.zeros((4, 4), np.float32)
    result = score(evaluated, protocols(config, 224, evaluated.rule)[0], config, Answers(rows, distances))
    predictions, results = save_predictions(result, evaluated, folder), folder / "results.json"
    tables.write_json([result], results, {})
    tally = Tally()
    for path, read in ((predictions, load_predictions), (results, tables.read_json)):
        content = path.read_bytes()
        for what, changed in edited_bytes(content, 3, count):
            path.write_bytes(changed)
            tally.run(f"{path.name}: {what}", lambda path=path, read=read: read(path), CODES, harmless=True)  # type: ignore[misc]
        path.write_bytes(content)
    for what, value in edited_json(json.loads(results.read_text()), 4, count):
        results.write_bytes(as_json(value))
        tally.run(f"results.json: {what}", lambda: tables.read_json(results), CODES, harmless=True)
    finish(tally, count)


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("kind", ["zip", "legacy", "safetensors", "ours"])
def test_weights(tmp_path: Path, kind: str, count: int) -> None:
    """Numbers have no checksum (but for the zip's): an edited number is another model, anything else is refused."""
    tensors = {f"blocks.{i}.weight": torch.arange(12.0).reshape(3, 4) for i in range(4)}
    path = tmp_path / "released.pth"
    if kind == "ours":
        path = save_tiny(tmp_path, 0) / "checkpoints/best/model.safetensors"
    elif kind == "safetensors":
        save_file(tensors, path)
    else:
        torch.save({"state_dict": tensors}, path, _use_new_zipfile_serialization=kind == "zip")
    tally, content = Tally(), path.read_bytes()

    def read() -> object:
        return load_any(path) if kind == "ours" else read_tensors(str(path))

    read()
    for what, changed in edited_bytes(
        content, 4, min(count, 12) if kind == "ours" else count
    ):  # a model takes its time
        path.write_bytes(changed)
        tally.run(f"{kind}: {what}", read, CODES, harmless=True)
    head = 8 + int.from_bytes(content[:8], "little")
    for what, changed in edited_bytes(content[8:head], 5, count) if kind == "ours" else ():
        path.write_bytes(len(changed).to_bytes(8, "little") + changed + content[head:])
        tally.run(f"our header: {what}", lambda: read_metadata(path), CODES, harmless=True)
    finish(tally, count // 3)
