"""The engine end to end: what it computes against a plain restatement, on one process and on several real ones."""

from __future__ import annotations

import dataclasses
import os
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.multiprocessing as mp
from PIL import Image
from torch import Tensor, nn

from pipeline.common.errors import DataError, UsageError
from pipeline.config import EvaluationConfig
from pipeline.data.images import load_image, normalise, to_input
from pipeline.evaluation.describe.stored import evaluate_stores
from pipeline.evaluation.evaluate import Result, evaluate, fit_projections
from pipeline.evaluation.protocol import protocols
from pipeline.evaluation.sets.evaluation_set import EvaluationSet


class Tiny(nn.Module):
    """Regions by a random projection of 4x4 cells; `correlate` mixes each image with the mean of its group."""

    def __init__(self, dtype: torch.dtype = torch.float64) -> None:
        super().__init__()
        self.image_size, self.regions, self.descriptor_dim = 16, 3, 24
        weights = torch.randn(48, 24, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
        self.weight = nn.Parameter(weights.to(dtype))
        self.calls: list[int] = []

    def encode(self, images: Tensor) -> Tensor:
        pooled = nn.functional.adaptive_avg_pool2d(images, 4).flatten(1)
        return (pooled @ self.weight).tanh().reshape(-1, 3, 8)

    def correlate(self, regions: Tensor) -> Tensor:
        self.calls.append(len(regions))
        mixed = regions + 0.5 * torch.softmax(regions.flatten(1) @ regions.flatten(1).T, 1).mm(
            regions.flatten(1)
        ).reshape(regions.shape)
        return nn.functional.normalize(mixed.flatten(1), dim=1)


def make_set(folder: Path, database: int = 37, queries: int = 13) -> EvaluationSet:
    """Random colour fields; query i is a noisy copy of database image 2i."""
    rng = np.random.Generator(np.random.PCG64(1))
    fields = rng.integers(0, 256, (database, 4, 4, 3)).astype(np.int64)

    def save(name: str, field: np.ndarray) -> Path:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(field.clip(0, 255).astype(np.uint8)).resize((32, 24), Image.Resampling.NEAREST).save(path)
        return path

    return EvaluationSet(
        name="fields",
        database=[save(f"database/{i:03d}.png", f) for i, f in enumerate(fields)],
        queries=[
            save(f"queries/{i:03d}.png", fields[2 * i] + rng.integers(-60, 61, (4, 4, 3))) for i in range(queries)
        ],
        positives=[np.array([2 * i], np.int64) for i in range(queries)],
        rule="pairs",
        database_positions=rng.random((database, 2)),
        query_positions=rng.random((queries, 2)),
    )


CONFIG = EvaluationConfig(group_size=4, group_seed=3, recalls=(1, 5), batch=8, workers=0)


def plainly(model: Tiny, paths: list[Path], groups: list[np.ndarray]) -> np.ndarray:
    """Descriptors without engine: every group decoded, encoded and correlated on its own."""
    out = np.empty((len(paths), model.descriptor_dim))
    for group in groups:
        images = torch.stack([to_input(load_image(paths[i]), 16) for i in group])
        with torch.no_grad():
            out[group] = model.correlate(model.encode(normalise(images, torch.float64))).numpy()
    return out


def test_predictions_equal_a_plain_restatement(tmp_path: Path) -> None:
    evaluated, model = make_set(tmp_path), Tiny()
    results = evaluate(model, [evaluated], CONFIG, "cpu", progress=False)
    assert [r.protocol.name for r in results] == ["single_16px_pairs", "shuffled4s3_16px_pairs", "ordered4_16px_pairs"]
    for result, protocol in zip(results, protocols(CONFIG, 16, "pairs"), strict=True):
        database = plainly(model, evaluated.database, protocol.form(37, "database"))
        queries = plainly(model, evaluated.queries, protocol.form(13, "queries"))
        squared = ((queries[:, None] - database[None]) ** 2).sum(-1)
        assert (result.predictions == np.argsort(squared, axis=1)[:, :5]).all()
        np.testing.assert_allclose(result.distances, np.sort(squared, axis=1)[:, :5], atol=1e-5)
        hits = (result.predictions == 2 * np.arange(13)[:, None]).any(1).mean()
        assert result.recalls[5] == pytest.approx(100 * hits)
    recalls = {r.protocol.groups: r.recalls[1] for r in results}
    assert recalls["single"] > 60 and len({r.distances.tobytes() for r in results}) == 3  # groups do matter


def test_the_tail_group_is_short_and_every_group_one_call(tmp_path: Path) -> None:
    model = Tiny()
    config = dataclasses.replace(CONFIG, groups=("ordered",))
    evaluate(model, [make_set(tmp_path)], config, "cpu", progress=False)
    assert model.calls == [4] * 9 + [1] + [4] * 3 + [1]


def test_model_mode_and_random_state_are_left_as_they_were(tmp_path: Path) -> None:
    model, before = Tiny().train(), torch.get_rng_state()
    evaluate(model, [make_set(tmp_path)], dataclasses.replace(CONFIG, workers=2), "cpu", progress=False)
    assert model.training and torch.equal(before, torch.get_rng_state())


def bomb() -> bytes:
    """A PNG of a few bytes whose header says 60,000 x 60,000 pixels."""
    chunks = (b"IHDR" + (60_000).to_bytes(4) * 2 + b"\x08\x02\0\0\0", b"IDAT" + zlib.compress(bytes(99)), b"IEND")
    return b"\x89PNG\r\n\x1a\n" + b"".join((len(c) - 4).to_bytes(4) + c + zlib.crc32(c).to_bytes(4) for c in chunks)


@pytest.mark.parametrize("workers", [0, 2])
def test_a_broken_image_is_named(tmp_path: Path, workers: int) -> None:
    evaluated = make_set(tmp_path)
    evaluated.database[20].write_bytes(b"\xff\xd8 not really a photo")
    with pytest.raises(DataError, match=r"^[^;]*020\.png: [^;]*; restore the file or leave it out$"):
        evaluate(Tiny(), [evaluated], dataclasses.replace(CONFIG, workers=workers), "cpu", progress=False)
    broken = [*evaluated.database[5:30:4], *evaluated.queries[2:6]]  # both sides, in many batches
    for number, photo in enumerate(broken):
        photo.write_bytes(b"") if number % 2 else photo.unlink()
    broken[0].write_bytes(bomb())
    with pytest.raises(DataError, match=r"12 broken photos: .*; and 2 more\. Restore the files") as caught:
        evaluate(Tiny(), [evaluated], dataclasses.replace(CONFIG, workers=workers), "cpu", progress=False)
    named = [photo for photo in broken if str(photo) in str(caught.value)]
    assert len(named) == 9 and "020.png" in str(caught.value), "the first ten in the set's order"
    assert "too large: 3,600,000,000 pixels" in str(caught.value)


def test_parts_are_searched_apart(tmp_path: Path) -> None:
    evaluated = make_set(tmp_path)
    parts = np.arange(37) % 2
    apart = dataclasses.replace(evaluated, database_part=parts, query_part=np.zeros(13, np.int64))
    result = evaluate(Tiny(), [apart], CONFIG, "cpu", progress=False)[0]
    assert (parts[result.predictions] == 0).all()


def test_two_sets_of_one_name_are_refused(tmp_path: Path) -> None:
    """Their recalls, predictions and metrics would have one name."""
    sets = [make_set(tmp_path / town) for town in ("a", "b")]
    with pytest.raises(UsageError, match=f"two sets are called 'fields' .*{tmp_path}/a.* and .*{tmp_path}/b"):
        evaluate(Tiny(), sets, CONFIG, "cpu", progress=False)


def test_store_is_reused_and_gives_the_same_results(tmp_path: Path) -> None:
    evaluated, model, out = make_set(tmp_path), Tiny(torch.float32), tmp_path / "out"
    config = dataclasses.replace(CONFIG, store="fp32")
    plain = evaluate(model, [evaluated], CONFIG, "cpu", progress=False)
    first = evaluate(model, [evaluated], config, "cpu", output=out, progress=False)
    calls = len(model.calls)
    again = evaluate(model, [evaluated], config, "cpu", output=out, progress=False)
    assert len(model.calls) == calls and not (out / "scratch").exists()
    for a, b, c in zip(plain, first, again, strict=True):
        assert (a.predictions == b.predictions).all() and (a.predictions == c.predictions).all()
    # one lost part is computed again, and only that grouping
    (out / "descriptors/fields/ordered4_16px/queries/part-00000.parquet").unlink()
    evaluate(model, [evaluated], config, "cpu", output=out, progress=False)
    assert model.calls[calls:] == [4, 4, 4, 1]
    # other weights under the same folder: nothing may be reused
    with torch.no_grad():
        model.weight.mul_(1.5)
    changed = evaluate(model, [evaluated], config, "cpu", output=out, progress=False)
    fresh = evaluate(model, [evaluated], CONFIG, "cpu", progress=False)
    assert all((a.predictions == b.predictions).all() for a, b in zip(changed, fresh, strict=True))


def test_recalls_and_pca_tables_come_from_the_store_alone(tmp_path: Path) -> None:
    """What the model gave with PCA in one go comes out of the store later, photographs gone."""
    evaluated, model, out = make_set(tmp_path), Tiny(torch.float32), tmp_path / "out"
    evaluate(model, [evaluated], dataclasses.replace(CONFIG, store="fp32"), "cpu", output=out, progress=False)
    direct = {
        dims: evaluate(model, [evaluated], dataclasses.replace(CONFIG, pca=dims), "cpu", progress=False)
        for dims in (None, 6, 2)
    }
    for path in evaluated.database + evaluated.queries:
        path.unlink()
    table = evaluate_stores(out, [evaluated], CONFIG, (6, 2))
    assert len(table) == 9
    for result in table:
        truth = next(r for r in direct[result.protocol.pca] if r.protocol == result.protocol)
        np.testing.assert_allclose(result.distances, truth.distances, atol=1e-5)
        assert result.recalls == truth.recalls
    assert len({r.recalls[1] for r in table if r.protocol.groups == "single"}) > 1  # dimensions cost something
    fewer = dataclasses.replace(evaluated, database=evaluated.database[::-1])
    with pytest.raises(DataError, match="other images"):
        evaluate_stores(out, [fewer], CONFIG)
    with pytest.raises(DataError, match="no descriptors of elsewhere"):
        evaluate_stores(out, [dataclasses.replace(evaluated, name="elsewhere")], CONFIG)


@pytest.mark.parametrize("search", ["hnsw", "ivfpq"])
def test_an_approximate_search_says_how_well_it_agrees(tmp_path: Path, search: str) -> None:
    config = dataclasses.replace(CONFIG, groups=("single",), search=search)  # type: ignore[arg-type]
    result = evaluate(Tiny(), [make_set(tmp_path)], config, "cpu", progress=False)[0]
    assert f"_{search} finds " in result.remarks[0] and result.protocol.name == f"single_16px_pairs_{search}"


def run_rank(rank: int, world: int, folder: Path, evaluated: EvaluationSet, broken: bool) -> None:
    os.environ.update(MASTER_ADDR="127.0.0.1", OMP_NUM_THREADS="1")
    torch.set_num_threads(1)
    torch.distributed.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=world)
    config = dataclasses.replace(CONFIG, pca=6, pca_from="fields")
    try:
        model = Tiny()
        fitted = fit_projections(model, evaluated, config, "cpu", progress=False)
        results = evaluate(model, [evaluated], config, "cpu", progress=False, projections=fitted)
        results += evaluate(model, [evaluated], CONFIG, "cpu", progress=False)
        torch.save([(r.predictions, r.distances, r.recalls) for r in results], folder / f"rank{rank}.pt")
    except DataError as error:
        (folder / f"rank{rank}.txt").write_text(str(error))
        assert broken
    torch.distributed.destroy_process_group()


