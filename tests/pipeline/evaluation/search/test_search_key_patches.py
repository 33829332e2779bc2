"""TransVPR's key patches as a second stage: against its public code restated, and inside an evaluation."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import pytest
import torch
from releases_restated import filled, transvpr_maps, transvpr_shapes, transvpr_tokens
from second_stages_restated import key_mask, key_score
from tiny_matchers import netvlad, transvpr
from tiny_scenes import turned, views

from pipeline.common.errors import UsageError
from pipeline.config import EvaluationConfig
from pipeline.evaluation.evaluate import evaluate
from pipeline.evaluation.search.rerank import build_reranker
from pipeline.evaluation.search.rerank.key_patches import spread
from pipeline.model.weights.released import from_release

CONFIG = EvaluationConfig(groups=("single",), recalls=(1,), workers=0, rerank=4, rerank_by="transvpr")


def test_key_patches_and_scores_are_the_restated_ones() -> None:
    """Where the first patches of both are no key patches the public code has one match more,
    which may agree with the rest."""
    side = 10
    state = filled(transvpr_shapes(64, 6, 8))
    state["pool.attention_pool.weight"] *= 4  # attention as uneven as after training
    images = torch.cat((views(0, 4, side), views(1, 1, side)))
    with torch.no_grad():
        every = transvpr_tokens(state, images)
        masks = [key_mask(each) for each in transvpr_maps(state, every)[1]]
    model = from_release(state, "release", image_size=16 * side)
    for layer in (None, 2):
        stage = build_reranker(model, dataclasses.replace(CONFIG, rerank_layer=layer), "cpu")
        described = [stage.describe(image) for image in images]
        patches = every[(layer or 4) - 1][:, 1:]
        scores = []
        for (ours, rows, _), theirs, mask in zip(described, patches, masks, strict=True):
            assert rows.tolist() == (mask > 0.02).nonzero().flatten().tolist() and 20 < len(rows) < 100
            torch.testing.assert_close(ours, theirs[rows], rtol=1e-4, atol=1e-5)
        for i in range(1, len(images)):
            (found,) = stage.compare(described[0], described[i], (0, 0))
            wanted, one_more = key_score(patches[0], patches[i], (masks[0], masks[i]), side)
            assert found in ((wanted, wanted - 1) if one_more else (wanted,))
            scores.append(found)
        assert scores[0] > scores[-1] and min(scores[:-1]) >= 4  # the nearest view, and another place


def test_maps_are_spread_over_an_image() -> None:
    values = torch.tensor([[1.0, 3.0, 2.0], [5.0, 5.0, 5.0]])
    assert torch.equal(spread(values), torch.tensor([[0.0, 1.0, 0.5], [0.0, 0.0, 0.0]]))


def test_an_evaluation_puts_the_moved_view_first_and_says_how(tmp_path: Path) -> None:
    scenes = turned(tmp_path, by=16)
    (result,) = evaluate(transvpr(), [scenes], CONFIG, "cpu", progress=False)
    assert result.recalls[1] == 100
    assert result.protocol.name == "single_96px_pairs_rerank4-transvpr"
    assert "first 4 re-ranked by TransVPR's key patches" in result.protocol.describe()
    assert "MB a photo" in result.remarks[-1]
    (other,) = evaluate(transvpr(), [scenes], dataclasses.replace(CONFIG, rerank_layer=2), "cpu", progress=False)
    assert other.protocol.name.endswith("rerank4-transvprl2") and "layer 2" in other.protocol.describe()


def test_what_cannot_be_matched_is_refused_before_anything_is_described(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenes = turned(tmp_path, by=16)
    for model, config, told in (
        (netvlad(), CONFIG, "needs a TransVPR"),
        (transvpr(), dataclasses.replace(CONFIG, rerank_layer=7), "rerank_layer 7: .* 1 to 6"),
    ):
        with pytest.raises(UsageError, match=told):
            evaluate(model, [scenes], config, "cpu", progress=False)
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(UsageError, match="needs OpenCV"):
        evaluate(transvpr(), [scenes], CONFIG, "cpu", progress=False)


def test_a_blank_photo_matches_nothing() -> None:
    stage = build_reranker(transvpr(), CONFIG, "cpu")
    photo = stage.describe(views(0, 1, 6)[0])
    nothing = (photo[0][:0], photo[1][:0], photo[2])
    assert stage.compare(photo, nothing, (0, 0)) == stage.compare(nothing, photo, (0, 0)) == (0,)
    assert stage.compare(photo, photo, (0, 0))[0] >= 4
