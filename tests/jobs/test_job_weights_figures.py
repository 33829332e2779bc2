"""`jobs.weights`, `jobs.figures` and torch.hub: every command of their pages, at small size, and their complaints."""

from __future__ import annotations

import importlib.util
import os
import re
import runpy
import shlex
import sys
from pathlib import Path

import pytest
import torch
from PIL import Image
from releases_restated import BLOCKS, NAMED, SEQUENTIAL, filled, linear_shapes, resnet_shapes
from safetensors.torch import save_file
from tiny import make_evaluation, photo

from jobs import figures, weights
from pipeline.common.errors import UserError
from pipeline.config import AdapterConfig, BackboneConfig, CrossImageConfig, ModelConfig
from pipeline.model.vpr import PlaceModel, build_model
from pipeline.model.weights import convert
from pipeline.model.weights.files import load_model, save_model

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ModelConfig(
    backbone=BackboneConfig(name="custom", dim=16, depth=1, heads=2, patch=14, pretrain_grid=4),
    adapter=AdapterConfig(reduced=2),
    cross_image=CrossImageConfig(layers=1, heads=2, feedforward=16),
)
SIZES = shlex.split(
    "--model.backbone.name custom --model.backbone.dim 16 --model.backbone.depth 1 --model.backbone.heads 2 "
    "--model.backbone.pretrain_grid 4 --model.adapter.reduced 2 --model.cross_image.layers 1 "
    "--model.cross_image.heads 2 --model.cross_image.feedforward 16 --image-size 56"
)


