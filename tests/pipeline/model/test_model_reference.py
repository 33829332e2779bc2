"""The whole model against a restatement of the paper, and against the published implementation's own numbers (which are
not in this repository): evaluation, one training step's gradients, three Adam steps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from releases_restated import cricavpr, cricavpr_shapes, filled, multi_similarity
from torch import Tensor, nn

from pipeline.config import AdapterConfig, BackboneConfig, CrossImageConfig, ModelConfig
from pipeline.model.vpr import PlaceModel, parameter_counts
from pipeline.model.weights.files import from_published
from pipeline.model.weights.names import layout
from pipeline.training.loss import MultiSimilarityLoss


def off(ours: Tensor, theirs: Any) -> float:
    return float((ours.double() - torch.as_tensor(theirs).double()).abs().max())


def test_descriptors_gradients_and_buffers_are_the_restated_models() -> None:
    """Small, in float64; a grid of 5 x 5 tokens from weights for 4 x 4, cut unevenly into 2 x 2 and 3 x 3 cells."""
    state = {n: t.double() if t.is_floating_point() else t for n, t in
             filled(cricavpr_shapes(128, 2, 4, 6, 2, 48)).items()}  # fmt: skip
    config = ModelConfig(
        backbone=BackboneConfig(name="custom", dim=128, depth=2, heads=2, patch=14, pretrain_grid=4),
        adapter=AdapterConfig(reduced=6),
        cross_image=CrossImageConfig(layers=2, heads=4, feedforward=48, dropout=0.0),
    )
    model = from_published({n: t.clone() for n, t in state.items()}, image_size=70, config=config)
    images = torch.from_numpy(np.random.default_rng(0).standard_normal((8, 3, 70, 70)))
    with torch.no_grad():
        assert off(model(images), cricavpr(state, images, 4, train=False)) < 1e-14

    model.train()
    trained = layout(name for name, parameter in model.named_parameters() if parameter.requires_grad)
    for name in trained:
        state[name].requires_grad_()
    labels = [0] * 4 + [1] * 4
    loss = MultiSimilarityLoss()(model(images), torch.tensor(labels))
    truth = multi_similarity(cricavpr(state, images, 4, train=True), labels)
    loss.backward()
    truth.backward()
    assert loss.item() == pytest.approx(truth.item(), abs=1e-13) and truth.item() > 0.1
    own = dict(model.named_parameters())
    assert len(trained) == 2 * 24 + 1 + 2 * 12
    for name, (ours,) in trained.items():
        theirs, found = state[name].grad, own[ours].grad
        assert theirs is not None and found is not None
        if ".conv.bias" in name:  # before a BatchNorm: nothing
            assert max(theirs.abs().max(), found.abs().max()) < 1e-15
        else:
            assert off(found, theirs) <= 1e-9 * float(theirs.abs().max()), name
    for name, (buffer,) in buffer_names(model).items():
        assert off(dict(model.named_buffers())[buffer], state[name]) < 1e-12, name


@pytest.mark.parametrize(
    ("dtype", "descriptor", "tokens"),
    [
        pytest.param(torch.float32, 3e-7, 2e-5, id="float32"),
        pytest.param(torch.float64, 1e-14, 1e-12, id="float64", marks=pytest.mark.slow),
    ],
)
def test_evaluation_reproduces_the_published_model(
    published_state: dict[str, Tensor], reference: Any, reference_images: Tensor,
    dtype: torch.dtype, descriptor: float, tokens: float,
) -> None:  # fmt: skip
    assert len(published_state) == 668
    model = from_published({f"module.{n}": t.to(dtype) if t.ndim else t for n, t in published_state.items()})
    assert not model.training and next(model.parameters()).dtype == dtype
    truth = reference["model_eval"]
    with torch.no_grad():
        out = model.backbone(reference_images.to(dtype))
        regions = model.pooling(out)
        related = model.cross_image(regions)
        descriptors = model.correlate(regions)
        assert off(model.backbone.vit.embeddings.resized, truth["pos_embed_224"]) == 0.0
        assert off(out[:, 0], truth["cls_tokens"]) < tokens
        assert off(out[0, 1:], truth["patch_tokens_image0"]) < max(tokens, 1e-6)  # stored in float32
        assert off(regions, truth["regions"]) < tokens
        assert off(related, truth["encoder_out"]) < tokens
        assert off(descriptors, truth["descriptor"]) < descriptor
        assert off(model.correlate(regions[:4]), truth["descriptor_first4"]) < max(descriptor, 1e-7)
        assert off(model.correlate(regions[:1]), truth["descriptor_single_image0"]) < descriptor
    if dtype == torch.float32:
        assert torch.allclose(model(reference_images[:1]), model.correlate(regions[:1]), atol=1e-7)


def training_model(state: dict[str, Tensor], start: str) -> PlaceModel:
    """The reference's training set-up: float64, train mode, dropout 0, from the recipe or the published start."""
    given = {n: t.double() if t.is_floating_point() else t for n, t in state.items()}
    if start == "officialinit":
        given |= {n: torch.full_like(t, 1e-5) for n, t in given.items() if ".adapter." in n and ".conv." in n}
        given |= {n: torch.zeros_like(t) for n, t in given.items() if ".adapter.D_fc2." in n}
    model = from_published(given).train()
    for module in model.modules():
        if isinstance(module, nn.Dropout):
            module.p = 0.0
    for layer in model.cross_image.layers:
        layer.self_attn.dropout = 0.0  # type: ignore[union-attr]
    return model


