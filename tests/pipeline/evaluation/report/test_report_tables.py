"""Tables, files and pictures of results, read back and looked into."""

from __future__ import annotations

import csv
import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from pipeline.common.errors import DataError
from pipeline.config import EvaluationConfig
from pipeline.config.image_size import ImageSize
from pipeline.evaluation.evaluate import Answers, Result, score
from pipeline.evaluation.predictions import load_predictions, save_predictions
from pipeline.evaluation.protocol import protocols
from pipeline.evaluation.recall import recall_at
from pipeline.evaluation.report import figures, tables
from pipeline.evaluation.report.page import write_page
from pipeline.evaluation.report.pictures import draw
from pipeline.evaluation.sets.evaluation_set import EvaluationSet

CONFIG = EvaluationConfig(recalls=(1, 5, 10), group_size=8, resize="published")


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> EvaluationSet:
    folder = tmp_path_factory.mktemp("street")
    rng = np.random.Generator(np.random.PCG64(0))

    def photo(name: str, size: tuple[int, int]) -> Path:
        path = folder / name
        Image.fromarray(rng.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)).save(path)
        return path

    return EvaluationSet(
        "pitts30k",
        [photo(f"d{i:02d}.jpg", (40, 30)) for i in range(30)],
        [photo(f"q{i:02d}.jpg", (30, 40) if i % 3 else (48, 27)) for i in range(12)],
        [np.array([2 * i, 2 * i + 1], np.int64) if i < 11 else np.empty(0, np.int64) for i in range(12)],
        "25 m",
        np.stack([np.arange(30) * 12.0, np.arange(30) % 7 * 30.0], 1),
        np.stack([np.arange(12) * 24.0, np.arange(12) % 7 * 28.0], 1),
    )


def results_of(evaluated: EvaluationSet, config: EvaluationConfig = CONFIG) -> list[Result]:
    made = []
    for number, protocol in enumerate(protocols(config, 224, evaluated.rule)):
        rng = np.random.Generator(np.random.PCG64(number))
        predictions = np.stack([rng.permutation(30)[:10] for _ in range(12)])
        predictions[:5, 0] = 2 * np.arange(5)  # right at first
        distances = np.sort(rng.random((12, 10)).astype(np.float32), axis=1)
        made.append(score(evaluated, protocol, config, Answers(predictions, distances)))
    return made


def test_the_table_has_all_groupings_together_and_the_paper_beside(
    street: EvaluationSet, capsys: pytest.CaptureFixture[str]
) -> None:
    other = dataclasses.replace(street, name="elsewhere")
    tables.show(results_of(street) + results_of(other))
    text = capsys.readouterr().out
    lines = text.splitlines()
    assert [line.split()[0] for line in lines[2:5]] == ["pitts30k", "shuffled8_published", "ordered8_published"]
    assert lines[2].endswith("91.6 / 95.7 / 96.9")  # the paper, each image alone
    assert lines[4].endswith("94.8 / 97.4 / 98.1")  # the paper, 8 neighbours, no PCA
    assert lines[3].endswith(" -") and max(map(len, lines[:9])) < 120
    assert "1 queries have no positive and are counted as misses" in text
    assert "8 neighbours in file order" in text


def test_a_set_without_a_matching_protocol_shows_the_headline_in_its_own_row(street: EvaluationSet) -> None:
    table = tables.table(results_of(street, dataclasses.replace(CONFIG, groups=("shuffled",))))
    rows = [dict(zip(table.head, row, strict=True)) for row in table.rows]
    assert [row["protocol"] for row in rows] == ["shuffled8_published", "paper: ordered8, PCA 4096"]
    assert rows[1]["R@1"] == "94.9"


