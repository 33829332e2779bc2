"""Beside a bank: torch's own encoder under a mask, and descriptors that depend on nothing but their image."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml
from job_process import JobProcess
from processes import run_ranks
from safetensors.torch import load_file
from street import model, street
from tiny import prepare, run_settings
from torch import Tensor, nn

from pipeline.api import Model
from pipeline.common.errors import DataError, UsageError
from pipeline.config import (
    CrossImageConfig,
    EvaluationConfig,
)
from pipeline.data.images import load_image, normalise, to_input
from pipeline.evaluation.describe.bank import chosen_bank, drawn
from pipeline.evaluation.describe.encode import evaluating
from pipeline.evaluation.describe.sides import Engine
from pipeline.evaluation.evaluate import evaluate
from pipeline.evaluation.protocol import protocols
from pipeline.evaluation.sets.evaluation_set import EvaluationSet
from pipeline.evaluation.sets.load import load_set
from pipeline.locate.answers import locate
from pipeline.locate.photo_index import make_index
from pipeline.model.bank import bank_beside, make_bank, read_bank, save_bank
from pipeline.model.beside import BesideBank
from pipeline.model.vpr import PlaceModel, build_model
from pipeline.model.weights.convert import write_model
from pipeline.model.weights.files import load_model
from pipeline.training.engines.fsdp2 import ShardedEngine


@pytest.fixture
def photos(tmp_path: Path) -> EvaluationSet:
    return street(tmp_path)


def test_torchs_encoder_under_a_mask() -> None:
    """The bank's images see the bank; an image sees the bank and itself. Float64."""
    built = model().double().eval()
    regions = torch.randn(16, built.regions, 16, dtype=torch.float64)
    bank, images = make_bank(regions[:5], "train"), regions[5:]
    layer = nn.TransformerEncoderLayer(16, 2, 16, 0.0, "gelu", batch_first=False)
    library = nn.TransformerEncoder(layer, 2, enable_nested_tensor=False).double().eval()
    library.load_state_dict(built.cross_image.state_dict())
    hidden = torch.zeros(6, 6, dtype=torch.bool)
    hidden[:5, 5] = True
    with torch.no_grad():
        ours = built.correlate_beside(images, built.remember(bank))
        for image, descriptor in zip(images, ours, strict=True):
            sequence = torch.cat((bank.regions.double(), image[None]))
            theirs = nn.functional.normalize(library(sequence, hidden)[5].flatten(), dim=0)
            assert torch.allclose(descriptor, theirs, rtol=1e-11, atol=1e-13)
        assert (ours - built.correlate(images)).abs().max() > 1e-3
        assert (ours - built.correlate(images, alone=True)).abs().max() > 1e-3


def described(photos: EvaluationSet, order: list[int], sharded: bool = False, batch: int = 5) -> dict[Path, Tensor]:
    """Descriptors beside a bank of the first photos, the set's photos in an order; on rank 0."""
    built: PlaceModel = model()
    given = dataclasses.replace(photos, database=[photos.database[i] for i in order])
    config = EvaluationConfig(groups=("bank",), bank=6, bank_from="map", workers=0, batch=batch)
    device = torch.device("cpu")
    engine = None
    if sharded:
        accelerator = SimpleNamespace(device=device)
        engine = ShardedEngine(accelerator, built, lambda parameters: torch.optim.SGD(parameters, 0.1), None)
    with engine.plain() if engine is not None else evaluating(built) as plain:
        whole = built if engine is None else plain
        assert isinstance(whole, PlaceModel)
        with evaluating(whole):
            bank = chosen_bank(whole, config, photos.database, device)
            (protocol,) = protocols(config, 28, "pairs", bank)
            worker = Engine(whole, config, device, None, False, "")
            blocks = worker.side(given, "database", [protocol], bank).describe(protocol)
    if blocks is None:
        return {}
    return {given.database[row]: values[i] for rows, values in blocks() for i, row in enumerate(rows)}


def test_a_descriptor_depends_on_no_other_image_nor_process_nor_engine(photos: EvaluationSet) -> None:
    """To the last bit: 23 images; in another order; some of them; over two and three ranks; over shards of FSDP2."""
    everyone = list(range(23))
    truth = described(photos, everyone)
    assert len({v.tobytes() for v in truth.values()}) == 23
    others = [
        described(photos, everyone[::-1]),
        described(photos, [7, 3]),
        run_ranks(described, 3, photos, everyone)[0],
        run_ranks(described, 2, photos, everyone, True)[0],
    ]
    for found in others:
        assert found
        assert all(np.array_equal(values, truth[path]) for path, values in found.items())
    # `evaluate.batch` is the shape of a forward pass: another may round otherwise, and nothing else
    for path, values in described(photos, everyone, batch=1).items():
        np.testing.assert_allclose(values, truth[path], atol=1e-6)


