"""The cross-image encoder against `nn.TransformerEncoder`, in one process and over real gloo processes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from processes import run_ranks
from torch import Tensor, nn

from pipeline.common.errors import UsageError
from pipeline.config import CrossImageConfig, EvaluationConfig, ModelConfig, RunConfig, TrainConfig
from pipeline.distributed import rank_slice
from pipeline.model.cross_image import CrossImageEncoder
from pipeline.training.trainer import check_batch

IMAGES, REGIONS, DIM = 12, 3, 16
CONFIG = CrossImageConfig(layers=2, heads=4, feedforward=24, dropout=0.0)


def problem() -> tuple[CrossImageEncoder, Tensor, Tensor]:
    """An encoder whose every parameter matters, regions [B, R, D], and the weights of a sum as the loss."""
    torch.manual_seed(4)
    encoder = CrossImageEncoder(DIM, CONFIG).double()
    for parameter in encoder.parameters():
        nn.init.normal_(parameter, std=0.3)
    regions, towards = torch.randn(2, IMAGES, REGIONS, DIM, dtype=torch.float64)
    return encoder, regions, towards


def results(module: nn.Module, regions: Tensor, towards: Tensor, images_first: bool = True) -> dict[str, Tensor]:
    regions = regions.clone().requires_grad_()
    out = module(regions)
    (out * towards).sum().backward()
    assert regions.grad is not None
    found = {name: p.grad for name, p in module.named_parameters() if p.grad is not None}
    return {"out": out.detach(), "regions": regions.grad, **found}


def library_results() -> dict[str, Tensor]:
    """torch's own encoder: images are the sequence, regions the batch, which is [B, R, D] with batch_first=False."""
    encoder, regions, towards = problem()
    layer = nn.TransformerEncoderLayer(DIM, CONFIG.heads, CONFIG.feedforward, 0.0, "gelu", batch_first=False)
    library = nn.TransformerEncoder(layer, CONFIG.layers, enable_nested_tensor=False).double()
    library.load_state_dict(encoder.state_dict())
    return results(library, regions, towards)


def on_a_rank() -> dict[str, Tensor]:
    encoder, regions, towards = problem()
    mine = rank_slice(IMAGES)
    return results(encoder.train(), regions[mine], towards[mine])


@pytest.mark.parametrize("world", [1, 2, 3])
def test_training_attends_to_the_global_batch(world: int) -> None:
    truth = library_results()
    ranks = [on_a_rank()] if world == 1 else run_ranks(on_a_rank, world)
    for name, theirs in truth.items():
        parts = [r[name] for r in ranks]
        # activations: the ranks' rows side by side; parameters: each rank's part of the gradient of the sum
        ours = torch.cat(parts) if name in ("out", "regions") else torch.stack(parts).sum(0)
        assert torch.allclose(ours, theirs, rtol=1e-10, atol=1e-12), name


def evaluated_on_a_rank() -> Tensor:
    encoder, regions, _ = problem()
    with torch.no_grad():
        return encoder.eval()(regions[rank_slice(IMAGES)])


def test_evaluation_keeps_to_its_own_group() -> None:
    encoder, regions, _ = problem()
    for r, ours in enumerate(run_ranks(evaluated_on_a_rank, 2)):
        with torch.no_grad():
            alone = encoder.eval()(regions[rank_slice(IMAGES, r, 2)])
        assert torch.allclose(ours, alone, atol=1e-13)


def test_dropout_acts_in_training_only() -> None:
    torch.manual_seed(0)
    encoder = CrossImageEncoder(DIM, CrossImageConfig(layers=1, heads=4, feedforward=24, dropout=0.5))
    regions = torch.randn(IMAGES, REGIONS, DIM)
    assert not torch.equal(encoder(regions), encoder(regions))
    encoder.eval()
    assert torch.equal(encoder(regions), encoder(regions))


def test_no_layers_change_nothing() -> None:
    regions = torch.randn(2, REGIONS, DIM)
    assert torch.equal(CrossImageEncoder(DIM, CrossImageConfig(layers=0))(regions), regions)


def alone_on_a_rank() -> dict[str, Tensor]:
    encoder, regions, towards = problem()
    encoder.alone = True
    mine = rank_slice(IMAGES)
    return results(encoder.train(), regions[mine], towards[mine])


@pytest.mark.parametrize(
    ("config", "reason"), [(CrossImageConfig(layers=0), "layers is 0"), (CrossImageConfig(alone=True), "alone is set")]
)
def test_what_needs_other_images_is_refused_without(config: CrossImageConfig, reason: str) -> None:
    run = RunConfig(model=ModelConfig(cross_image=config), train=TrainConfig(passes="joint"))
    with pytest.raises(UsageError, match=f"train.passes joint .*{reason}"):
        check_batch(run, 1)
    beside = EvaluationConfig(sets=("city",), groups=("bank",))
    with pytest.raises(UsageError, match=f"validate.groups bank .*{reason}"):
        check_batch(replace(run, train=TrainConfig(), validate=beside), 1)
    check_batch(replace(run, train=TrainConfig()), 1)


def test_the_control_is_the_same_layers_over_groups_of_one_also_in_training() -> None:
    """`alone`: torch's encoder on one image at a time, gradients too; and no rank needs another."""
    encoder, regions, towards = problem()
    layer = nn.TransformerEncoderLayer(DIM, CONFIG.heads, CONFIG.feedforward, 0.0, "gelu", batch_first=False)
    library = nn.TransformerEncoder(layer, CONFIG.layers, enable_nested_tensor=False).double()
    library.load_state_dict(encoder.state_dict())
    one_by_one = nn.Module()
    one_by_one.layers = library.layers
    one_by_one.forward = lambda x: torch.cat([library(image[None]) for image in x])  # type: ignore[method-assign]
    truth = results(one_by_one, regions, towards)
    assert CrossImageEncoder(DIM, CrossImageConfig(alone=True, heads=4)).alone
    ranks = run_ranks(alone_on_a_rank, 2)
    for name, theirs in truth.items():
        parts = [r[name] for r in ranks]
        ours = torch.cat(parts) if name in ("out", "regions") else torch.stack(parts).sum(0)
        assert torch.allclose(ours, theirs, rtol=1e-10, atol=1e-12), name
