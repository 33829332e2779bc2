"""Photos of several shapes in one set: each encoded in its own, groups and their order as the protocol says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from processes import run_ranks
from street import model

from pipeline.common.errors import UsageError
from pipeline.config import EvaluationConfig
from pipeline.data.images import load_image, normalise, to_input
from pipeline.evaluation.describe.bank import chosen_bank
from pipeline.evaluation.describe.encode import describe_alone, evaluating
from pipeline.evaluation.describe.sides import Engine
from pipeline.evaluation.identity import Identity, model_digest
from pipeline.evaluation.protocol import Protocol, protocols
from pipeline.evaluation.report.figures import as_seen, attention_maps
from pipeline.evaluation.sets.evaluation_set import EvaluationSet
from pipeline.locate.answers import Locator, locate
from pipeline.locate.photo_index import make_index
from pipeline.model.weights.files import at_size

CPU = torch.device("cpu")
SHAPES = [(40, 52), (52, 40), (28, 28), (40, 52)]  # width, height


@pytest.fixture
def photos(tmp_path: Path) -> EvaluationSet:
    """Eleven photos of three shapes, in no order of them."""
    paths = [tmp_path / "photos" / f"{i:02d}.png" for i in range(11)]
    paths[0].parent.mkdir()
    for i, path in enumerate(paths):
        small = np.random.default_rng(i).integers(0, 256, (6, 6, 3), np.uint8)
        Image.fromarray(small).resize(SHAPES[i * i % 4 if i % 3 else 2], Image.Resampling.BICUBIC).save(path)
    return EvaluationSet("mixed", paths, paths[:1], [np.zeros(1, np.int64)], "pairs")


def described(photos: EvaluationSet, config: EvaluationConfig, size: int | str = "native56") -> list[np.ndarray]:
    """Descriptors of the database under each protocol; nothing on ranks other than 0."""
    built = at_size(model().eval(), size)
    found = []
    with evaluating(built):
        bank = chosen_bank(built, config, photos.database, CPU)
        chosen = protocols(config, built.image_size, "pairs", bank)
        side = Engine(built, config, CPU, None, False, "").side(photos, "database", chosen, bank)
        for protocol in chosen:
            blocks = side.describe(protocol)
            whole = np.zeros((len(photos.database), built.descriptor_dim), np.float32)
            for rows, values in blocks() if blocks is not None else ():
                whole[rows] = values
            found.append(whole)
    return found


def test_groups_of_mixed_shapes_are_the_protocols_on_any_number_of_processes(photos: EvaluationSet) -> None:
    """Against photos encoded one by one, each by a model of its very size, and the protocol's groups over them."""
    groups: Any = ("single", "shuffled", "ordered")
    config = EvaluationConfig(groups=groups, group_size=4, workers=0, batch=5)
    whole, regions = model().eval(), []
    with torch.no_grad():
        for path in photos.database:
            image = normalise(to_input(load_image(path), at_size(whole, "native56").input_size))
            regions.append(at_size(whole, f"{image.shape[1]}x{image.shape[2]}").encode(image[None])[0])
    assert {tuple(load_image(path).size) for path in photos.database} == set(SHAPES)
    found = described(photos, config)
    for protocol, values in zip(protocols(config, "native56", "pairs"), found, strict=True):
        assert protocol.name in ("single_native56px_pairs", "shuffled4_native56px_pairs", "ordered4_native56px_pairs")
        for rows in protocol.form(len(photos.database), "database"):
            with torch.no_grad():
                wanted = whole.correlate(torch.stack([regions[row] for row in rows])).numpy()
            np.testing.assert_allclose(values[rows], wanted, atol=1e-5)
    for values, again in zip(found, run_ranks(described, 2, photos, config)[0], strict=True):
        assert (values == again).all()


def test_beside_a_bank_no_other_photo_enters(photos: EvaluationSet) -> None:
    config = EvaluationConfig(groups=("bank",), bank=3, bank_from=str(photos.database[0].parent), workers=0, batch=4)
    (whole,) = described(photos, config)
    few = EvaluationSet("few", photos.database[3:5], photos.database[:1], [np.zeros(1, np.int64)], "pairs")
    assert (described(few, config)[0] == whole[3:5]).all() and np.abs(whole[3] - whole[4]).max() > 1e-3


def test_a_square_is_described_alike_however_it_is_written(photos: EvaluationSet) -> None:
    config = EvaluationConfig(groups=("shuffled",), group_size=4, workers=0, batch=5)
    assert (described(photos, config, 28)[0] == described(photos, config, "28x28")[0]).all()
    assert np.abs(described(photos, config, "28x42")[0] - described(photos, config, 28)[0]).max() > 1e-3


def test_a_protocol_says_the_size() -> None:
    def of(size: int | str) -> Protocol:
        return protocols(EvaluationConfig(groups=("single",)), size, "25 m")[0]

    assert [of(size).name for size in (224, 112, "480x640", "native640")] == [
        "single", "single_112px", "single_480x640px", "single_native640px",
    ]  # fmt: skip
    assert "; 224 px antialiased" in of(224).describe() and "; 480 x 640 px" in of("480x640").describe()
    assert "photos' own shape, at most 640 px" in of("native640").describe()
    assert len({Identity("photo", "m", "f", of(size)).digest for size in (224, "224x238", "native")}) == 3


def test_an_index_answers_in_the_size_that_it_was_made_with(photos: EvaluationSet, tmp_path: Path) -> None:
    native = at_size(model().eval(), "native56")
    config = EvaluationConfig(groups=("single",), workers=0, batch=1)
    folder = photos.database[0].parent
    index = make_index(native, folder, tmp_path / "index", config, CPU, model_digest(native), progress=False)
    assert index.protocol.image_size == "native56"
    for answer in locate(native, index, photos.database[:4], 1, CPU, progress=False):
        assert answer.found[0].place.name == answer.photo.name and answer.found[0].distance == 0
    with evaluating(native):
        alone = describe_alone(native, photos.database[1], "antialias", "fp32", CPU)
    single = EvaluationConfig(groups=("single",), workers=0, batch=5)
    np.testing.assert_allclose(alone[0], described(photos, single)[0][1], atol=1e-6)
    with pytest.raises(UsageError, match="made of photos at image_size native56, this model takes 28"):
        Locator(model(), index, CPU)


def test_attention_is_drawn_in_the_photos_shape(photos: EvaluationSet) -> None:
    native = at_size(model().eval(), "native56")
    maps = attention_maps(native, photos.database[:3])
    for path, heat in zip(photos.database, maps, strict=False):
        width, height = load_image(path).size
        assert heat.shape == (round(height / 7), round(width / 7))
        assert max(as_seen(path, native.input_size).shape[:2]) == 224
        assert (attention_maps(native, [path])[0] == heat).all()