def test_draws_files_and_names(tmp_path: Path, photos: EvaluationSet) -> None:
    built, folder = model(), photos.database[0].parent
    wanted = EvaluationConfig(groups=("bank",), bank=4, bank_from=str(folder))
    with evaluating(built):  # a folder's photos, drawn as a map's are
        own = chosen_bank(built, wanted, [], "cpu")
        map_ = chosen_bank(built, dataclasses.replace(wanted, bank_from="map"), photos.database, "cpu")
    assert own is not None and map_ is not None and own.digest == map_.digest and len(own.regions) == 4
    assert (own.source, map_.source) == (folder.name, "map")
    assert list(drawn(50, 8, 3)) == list(drawn(50, 20, 3)[:8]) != list(drawn(50, 8, 4))
    assert sorted(drawn(5, 64, 0)) == list(range(5))
    bank = make_bank(torch.randn(6, 5, 16), "train")
    save_bank(bank, tmp_path / "b.safetensors")
    read = read_bank(tmp_path / "b.safetensors")
    assert read is not None and read.digest == bank.digest and read.source == "train"
    assert bank.first(6).digest == bank.digest != bank.first(5).digest
    assert (tmp_path / "b.safetensors").stat().st_size < 2 * 6 * 5 * 16 + 300
    assert read_bank(tmp_path / "nothing.safetensors") is None
    (tmp_path / "b.safetensors").write_bytes(b"no bank")
    with pytest.raises(DataError, match=r"b\.safetensors: not a readable bank"):
        read_bank(tmp_path / "b.safetensors")
    config = EvaluationConfig(groups=("single", "bank"))
    single, beside = protocols(config, 28, "pairs", bank)
    assert (single.name, beside.name, beside.bank_digest) == ("single_28px_pairs", "bank6_28px_pairs", bank.digest)
    assert "bank of 6 images from train" in beside.describe()
    (other,) = protocols(EvaluationConfig(groups=("bank",)), 28, "pairs", dataclasses.replace(bank, source="my photos"))
    assert other.name.startswith("bank6my-photos-") and other.grouping == dataclasses.replace(
        beside.grouping, bank_from="my photos"
    )


def test_what_cannot_be_is_refused_in_one_line(tmp_path: Path) -> None:
    built = model()
    config = EvaluationConfig(groups=("bank",))
    for encoder, reason in (
        (CrossImageConfig(layers=0), "layers is 0"),
        (CrossImageConfig(alone=True), "alone is set"),
    ):
        without = build_model(dataclasses.replace(built.config, cross_image=encoder), 28)
        with pytest.raises(UsageError, match=f"groups bank .*{reason}"):
            chosen_bank(without, config, [], "cpu")
    with pytest.raises(UsageError, match=r"no bank of training images .*take --bank_from map, or a folder"):
        chosen_bank(built, config, [], "cpu")
    with pytest.raises(UsageError, match="an existing folder of photos"):
        chosen_bank(built, dataclasses.replace(config, bank_from=str(tmp_path / "nowhere")), [], "cpu")
    with pytest.raises(UsageError, match="model's are"):
        built.remember(make_bank(torch.zeros(3, 2, 16), "train"))


def test_every_way_to_a_descriptor_takes_the_bank_of_the_model(tmp_path: Path, photos: EvaluationSet) -> None:
    """From Python, as a module (torch.hub), and in an index of photos that is asked; equal to the last bit."""
    built = model().eval()
    built.bank = make_bank(torch.randn(6, built.regions, 16), "train")
    paths, device = photos.database[:9], torch.device("cpu")
    images = [normalise(to_input(load_image(path), 28))[None] for path in paths]
    with evaluating(built):
        memory = built.remember(built.bank)
        truth = torch.cat([built.correlate_beside(built.encode(image), memory) for image in images])
        assert torch.equal(torch.cat([BesideBank(built, built.bank)(image) for image in images]), truth)
    assert Model(built, device).describe(paths, config=EvaluationConfig(workers=0, batch=1)).tobytes() == (
        truth.numpy().tobytes()
    )
    config = EvaluationConfig(groups=("bank",), workers=0, batch=1)
    index = make_index(
        built, photos.database[0].parent, tmp_path / "index", config, device, "of a test", progress=False
    )
    assert index.protocol.name.startswith("bank6_28px") and index.protocol.bank_digest == built.bank.digest
    answers = locate(built, index, paths, 2, device, progress=False)
    rows = [photos.database.index(path) for path in paths]
    assert [a.found[0].row for a in answers] == rows and max(a.found[0].distance for a in answers) == 0
    built.bank = make_bank(torch.randn(6, built.regions, 16), "train")
    with pytest.raises(UsageError, match=r"made beside the bank .* build the index again"):
        locate(built, index, paths, 2, device, progress=False)


def test_training_writes_the_bank_that_chose_its_best_checkpoint(tmp_path: Path) -> None:
    """A real run, validated beside its bank: the checkpoint gives the recall that validation saw, whole and copied."""
    root = prepare(tmp_path)
    settings = run_settings(root)
    settings["train"] |= {"epochs": 1, "passes": "joint", "validate_first": False}
    settings["validate"] |= {"groups": ["bank", "single"], "bank": 9}
    (root / "run.yaml").write_text(yaml.safe_dump(settings))
    job = JobProcess("jobs.train", ["--config", str(root / "run.yaml")], root / "run.txt")
    assert job.wait(240) == 0, job.text()[-3000:]
    run = root / "outputs" / "tiny"
    state = json.loads((run / "checkpoints/best/state.json").read_text())["state"]
    assert load_file(run / "checkpoints/best/bank.safetensors")["regions"].shape == (9, 14, 16)
    trained = load_model(run)
    config = EvaluationConfig(**{**settings["validate"], "groups": ("bank", "single"), "recalls": (1, 5)})
    evaluated = load_set(str(root / "evaluation"), config)
    results = evaluate(trained, [evaluated], config, "cpu", progress=False)
    assert results[0].protocol.name == "bank9_28px"
    assert state["best"] == results[0].recalls[5] == state["validated"]["validation/evaluation.bank9_28px.recall_at_5"]
    write_model(trained, root / "copy.safetensors", str(run))
    copied = load_model(root / "copy.safetensors")
    assert copied.bank is not None and trained.bank is not None and copied.bank.digest == trained.bank.digest
    copied.bank = None
    write_model(copied, root / "copy.safetensors", str(root / "copy.safetensors"))
    assert not bank_beside(root / "copy.safetensors").exists()