@pytest.mark.parametrize(
    "change",
    [{"resize": "antialias"}, {"rule": "10 m"}, {"image_size": 322}, {"group_size": 16}, {"pca": 4096},
     {"pca": 4096, "pca_source": "tokyo247"}, {"precision": "bf16"}, {"search": "hnsw"}, {"rerank": 10}],
)  # fmt: skip
def test_the_papers_figures_stand_beside_the_papers_protocol_alone(
    street: EvaluationSet, change: dict[str, Any]
) -> None:
    theirs = next(result for result in results_of(street) if result.protocol.groups == "ordered")
    theirs = dataclasses.replace(theirs, without_positives=0)
    pca = dataclasses.replace(theirs.protocol, pca=4096, pca_source="data/pitts30k")
    for protocol, first in ((theirs.protocol, 94.8), (pca, 94.9)):
        figures = tables.paper_figures(dataclasses.replace(theirs, protocol=protocol))
        assert figures is not None and figures.at(1) == first
    other = dataclasses.replace(theirs.protocol, **change)
    beside = tables.paper_figures(dataclasses.replace(theirs, protocol=other))
    assert beside is None or (change == {"group_size": 16} and beside.at(1) == 93.7)  # a figure of the supplement


def test_files_say_the_same(street: EvaluationSet, tmp_path: Path) -> None:
    results = results_of(street)
    tables.write_json(results, tmp_path / "results.json", {"checkpoint": "x"})
    plain = tables.read_json(tmp_path / "results.json")
    first = plain["results"][0]
    assert plain["checkpoint"] == "x" and first["protocol"]["groups"] == "single"
    assert first["metrics"] == {f"pitts30k.single_published.recall_at_{k}": v for k, v in results[0].recalls.items()}
    tables.write_csv(results, tmp_path / "results.csv")
    with (tmp_path / "results.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 9 and float(lines[1]["recall"]) == results[0].recalls[5] and lines[0]["rule"] == "25 m"
    assert tables.markdown(results).count("\n|") == 4
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(DataError, match="format"):
        tables.read_json(tmp_path / "other.json")


def test_predictions_come_back_and_give_the_same_recall(street: EvaluationSet, tmp_path: Path) -> None:
    for result in results_of(street):
        kept = load_predictions(save_predictions(result, street, tmp_path))
        assert kept.protocol == result.protocol and kept.queries == [str(q) for q in street.queries]
        assert (kept.rows == result.predictions).all() and (kept.distances == result.distances).all()
        assert recall_at(kept.rows, kept.positives, CONFIG.recalls) == result.recalls
        curve = figures.curve_of(street, result)
        assert [curve[k - 1] for k in CONFIG.recalls] == pytest.approx(list(result.recalls.values()))
    with pytest.raises(DataError, match="predictions"):
        load_predictions(Path(__file__))


def test_examples_are_of_their_kind(street: EvaluationSet) -> None:
    result = results_of(street)[0]
    right = {q for q in range(12) if result.predictions[q, 0] in street.positives[q]}
    assert right >= set(range(5)) and set(figures.choose(street, result, "correct", 12)) == right
    assert set(figures.choose(street, result, "failures", 12)) == set(range(11)) - right  # query 11 has no positive
    metres = figures.errors_in_metres(street, result)
    worst = figures.choose(street, result, "worst")
    assert metres is not None and worst and list(metres[worst]) == sorted(metres[worst], reverse=True)
    assert not any(np.isin(result.predictions[q], street.positives[q]).any() for q in worst)


def colour_share(path: Path, colour: str) -> float:
    """Share of a picture's pixels near a colour."""
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
    return float((np.abs(pixels - wanted).max(axis=-1) < 14).mean())


def test_frames_are_green_where_right_and_red_where_wrong(street: EvaluationSet, tmp_path: Path) -> None:
    result = results_of(street)[0]
    right, wrong = np.array([[2, 3], [4, 5]]), np.array([[20, 21], [22, 23]])
    for name, answers in (("right", right), ("wrong", wrong)):
        drawn = dataclasses.replace(result, predictions=answers, distances=np.ones((2, 2), np.float32))
        asked = dataclasses.replace(street, queries=street.queries[1:3], positives=street.positives[1:3],
                                    query_positions=None)  # fmt: skip
        figures.retrieval_grid(asked, drawn, [0, 1], tmp_path / f"{name}.png", name)
    assert colour_share(tmp_path / "right.png", figures.GREEN) > 0.01
    assert colour_share(tmp_path / "right.png", figures.RED) < 0.0005
    assert colour_share(tmp_path / "wrong.png", figures.RED) > 0.01
    assert colour_share(tmp_path / "wrong.png", figures.BLUE) > 0.004  # the positive that was missed
    assert colour_share(tmp_path / "wrong.png", figures.GREEN) < 0.0005


class Corner(torch.nn.Module):
    """Tokens of a 4 x 4 grid, large in the first cell of the second row alone."""

    def __init__(self) -> None:
        super().__init__()
        self.image_size, self.weight = 32, torch.nn.Parameter(torch.zeros(1))
        self.backbone = self.Backbone()

    class Backbone(torch.nn.Module):
        def grid_of(self, height: int, width: int) -> tuple[int, int]:
            return height // 8, width // 8

        def forward(self, images: torch.Tensor) -> torch.Tensor:
            h, w = self.grid_of(*images.shape[-2:])
            tokens = torch.zeros(len(images), 1 + h * w, 6)
            tokens[:, 0] = 100  # the class token is no patch
            tokens[:, 1 + w] = 1
            return tokens


def test_the_report_stands_alone(street: EvaluationSet, tmp_path: Path) -> None:
    config = dataclasses.replace(CONFIG, groups=("single",))
    sequence = dataclasses.replace(street, name="seq", database_positions=None, query_positions=None, rule="+-2 frames")
    unscored = dataclasses.replace(street, name="unknown", has_ground_truth=False)
    sets = [street, sequence, unscored]
    results = [result for evaluated in sets for result in results_of(evaluated, config)]
    assert results[2].recalls == {}
    assert tables.table(results[2:]).rows[0][-2:] == ["30", "-"]
    assert not any("no positive and are" in note or "best" in note for note in tables.notes(results[2:]))
    pictures = draw(results, sets, tmp_path / "figures", Corner())
    drawn = {p.path.name for p in pictures}
    assert drawn >= {
        "pitts30k.curves.png",
        "seq.single_published_2frames.errors.png",
        "seq.single_published_2frames.worst.jpg",
        "seq.attention.jpg",
    }
    assert {name for name in drawn if name.startswith("unknown")} == {
        "unknown.single_published.answers.jpg",
        "unknown.attention.jpg",
    }
    write_page(results, pictures, tmp_path / "report.html", "A <test>", {"checkpoint": "a&b"})
    page = (tmp_path / "report.html").read_text()
    assert page.count("<img") == len(pictures) == page.count("base64,")
    assert not re.search(r'(?:src|href)="(?!data:|#)', page) and "<script" not in page and "url(" not in page
    assert "A &lt;test&gt;" in page and "a&amp;b" in page and "each image alone" in page


def test_attention_lies_where_the_tokens_are_large(street: EvaluationSet, tmp_path: Path) -> None:
    maps = figures.attention_maps(Corner(), street.database[:2])
    assert np.shape(maps) == (2, 4, 4) and np.argwhere(maps[0]).tolist() == [[1, 0]]
    figures.attention_overlay(Corner(), street.database[:2], tmp_path / "attention.png", "attention")
    assert Image.open(tmp_path / "attention.png").size[0] > 300


def test_a_map_and_its_photo_have_one_extent(
    street: EvaluationSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For a model of 32 px, whose photos are shown larger: the hot cell lies where its part of the photo is."""
    from matplotlib.axes import Axes

    from pipeline.paper.paper_figures import attention_comparison

    drawn: dict[int, list[tuple[tuple[float, ...], tuple[int, ...]]]] = {}
    plain = Axes.imshow

    def watched(self: Axes, pixels: np.ndarray, **style: object) -> object:
        image = plain(self, pixels, **style)  # type: ignore[arg-type]
        drawn.setdefault(id(self), []).append((tuple(image.get_extent()), np.shape(pixels)[:2]))
        return image

    monkeypatch.setattr(Axes, "imshow", watched)
    photos = street.database[:2]
    figures.attention_overlay(Corner(), photos, tmp_path / "a.png", "attention")
    attention_comparison(
        photos, [("one", figures.attention_maps(Corner(), photos))], ImageSize.of(32), tmp_path / "b.png", "below"
    )
    pairs = [images for images in drawn.values() if len(images) == 2]
    assert len(pairs) == 4
    for (below, photo), (above, heat) in pairs:
        assert below == above and photo == (224, 224) and heat == (4, 4)


def test_figures_for_a_paper(street: EvaluationSet, tmp_path: Path) -> None:
    curve = np.array([50.0, 60.0, 70.0])
    draws = []
    for name in ("first", "second"):
        with figures.also_as(("pdf", "svg", "png")):
            figures.recall_curves({"a": curve, "b": curve, "c": curve + 1}, tmp_path / name / "c.png", "t", "b", 100)
        assert {p.name for p in (tmp_path / name).iterdir()} == {"c.png", "c.pdf", "c.svg", "c.300dpi.png"}
        draws.append({p.name: p.read_bytes() for p in (tmp_path / name).iterdir()})
    assert draws[0] == draws[1], "the same results, the same files"
    assert draws[0]["c.pdf"].startswith(b"%PDF") and b"a = b   R@1 50.0" in draws[0]["c.svg"]
    with Image.open(tmp_path / "first/c.png") as small, Image.open(tmp_path / "first/c.300dpi.png") as large:
        assert large.width / small.width == pytest.approx(300 / figures.DPI, rel=0.01)
    assert not list((tmp_path / "second").glob(".*"))


def test_curves_that_coincide_share_a_line_and_intervals_hold_the_share() -> None:
    curve = np.array([50.0, 100.0])
    assert list(figures.collapse({"a": curve, "b": curve + 0.5, "c": curve.copy()})) == ["a = c", "b"]
    low, high = figures.wilson(np.array([0.0, 50.0, 100.0]), 100)
    # published values of the interval for 0, 50 and 100 successes in 100
    assert low == pytest.approx([0.0, 40.383, 96.301], abs=0.01) and high == pytest.approx(
        [3.699, 59.617, 100.0], abs=0.01
    )


HOSTILE = "<img src=x onerror=alert(1)> $\\frac{ [b] |*_\x1b[31m\n=1.jpg"


def test_names_that_are_markup_stay_names(street: EvaluationSet, tmp_path: Path) -> None:
    """A photo, a title and a remark with markup, mathematics and terminal escapes, through every picture and page."""
    photo = tmp_path / HOSTILE
    photo.write_bytes(street.queries[0].read_bytes())
    hostile = dataclasses.replace(street, queries=[photo, *street.queries[1:]], remarks=(HOSTILE,))
    config = dataclasses.replace(CONFIG, groups=("single",))
    results = results_of(hostile, config)
    pictures = draw(results, [hostile], tmp_path / "figures", Corner())
    figures.answer_grid([(photo, [(photo, "0.1")])], tmp_path / "grid.jpg", HOSTILE, HOSTILE)
    write_page(results, pictures, tmp_path / "report.html", HOSTILE, {HOSTILE: HOSTILE})
    page = (tmp_path / "report.html").read_text()
    assert "<img src=x" not in page and "&lt;img src=x" in page and "\x1b" not in page
    assert page.count("<img") == len(pictures) and "{" not in page.split("</style>")[1].replace("frac{", "")
    for text in (tables.table(results).text(), tables.markdown(results)):
        assert "\x1b" not in text
    tables.write_csv(results, tmp_path / "r.csv")
    assert "\x1b" not in (tmp_path / "r.csv").read_text()


def test_a_photo_smaller_than_its_tile_is_enlarged_to_it(tmp_path: Path) -> None:
    """A tile has 585 pixels; the drawn city's photos have 320 and were shown with a wide grey margin."""
    from matplotlib.figure import Figure

    Image.new("RGB", (32, 24), (200, 30, 30)).save(tmp_path / "small.png")
    axes = Figure().subplots()
    figures.photo_tile(axes, tmp_path / "small.png", (64, 48), figures.INK, "query", "")
    assert np.abs(np.asarray(axes.images[0].get_array()).astype(int) - (200, 30, 30)).max() <= 2
