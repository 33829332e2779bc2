"""TransVPR's encoder: what is trained, chunks, stochastic depth, what does not fit. Its numbers: as a release."""

from __future__ import annotations

import dataclasses
import itertools

import pytest
import torch
from tiny_matchers import transvpr, transvpr_config
from torch import nn

from pipeline.common.errors import UsageError
from pipeline.config.baselines import AttentionMapsConfig, TransVPRConfig
from pipeline.model.backbones.transvpr import Block
from pipeline.model.batch_norm import GlobalBatchNorm2d
from pipeline.model.variants import variant
from pipeline.model.vpr import build_model, parameter_counts


def test_published_size() -> None:
    """Counted by hand: stem, tokenizers, class token, six blocks, norm; 256 numbers a photo."""
    model = build_model(variant("TransVPR"), 480)
    widths = (3, 64, 128, 256, 512)
    stem = sum(9 * a * b + 3 * b for a, b in itertools.pairwise(widths))
    tokenizers = sum(64 * width * side**2 + 64 for width, side in zip(widths[1:], (8, 4, 2, 1), strict=True))
    block = 3 * 256**2 + 256**2 + 256 + 2 * 512 + 2 * 256 * 512 + 256 + 512
    assert parameter_counts(model)["backbone"] == stem + tokenizers + 256 + 6 * block + 512
    assert (model.descriptor_dim, model.regions, model.backbone.grid) == (256, 1, (30, 30))


def test_chunks_give_the_same_gradients() -> None:
    """With BatchNorm over all images, dropout and stochastic depth drawn alike."""
    assert all(type(m) is GlobalBatchNorm2d for m in transvpr().modules() if isinstance(m, nn.BatchNorm2d))
    found = []
    for chunk in (None, 2):
        torch.manual_seed(1)
        model = build_model(transvpr_config(), 32).double().train()
        images = torch.randn(5, 3, 32, 32, dtype=torch.float64)
        (model(images, chunk) * torch.randn(5, 32, dtype=torch.float64)).sum().backward()
        found.append({n: p.grad for n, p in model.named_parameters()} | dict(model.named_buffers()))
    for name, wanted in found[0].items():
        torch.testing.assert_close(found[1][name], wanted, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("trainable", ["full", "last", "frozen"])
def test_what_is_not_trained_stays_as_in_evaluation(trainable: str) -> None:
    config = dataclasses.replace(transvpr_config(), trainable=trainable, last_blocks=2)  # type: ignore[arg-type]
    model = build_model(config, 32).train()
    backbone = model.backbone
    before = backbone.conv1[1].running_mean.clone()
    (model(torch.randn(4, 3, 32, 32)) * torch.randn(4, 32)).sum().backward()
    given = {n for n, p in backbone.named_parameters() if p.grad is not None}
    assert given == {n for n, p in backbone.named_parameters() if p.requires_grad}
    assert torch.equal(backbone.conv1[1].running_mean, before) == (trainable != "full")
    blocks = {int(n.split(".")[2]) for n in given if n.startswith("transformer.blocks")}
    assert blocks == {"full": set(range(6)), "last": {4, 5}, "frozen": set()}[trainable]
    if trainable != "full":
        with torch.no_grad():
            images = torch.randn(2, 3, 32, 32)
            assert torch.equal(backbone.patches(images, 4), backbone.eval().patches(images, 4))


def test_stochastic_depth_keeps_the_mean() -> None:
    """A branch is left out for half of the images and counts twice for the others."""
    block = Block(TransVPRConfig(dim=8, heads=1, dropout=0), skipped=0.5).train()
    branch = block._branch(torch.ones(2000, 3, 8))
    assert set(branch.unique().tolist()) == {0.0, 2.0} and abs(float(branch.mean()) - 1) < 0.1
    assert torch.equal(block.eval()._branch(torch.ones(5, 3, 8)), torch.ones(5, 3, 8))


def test_a_layer_is_that_blocks_tokens_and_the_last_form_has_three() -> None:
    model, images = transvpr(), torch.randn(2, 3, 96, 96)
    with torch.no_grad():
        whole, fourth = model.backbone(images), model.backbone.patches(images, 4)
        assert whole.shape == (2, 37, 96) and torch.equal(whole[:, 1:, 32:64], fourth)
        assert torch.equal(model.backbone.patches(images), whole[:, 1:])
    with pytest.raises(UsageError, match="blocks are 1 to 6"):
        model.backbone.patches(images, 7)


def test_settings_that_do_not_fit_are_one_line() -> None:
    config = transvpr_config()
    pooling = dataclasses.replace(config.pooling, transvpr=AttentionMapsConfig(levels=7))
    weights = dataclasses.replace(config.backbone, weights="x.pth")
    for changed, size, message in (
        (config, 40, "40 is not a multiple of the patch 16"),
        (transvpr_config(heads=3), 32, "dim 32 must be a multiple of 4 x heads 3"),
        (transvpr_config(depth=5), 32, "within the 5 blocks"),
        (dataclasses.replace(config, pooling=pooling), 32, "levels 7: tokens of 96 channels"),
        (dataclasses.replace(config, backbone=weights), 32, "whole model; import it with jobs.weights"),
        (dataclasses.replace(config, trainable="adapters"), 32, "adapters belong to transformer blocks"),
    ):
        with pytest.raises(UsageError, match=message):
            build_model(changed, size)