@pytest.mark.parametrize(
    ("start", "steps"),
    [
        ("recipe", 1),
        pytest.param("officialinit", 1, marks=pytest.mark.slow),
        pytest.param("recipe", 3, marks=pytest.mark.slow),
        pytest.param("officialinit", 3, marks=pytest.mark.slow),
    ],
)
def test_training_reproduces_the_published_gradients(
    published_state: dict[str, Tensor], reference: Any, reference_images: Tensor, start: str, steps: int
) -> None:
    """Loss, gradient norm and sum of all 313 trainable tensors, a dozen gradients in full, BatchNorm buffers; then
    the losses and the exponent after Adam steps. A conv bias before train-mode BatchNorm has a true gradient of 0."""
    truth = reference["train_step"]
    model = training_model(published_state, start)
    trained = {
        name: own for name, (own, *_) in layout(n for n, p in model.named_parameters() if p.requires_grad).items()
    }
    parameters = dict(model.named_parameters())
    names = truth[f"{start}_f64_grad_names"]
    assert set(names) == set(trained) and len(names) == 313
    optimizer = torch.optim.Adam([parameters[own] for own in trained.values()], lr=1e-4)
    images, labels = reference_images.double(), torch.tensor([0] * 4 + [1] * 4)
    loss_function = MultiSimilarityLoss(alpha=1.0, beta=50.0, base=0.0, margin=0.1)
    for step in range(steps):
        optimizer.zero_grad()
        loss = loss_function(model(images), labels)
        loss.backward()
        assert loss.item() == pytest.approx(float(truth[f"{start}_f64_losses"][step]), abs=1e-13)
        if step == 0:
            gradients = {name: parameters[own].grad for name, own in trained.items()}
            check_gradients(gradients, truth, start, names)
            buffers = {name: dict(model.named_buffers())[own] for name, (own,) in buffer_names(model).items()}
            stored = [key for key in truth.files if key.startswith(f"{start}_f64_buf::")]
            assert len(stored) == 20
            for key in stored:
                assert off(buffers[key.split("::")[1]], truth[key]) < 1e-11, key
        optimizer.step()
    if steps == 3:
        assert model.pooling.p is not None
        assert model.pooling.p.item() == pytest.approx(float(truth[f"{start}_f64_gem_p_after"]), abs=1e-12)


def buffer_names(model: PlaceModel) -> dict[str, list[str]]:
    return layout(name for name in model.state_dict() if "running" in name)


def check_gradients(gradients: dict[str, Any], truth: Any, start: str, names: Any) -> None:
    # the constant convolutions of the published start make nearly constant channels: BatchNorm divides by almost
    # nothing, and 1e-10 is what float64 leaves of the gradient behind it
    tolerance = 1e-11 if start == "recipe" else 1e-9
    norms, sums = truth[f"{start}_f64_grad_norms"], truth[f"{start}_f64_grad_sums"]
    for name, norm, total in zip(names, norms, sums, strict=True):
        gradient = gradients[name]
        if ".conv.bias" in name:
            assert float(gradient.norm()) < 1e-18
            continue
        assert abs(float(gradient.norm()) - norm) <= tolerance * norm, name
        assert abs(float(gradient.sum()) - total) <= tolerance * norm, name
    full = [key for key in truth.files if key.startswith(f"{start}_f64_grad::") and ".conv.bias" not in key]
    assert len(full) == 12
    for key in full:
        theirs = torch.from_numpy(truth[key])
        error = float((gradients[key.split("::")[1]] - theirs).norm())
        assert error <= tolerance * float(theirs.norm()), key


def test_parameter_counts_are_the_papers(published_state: dict[str, Tensor]) -> None:
    assert parameter_counts(from_published(published_state)) == {
        "total": 106_761_665,
        "trainable": 20_181_185,
        "backbone": 86_580_480,
        "adapters": 9_153_216,
        "cross_image": 11_027_968,
        "pooling": 1,
    }