def commands(page: str, job: str) -> list[list[str]]:
    text = (ROOT / "docs" / page).read_text()
    text = text.replace("\\\n", " ")
    found = re.findall(rf"^ *python -m {re.escape(job)} (.*?)(?: +#.*)?$", text, re.MULTILINE)
    return [shlex.split(line) for line in found]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs, three releases, photos, places and a set, under the names the pages use."""
    folder = tmp_path_factory.mktemp("weights")
    for seed, run in enumerate(("run", "other")):
        torch.manual_seed(seed)
        model = build_model(CONFIG, 56)
        with torch.no_grad():
            for parameter in (p for p in model.parameters() if p.requires_grad):
                parameter.add_(0.1 * torch.randn_like(parameter))
            if run == "other":  # blind: all its descriptors are the same, so the two differ
                model.backbone.vit.embeddings.patch_embeddings.projection.weight.zero_()  # type: ignore[union-attr]
        best = folder / "outputs" / run / "checkpoints" / "best" / "model.safetensors"
        save_model(model, best, CONFIG, 56, everything=True)
    convert.write_published(model, folder / "plain.pth")
    state = torch.load(folder / "plain.pth", weights_only=True)
    torch.save({"model_state_dict": {f"module.{n}": t for n, t in state.items()}}, folder / "CricaVPR.pth")
    backbone = {n.removeprefix("backbone."): t for n, t in state.items() if n.startswith("backbone.")}
    torch.save({n: t for n, t in backbone.items() if ".adapter." not in n}, folder / "dinov2.pth")
    layers = resnet_shapes([f"backbone.{part}" for part in SEQUENTIAL], (1, 1, 1, 1), width=8)
    layers |= {"aggregation.1.p": (1,)} | linear_shapes("aggregation.3", 16, 256)
    torch.save(filled(layers), folder / "ResNet50_512_cosplace.pth")
    (folder / "photos").mkdir()
    for place in range(36):
        (folder / "gsv" / f"place{place}").mkdir(parents=True)
        for view in range(12):
            photo(place, view).save(folder / "gsv" / f"place{place}" / f"{view}.jpg")
    for view in range(3):
        photo(0, view).save(folder / "photos" / f"{view}.jpg")
    make_evaluation(folder / "set", split="test")
    return folder


def start(job: object, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", ["job", *arguments])
    job.main()  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    "words",
    [  # the exporter takes its time; tests/pipeline/model/weights/test_weights_convert.py runs it by default
        pytest.param(words, id=words[-1], marks=[pytest.mark.slow] if words[-1].endswith(".onnx") else [])
        for words in commands("weights.md", "jobs.weights")
    ],
)
def test_commands_of_the_weights_page(
    words: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    target = words[words.index("--to") + 1] if "--to" in words else ""
    if target.endswith(".onnx") and any(importlib.util.find_spec(n) is None for n in ("onnxscript", "onnxruntime")):
        pytest.skip("the extra 'onnx' is not installed")
    monkeypatch.chdir(folder)
    start(weights, monkeypatch, *words, *([] if "outputs/run" in words else SIZES))
    told = capsys.readouterr().out
    assert not target or (Path(target).is_file() and f"wrote {target}" in told)
    if target in {f"weights/{name}.safetensors" for name in ("cricavpr", "cosplace", "mine", "frozen")}:
        assert load_model(target).image_size == 56


@pytest.mark.slow  # a whole ResNet-50
@pytest.mark.parametrize("words", commands("baselines.md", "jobs.weights"), ids=lambda w: w[-1])
def test_commands_of_the_baselines_page(words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    save_file(filled(resnet_shapes(NAMED, BLOCKS["resnet50"])), "resnet50.safetensors")
    start(weights, monkeypatch, *words)
    model = load_model(words[-1])
    assert model.image_size == 320 and model.config.backbone.resnet.layout == "keras"


@pytest.mark.parametrize("words", commands("figures.md", "jobs.figures"), ids=lambda w: w[1])
def test_commands_of_the_figures_page(
    words: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    if words[1] == "parameters":
        words = [*words, "--variants", "CricaVPR,FullTunedDINOv2,EigenPlaces"]
    start(figures, monkeypatch, *words, "--workers", "0", "--group-size", "4")
    told, target = capsys.readouterr().out, Path(words[words.index("--to") + 1])
    if target.suffix != ".md":
        assert min(Image.open(target).size) > 300
    if words[1] == "parameters":  # ours (the paper's), to its one decimal
        for cell in re.findall(r"([\d.]+) \(([\d.]+)\)", target.read_text()):
            assert float(cell[0]) == float(cell[1])
        assert len(re.findall(r" \([\d.]+\)", target.read_text())) == 14
    if words[1] == "tsne":
        shares = [float(share) for share in re.findall(r"same place +([\d.]+) %", told)]
        assert len(shares) == 3 and max(shares) > 100 / 36


def test_wrong_sources_are_one_clear_line(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sprung = tmp_path / "sprung"

    class Trap:
        def __reduce__(self) -> tuple[object, ...]:
            return os.mkdir, (str(sprung),)

    torch.save({"x": Trap()}, tmp_path / "trap.pth")
    torch.save({"aggregation.1.p": torch.ones(1)}, tmp_path / "cut.pth")
    (tmp_path / "text.pth").write_text("no weights")
    dinov2, run = str(folder / "dinov2.pth"), str(folder / "outputs/run")
    cases = [
        (["--source", str(tmp_path / "trap.pth")], "trap.pth: not loaded"),
        (["--source", str(tmp_path / "text.pth")], "text.pth: neither a PyTorch nor a safetensors file"),
        (["--source", str(tmp_path / "none.pth")], "none.pth: there is no such"),
        (["--source", str(tmp_path / "cut.pth")], "cut.pth does not fit .* lacks"),
        (["--source", dinov2], "1 blocks of width 16 are none of the named backbones"),
        (["--source", dinov2, "--kind", "cricavpr"], "dinov2.pth: no released CricaVPR"),
        (["--source", dinov2, "--kind", "model"], "not a model of this project but a backbone"),
        (["--source", str(folder / "CricaVPR.pth"), *SIZES, "--model.backbone.dim", "32"], "model wants"),
        (["--source", run, "--to", str(tmp_path / "m.bin")], "m.bin: the ending decides"),
        (["--source", dinov2, "--to", dinov2], "is the source itself"),
        ([], "--source is missing"),
    ]
    for words, complaint in cases:
        with pytest.raises(UserError, match=complaint) as caught:
            start(weights, monkeypatch, *words)
        assert "\n" not in str(caught.value)
    assert not sprung.exists()


def test_figures_complain_in_one_line(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = ["--checkpoint", str(folder / "outputs/run"), "--to", "x.png"]
    cases = [
        (["--kind", "tsne", *run, "--places-from", str(folder / "gsv"), "--images", "13"], "--images 12 would do"),
        (["--kind", "tsne", *run], "--places_from is missing"),
        (["--kind", "attention", *run], "--photos is missing"),
        (["--kind", "qualitative", *run, "--sets", "x"], "wants --baseline"),
        (["--kind", "attention", "--to", "x.txt"], "a file ending in .png or .jpg"),
    ]
    for words, complaint in cases:
        with pytest.raises(UserError, match=complaint) as caught:
            start(figures, monkeypatch, *words)
        assert "\n" not in str(caught.value)


def test_two_lines_load_a_model(folder: Path) -> None:
    hub: object = torch.hub.load(str(ROOT), "place_model", source="local", path=str(folder / "outputs/run"))
    assert isinstance(hub, PlaceModel) and not hub.training
    image = torch.hub.load(str(ROOT), "place_input", source="local", photo=folder / "photos/0.jpg", image_size=56)
    with torch.no_grad():
        assert torch.equal(hub(image), load_model(folder / "outputs/run")(image))
    by_name = torch.hub.load(str(ROOT), "AdaptSPM+Crica", source="local", path=str(folder / "outputs/run"))
    assert by_name.config == CONFIG
    assert {"place_model", "CricaVPR", "FrozenDINOv2-GeM", "5x5"} <= runpy.run_path(str(ROOT / "hubconf.py")).keys()
    with pytest.raises(UserError, match="not a AdaptGeM"):
        torch.hub.load(str(ROOT), "AdaptGeM", source="local", path=str(folder / "outputs/run"))
    with pytest.raises(UserError, match="a backbone alone"):
        torch.hub.load(str(ROOT), "place_model", source="local", path=str(folder / "dinov2.pth"))