def on_processes(world: int, folder: Path, evaluated: EvaluationSet, broken: bool = False) -> list[Any]:
    folder.mkdir()
    mp.start_processes(run_rank, (world, folder, evaluated, broken), nprocs=world, start_method="fork")
    return [torch.load(folder / f"rank{r}.pt", weights_only=False) for r in range(world) if not broken]


def test_the_number_of_processes_changes_nothing(tmp_path: Path) -> None:
    """Ranks hold different slices, groups span ranks; predictions and distances agree to the last bit."""
    evaluated = make_set(tmp_path)
    alone: list[Result] = evaluate(Tiny(), [evaluated], CONFIG, "cpu", progress=False)
    for world in (1, 2, 3):
        for rank in on_processes(world, tmp_path / f"w{world}", evaluated):
            assert len(rank) == 6
            for (predictions, distances, recalls), result in zip(rank[3:], alone, strict=True):
                assert (predictions == result.predictions).all() and recalls == result.recalls
                assert (distances == result.distances).all()
            if world == 1:
                projected = rank[:3]
            for (predictions, distances, _), truth in zip(rank[:3], projected, strict=True):
                assert (predictions == truth[0]).all() and (distances == truth[1]).all()


def test_a_broken_image_ends_all_processes_with_its_name(tmp_path: Path) -> None:
    evaluated = make_set(tmp_path)
    for photo in (evaluated.database[36], evaluated.database[3]):  # of both ranks
        photo.write_bytes(b"nothing")
    on_processes(2, tmp_path / "broken", evaluated, broken=True)
    told = {(tmp_path / f"broken/rank{r}.txt").read_text() for r in range(2)}
    assert len(told) == 1
    assert all(name in next(iter(told)) for name in ("2 broken photos", "036.png", "003.png"))
