"""A release of another method through the jobs: told, imported, evaluated, and refused in one line."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import torch
from releases_restated import SEQUENTIAL, filled, linear_shapes, resnet_shapes
from tiny import make_evaluation

from jobs import evaluate, weights
from pipeline.common.errors import DataError, UsageError
from pipeline.model.weights.files import load_model
from pipeline.model.weights.released import from_release

BACKBONE = resnet_shapes([f"backbone.{part}" for part in SEQUENTIAL], (1, 1, 1, 1), width=8)
COSPLACE = filled(BACKBONE | {"aggregation.1.p": (1,)} | linear_shapes("aggregation.3", 16, 256))


def start(job: object, monkeypatch: pytest.MonkeyPatch, *arguments: str | Path) -> None:
    monkeypatch.setattr(sys, "argv", ["job", *map(str, arguments)])
    job.main()  # type: ignore[attr-defined]


def test_a_release_is_told_imported_and_evaluated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source, target = tmp_path / "cosplace.pth", tmp_path / "out" / "ours.safetensors"
    torch.save({f"module.{n}": t for n, t in COSPLACE.items()}, source)
    start(weights, monkeypatch, "--source", source)
    told = capsys.readouterr().out
    assert "a released CosPlace or EigenPlaces\n  photos' own shape, at most 640 px -> 16 numbers" in told
    start(weights, monkeypatch, "--source", source, "--to", target, "--image-size", "64")
    images = torch.randn(2, 3, 64, 64)
    with torch.no_grad():
        assert torch.equal(load_model(target)(images), from_release(COSPLACE, "", None, 64)(images))
    make_evaluation(tmp_path / "data" / "streets", places=3, split="test")
    recalls = []
    for checkpoint in (target, source):  # ours, and the release as it is at its own size
        options = ["--root", tmp_path / "data", "--sets", "streets", "--workers", "0", "--figures", "false"]
        output = tmp_path / checkpoint.stem
        start(evaluate, monkeypatch, "--checkpoint", checkpoint, *options, "--output", output)
        written = json.loads((output / "results.json").read_text())
        assert written["descriptor_dim"] == 16
        recalls.append(written)
    assert recalls[0]["fingerprint"] == recalls[1]["fingerprint"]


def test_what_cannot_be_told_or_is_refused_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bare, other, mine = (
        tmp_path / "resnet50_avg_GCL.pth",
        tmp_path / "densenet_GeM_GCL.pth",
        tmp_path / "gcl.safetensors",
    )
    torch.save({"model_state_dict": filled(BACKBONE)}, bare)
    torch.save({"pool.p": torch.ones(1), "backbone.conv0.weight": torch.ones(1)}, other)
    cases: list[tuple[list[str | Path], str]] = [
        (["--source", bare], r"resnet50_avg_GCL\.pth: .*say so with --kind gcl_avg"),
        (["--source", bare, "--kind", "salad"], r"say so with --kind gcl_avg"),
        (
            ["--source", other],
            r"densenet_GeM_GCL\.pth: lacks 'backbone\.0\.weight', the first layer of VGG-16 or a Res",
        ),
    ]
    for words, complaint in cases:
        with pytest.raises(UsageError, match=complaint) as caught:
            start(weights, monkeypatch, *words)
        assert "\n" not in str(caught.value)
    start(weights, monkeypatch, "--source", bare, "--kind", "gcl_avg", "--image-size", "64", "--to", mine)
    assert load_model(mine).config.pooling.kind == "cls"
    with pytest.raises(DataError, match=r"bin: not a readable safetensors.*jobs\.weights makes one"):
        load_model(bare.rename(tmp_path / "x.bin"))
