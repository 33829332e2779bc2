"""Real runs in mined order: killed while mining on 2 ranks, resumed on 2 and 1, a changed file."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from launched import Launched
from tiny import prepare, run_settings, samples
from tiny_checkpoint import save_tiny

from pipeline.common.errors import DataError, UsageError
from pipeline.config import DataConfig
from pipeline.data.cliques import CliqueRule, mine
from pipeline.data.images import normalise
from pipeline.data.place_descriptors import PlaceDescriptors, read_descriptors
from pipeline.data.places import build_loader
from pipeline.data.plan import plan
from pipeline.data.positions import points
from pipeline.data.shard_sets import cities_of
from pipeline.evaluation.describe.places import describe_places
from pipeline.model.bank import make_bank, save_bank
from pipeline.model.weights.files import load_model
from pipeline.training.mining import check_rule
from shards.index import read_index

PLACES, STEPS = 16, 4  # an epoch
MINED = {
    "order": "mined",
    "mine_from": "bank",
    "clique": 2,
    "mine_neighbours": 8,
    "mine_radius": 150.0,
    "mine_temperature": 0.01,
}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepare(tmp_path_factory.mktemp("mined"), PLACES)


def config(root: Path, name: str, **data: Any) -> Path:
    settings = {**run_settings(root), "name": name, "loss": {"ignore_within": 150.0}}
    settings["data"] |= MINED | data
    settings["train"] |= {"epochs": 3}
    settings["validate"]["sets"] = []
    path = root / f"{name}.yaml"
    path.write_text(yaml.safe_dump(settings))
    return path


def start(path: Path, world: int) -> Launched:
    return Launched("ddp", world, "jobs.train", ["--config", str(path)], path.with_suffix(".log"))


def run(path: Path, world: int, code: int = 0) -> str:
    job = start(path, world)
    assert job.wait() == [code] * world, job.ranks[0].text()[-3000:]
    return job.ranks[0].text()


def states(root: Path, name: str) -> Iterator[dict[str, Any]]:
    for path in sorted((root / "outputs" / name / "checkpoints").glob("step-*/state.json")):
        yield json.loads(path.read_text())["state"]


def test_mined_runs_are_exact_given_their_files(root: Path) -> None:
    run(config(root, "whole"), 2)
    *_, last = states(root, "whole")
    assert last["mined"]["epoch"] == 2 and last["step"] == 3 * STEPS
    folder = root / "outputs/whole/mined"
    found = {path.name[:10]: path for path in folder.iterdir()}
    assert found["epoch-0002"].name == last["mined"]["file"]

    # the third epoch's batches are the plan of that file, and hold places that look alike
    index = read_index(str(root / "shards"))
    descriptors = read_descriptors(found["epoch-0002"], index.digest, PLACES, last["mined"]["sha256"])
    assert (descriptors.kind, descriptors.round, descriptors.values.shape) == ("bank", 2, (PLACES, PLACES))
    mined = mine(descriptors.values, cities_of(index), points(index.positions()), CliqueRule(2, 8, 150.0, 0.01))
    batches = plan(index, 0, 2, 4, "mined", mined=mined).batches
    whole = samples(root, "whole")
    assert [whole[step] for step in range(2 * STEPS + 1, 3 * STEPS + 1)] == [
        index.table.take(rows)["sample"].to_pylist() for rows in batches
    ]
    assert [whole[step] for step in range(1, STEPS + 1)] == [
        index.table.take(rows)["sample"].to_pylist() for rows in plan(index, 0, 0, 4, "city").batches
    ]
    assert (batches != plan(index, 0, 2, 4, "city").batches).any()

    # killed while it mines before the second epoch: mined again from the checkpoint, to the bit
    path = config(root, "killed")
    out = root / "outputs/killed"
    start(path, 2).kill_when(lambda: (out / "mined").is_dir())
    assert [state["step"] for state in states(root, "killed")][-1] == STEPS
    log = out / "samples.rank1.jsonl"
    start(path, 2).kill_when(lambda: '"step": 11,' in log.read_text())
    *_, state = states(root, "killed")
    assert state["mined"] == last["mined"]  # the same file, so the same weights at both minings
    assert len(list((out / "mined").iterdir())) <= 2  # what no checkpoint needs is gone

    # changed: refused; put back, one process goes on with what two began
    file = out / "mined" / state["mined"]["file"]
    true = file.read_bytes()
    file.write_bytes(true[:-1] + bytes([true[-1] ^ 1]))
    assert "has changed" in run(path, 1, code=3)
    file.write_bytes(true)
    run(path, 1)
    assert samples(root, "killed") == whole

    # branched off under another name: the file is copied, and the same batches come
    branch = config(root, "branch")
    checkpoint = next(s for s in (out / "checkpoints").glob("step-*") if s.name.endswith("10"))
    job = Launched(
        "ddp", 1, "jobs.train", ["--config", str(branch), "--train.resume", str(checkpoint)], branch.with_suffix(".log")
    )
    assert job.wait() == [0], job.ranks[0].text()[-3000:]
    assert (root / "outputs/branch/mined" / file.name).read_bytes() == true
    assert samples(root, "branch") == {step: whole[step] for step in (11, 12)}


def described(root: Path, model: Path, kind: str) -> PlaceDescriptors:
    """By the library, in this one process."""
    data = DataConfig(shards=str(root / "shards"), image_size=28, workers=0)
    index = read_index(str(root / "shards"))
    found = describe_places(load_model(model), index, data, kind, 0, torch.device("cpu"), nullcontext)
    assert found is not None
    return found


def test_descriptors_are_those_of_each_image_and_do_not_depend_on_the_ranks(root: Path) -> None:
    """Against plain calls, image by image; 2 processes write the very file that 1 writes, a plan's input."""
    model = save_tiny(root / "model", 1)
    save_bank(make_bank(torch.rand(6, 5, 16), "train"), model / "checkpoints/best/bank.safetensors")
    index = read_index(str(root / "shards"))
    one, bank, mixed = (described(root, model, kind) for kind in ("single", "bank", "permuted"))

    network = load_model(model)
    assert network.bank is not None
    plain = DataConfig(places_per_batch=1, image_size=28, workers=0, augment="off", order="city")
    for found in (one, bank):
        truth = np.zeros((PLACES, network.descriptor_dim))
        with torch.no_grad():
            memory = network.remember(network.bank)
            for batch in build_loader(index, plain, 0, 0, 0, 0, 1):
                for image in batch.images:
                    regions = network.encode(normalise(image[None]))
                    alone = network.correlate(regions) if found is one else network.correlate_beside(regions, memory)
                    truth[int(batch.labels[0])] += alone[0].double().numpy() / 4
        truth -= truth.mean(0)  # as many components as places: PCA keeps everything
        truth /= np.linalg.norm(truth, axis=1, keepdims=True)
        cosines = found.values.astype(np.float64) @ found.values.astype(np.float64).T
        assert np.abs(cosines - truth @ truth.T).max() < 0.02  # two roundings to fp16, of small differences
    assert (bank.values != one.values).any()

    cities = cities_of(index)
    for city in (0, 1):  # the same descriptors, of other places of the city
        rows = [sorted(map(bytes, found.values[cities == city])) for found in (one, mixed)]
        assert rows[0] == rows[1]
    assert (one.values != mixed.values).any()

    out = root / "two.safetensors"
    words = ["--checkpoint", str(model), "--shards", str(root / "shards"), "--out", str(out), "--workers", "0"]
    printed = Launched("ddp", 2, "jobs.mine", [*words, "--kind", "bank"], root / "two.log").done()
    assert bank.sha256 in printed
    bank.save(root / "one.safetensors")
    assert (root / "one.safetensors").read_bytes() == out.read_bytes()

    path = config(root, "given", mine_from=str(out))
    job = Launched("ddp", 1, "jobs.train", ["--config", str(path), "--train.steps", "4"], root / "given.log")
    assert job.wait() == [0], job.ranks[0].text()[-3000:]
    mined = mine(bank.values, cities, points(index.positions()), CliqueRule(2, 8, 150.0, 0.01))
    batches = plan(index, 0, 0, 4, "mined", mined=mined).batches
    found_samples = samples(root, "given")
    expected = [index.table.take(rows)["sample"].to_pylist() for rows in batches]
    assert [found_samples[step] for step in range(1, STEPS + 1)] == expected
    assert all(state["mined"]["sha256"] == bank.sha256 for state in states(root, "given"))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"mine_from": "nothing"}, "nothing is none of single, bank, permuted, and no file"),
        ({"clique": 5}, "clique is 5: .* cannot be larger than a batch"),
        ({"mine_neighbours": 2}, r"mine_neighbours \(2\) is fewer than a group needs"),
    ],
)
def test_settings_that_make_no_group_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises((UsageError, DataError), match=message):
        check_rule(DataConfig(places_per_batch=4, **{"clique": 4, **settings}))
