"""Blocks, regions on disk, and an encoding that was killed; the W-independence is proved in test_eval_evaluate."""

from __future__ import annotations

import dataclasses
import json
import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor, nn

from pipeline.common.errors import DataError
from pipeline.config import EvaluationConfig
from pipeline.evaluation.describe import encode as encoding
from pipeline.evaluation.describe.encode import Regions, blocks_of, encode, evaluating


class Means(nn.Module):
    """Three colours times a learnt factor, as one region."""

    def __init__(self) -> None:
        super().__init__()
        self.image_size, self.regions, self.descriptor_dim = 8, 1, 3
        self.factor = nn.Parameter(torch.ones(1))
        self.seen = 0

    def encode(self, images: Tensor) -> Tensor:
        self.seen += len(images)
        return (images.mean((2, 3)) * self.factor)[:, None]


def photos(folder: Path, count: int) -> list[Path]:
    paths = [folder / f"{i:03d}.png" for i in range(count)]
    for i, path in enumerate(paths):
        Image.new("RGB", (10, 12), (i, 2 * i % 256, 255 - i)).save(path)
    return paths


CONFIG = EvaluationConfig(batch=4, workers=0)


def test_blocks_keep_groups_whole_and_near_the_limit() -> None:
    groups = [np.arange(8 * i, 8 * i + 8) for i in range(10)]
    blocks = blocks_of(groups, dim=100, limit=8 * 3 * 100 * 4)
    assert [len(block) for block in blocks] == [3, 3, 3, 1]
    assert (np.concatenate([g for block in blocks for g in block]) == np.arange(80)).all()
    assert [len(block) for block in blocks_of(groups[:2], 100, limit=1)] == [1, 1]


def test_regions_keep_what_is_wanted() -> None:
    regions = Regions(np.array([2, 5, 9]), np.zeros((3, 1, 1)))
    regions.put(np.arange(0, 6), np.arange(0.0, 6).reshape(-1, 1, 1))
    regions.put(np.arange(6, 12), np.arange(6.0, 12).reshape(-1, 1, 1))
    assert regions.take(np.array([9, 2])).flatten().tolist() == [9, 2]
    Regions(np.empty(0, np.int64), np.empty((0, 1, 1))).put(np.arange(3), np.zeros((3, 1, 1)))


def test_a_killed_encoding_continues_from_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = photos(tmp_path, 300)
    blocks = blocks_of([np.arange(300)], 3)
    cpu, scratch = torch.device("cpu"), tmp_path / "scratch"
    model = Means()
    with evaluating(model):
        whole = encode(model, paths, [blocks], CONFIG, cpu, progress=False)
        assert not isinstance(whole.values, np.memmap)
        monkeypatch.setattr(encoding, "REGIONS_IN_MEMORY", 0)
        monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
        (tmp_path / "temporary").mkdir()
        unnamed = encode(model, paths, [blocks], CONFIG, cpu, progress=False)  # no folder: nothing to continue
        assert isinstance(unnamed.values, np.memmap) and (unnamed.values == whole.values).all()
        assert list((tmp_path / "temporary").iterdir()) == [], "a killed process leaves nothing"
        content = paths[280].read_bytes()
        paths[280].write_bytes(b"broken")  # ends the first attempt at batch 70, behind the mark of 64
        with pytest.raises(DataError, match=r"280\.png"):
            encode(model, paths, [blocks], CONFIG, cpu, scratch=scratch, key="k", progress=False)
        assert json.loads((scratch / "regions.0.json").read_text())["done"] == 64
        paths[280].write_bytes(content)
        # another batch size counts other batches: what was done is not continued, and nothing is left out
        other = dataclasses.replace(CONFIG, batch=8)
        shutil.copytree(scratch, tmp_path / "other")
        redone = encode(model, paths, [blocks], other, cpu, scratch=tmp_path / "other", key="k", progress=False)
        np.testing.assert_allclose(redone.values, whole.values, rtol=1e-6)
        model.seen = 0
        again = encode(model, paths, [blocks], CONFIG, cpu, scratch=scratch, key="k", progress=False)
        assert isinstance(again.values, np.memmap) and model.seen == 300 - 64 * 4
        assert (again.values == whole.values).all()
        model.seen = 0
        encode(model, paths, [blocks], CONFIG, cpu, scratch=scratch, key="k", progress=False)
        assert model.seen == 0  # complete
        encode(model, paths, [blocks], CONFIG, cpu, scratch=scratch, key="other weights", progress=False)
        assert model.seen == 300


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_precision_is_of_the_arithmetic_not_of_what_is_kept(tmp_path: Path, precision: str) -> None:
    class Product(Means):
        def encode(self, images: Tensor) -> Tensor:
            product = images.mean((2, 3)) @ torch.eye(3)
            self.kind = product.dtype
            return product[:, None]

    model = Product()
    config = EvaluationConfig(batch=4, workers=0, precision=precision)  # type: ignore[arg-type]
    with evaluating(model):
        regions = encode(
            model, photos(tmp_path, 3), [blocks_of([np.arange(3)], 3)], config, torch.device("cpu"), progress=False
        )
    assert model.kind == {"fp32": torch.float32, "bf16": torch.bfloat16}[precision]
    assert regions.values.dtype == np.float32


def test_published_interpolation_is_another_input(tmp_path: Path) -> None:
    noise = np.random.Generator(np.random.PCG64(0)).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "noise.png")
    model = Means()
    values = []
    for resize in ("antialias", "published"):
        config = EvaluationConfig(workers=0, resize=resize)  # type: ignore[arg-type]
        with evaluating(model):
            regions = encode(
                model,
                [tmp_path / "noise.png"],
                [blocks_of([np.arange(1)], 3)],
                config,
                torch.device("cpu"),
                progress=False,
            )
        values.append(regions.values.copy())
    assert not np.allclose(values[0], values[1], atol=1e-3)
