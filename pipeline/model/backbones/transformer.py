"""The image encoder: the transformers library's DINOv2 or DINOv3 with adapters beside the MLP of every block.

Invariant: the stored position embedding stays the parameter it was released as; what the tokens get added is its
resize to the input's grid, made once a grid where the embedding is frozen and in every forward where it is trained, so
the library never interpolates at run time. The mask token of the released weights is kept, frozen and unused, so
that parameter counts are those of the released model. Register tokens take part inside and never come out. DINOv3
has rotary positions instead of an embedding, which its library computes from the image's size.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pipeline.common.errors import UsageError
from pipeline.config import BackboneConfig, ModelConfig
from pipeline.config.image_size import ImageSize, for_patch
from pipeline.model.adapters import AdaptedMLP, ConvAdapter, build_adapter
from pipeline.model.pooling import Grid


@dataclass(frozen=True)
class Sizes:
    """Width, depth and shapes of a vision transformer."""

    dim: int
    depth: int
    heads: int
    patch: int = 14
    mlp_ratio: int = 4
    pretrain_grid: int = 37
    swiglu: bool = False
    registers: int = 0
    rope: bool = False


SIZES: dict[str, Sizes] = {
    "dinov2_vits14": Sizes(384, 12, 6),
    "dinov2_vitb14": Sizes(768, 12, 12),
    "dinov2_vitl14": Sizes(1024, 24, 16),
    "dinov2_vitg14": Sizes(1536, 40, 24, swiglu=True),
    "dinov3_vits16": Sizes(384, 12, 6, patch=16, registers=4, rope=True),
    "dinov3_vits16plus": Sizes(384, 12, 6, patch=16, swiglu=True, registers=4, rope=True),
    "dinov3_vitb16": Sizes(768, 12, 12, patch=16, registers=4, rope=True),
    "dinov3_vitl16": Sizes(1024, 24, 16, patch=16, registers=4, rope=True),
    "dinov3_vith16plus": Sizes(1280, 32, 20, patch=16, swiglu=True, registers=4, rope=True),
}
SIZES |= {f"{name}_reg": dataclasses.replace(s, registers=4) for name, s in SIZES.items() if name.startswith("dinov2")}


def sizes(config: BackboneConfig) -> Sizes:
    """The sizes behind a backbone's name; `custom` takes them from the config's fields.

    Raises:
        UsageError: heads that do not divide the width.
    """
    if config.name != "custom":
        return SIZES[config.name]
    if config.dim % config.heads:
        raise UsageError(f"backbone.dim {config.dim} is not a multiple of backbone.heads {config.heads}")
    return Sizes(
        config.dim,
        config.depth,
        config.heads,
        config.patch,
        config.mlp_ratio,
        config.pretrain_grid,
        registers=config.registers,
        rope=config.rope,
    )


def resize_positions(stored: Tensor, grid: Grid, registers: bool = False) -> Tensor:
    """The position embedding on another grid of h x w tokens, as DINOv2 resizes it: [1, 1 + S*S, D] -> [1, 1 + h*w, D].

    Bicubic without antialias, `align_corners=False`, with the scales (h + 0.1) / S and (w + 0.1) / S rather than the
    size: the offset is DINOv2's guard against rounding, and it shifts the sampling points: it belongs to the weights.
    The variants with registers were released with antialias and without the offset. In float32, like the published
    code; a trained float64 embedding stays float64 so its gradient loses no digits.
    """
    side = round((stored.shape[1] - 1) ** 0.5)
    if grid == (side, side):
        return stored
    precise = torch.float64 if stored.dtype == torch.float64 and stored.requires_grad else torch.float32
    patches = stored[:, 1:].to(precise).reshape(1, side, side, -1).permute(0, 3, 1, 2)
    if registers:
        patches = F.interpolate(patches, size=grid, mode="bicubic", align_corners=False, antialias=True)
    else:
        scale = ((grid[0] + 0.1) / side, (grid[1] + 0.1) / side)
        patches = F.interpolate(patches, scale_factor=scale, mode="bicubic", align_corners=False)
    patches = patches.permute(0, 2, 3, 1).flatten(1, 2).to(stored.dtype)
    return torch.cat((stored[:, :1], patches), dim=1)


class Embeddings(nn.Module):
    """Class token, registers, patch projection, position embedding; takes the place of the library's embeddings."""

    def __init__(self, library: nn.Module, grid: Grid, registers: int = 0) -> None:
        super().__init__()
        self.grid = grid
        self.cls_token: nn.Parameter = library.cls_token  # type: ignore[assignment]
        self.mask_token: nn.Parameter = library.mask_token  # type: ignore[assignment]
        self.position_embeddings: nn.Parameter = library.position_embeddings  # type: ignore[assignment]
        self.patch_embeddings: nn.Module = library.patch_embeddings  # type: ignore[assignment]
        self.register_tokens: nn.Parameter | None = None
        if registers:
            self.register_tokens = nn.Parameter(torch.zeros(1, registers, self.cls_token.shape[-1]))
            nn.init.trunc_normal_(self.register_tokens, std=0.02)
        self.register_buffer("resized", None, persistent=False)
        self.register_load_state_dict_post_hook(lambda module, keys: module.refresh())
        self.refresh()

    @torch.no_grad()
    def refresh(self) -> None:
        """Resizes the stored embedding anew; called when weights were loaded, or `grid` was changed."""
        frozen = self.position_embeddings.detach()
        self.resized = resize_positions(frozen, self.grid, self.register_tokens is not None)

    def forward(self, pixel_values: Tensor, **_: Any) -> Tensor:
        """[b, 3, H, W] -> [b, 1 + registers + h*w, D]; registers get no position."""
        patches = self.patch_embeddings(pixel_values)
        positions = self.resized
        if self.position_embeddings.requires_grad:
            positions = resize_positions(self.position_embeddings, self.grid, self.register_tokens is not None)
        tokens = torch.cat((self.cls_token.expand(patches.shape[0], -1, -1), patches), dim=1) + positions
        if self.register_tokens is None:
            return tokens
        return torch.cat((tokens[:, :1], self.register_tokens.expand(patches.shape[0], -1, -1), tokens[:, 1:]), dim=1)


class Backbone(nn.Module):
    """DINOv2 or DINOv3 with adapters: [b, 3, H, W] normalised images -> [b, 1 + h*w, D] tokens after the final norm
    (or before it, `final_norm: false`).

    Attributes:
        size: of the input.
        grid: rows h and columns w of the patch tokens, of the last input where its size varies.
        stride: the patch, in pixels.

    Args:
        config: the model's config; used are its backbone, its adapter, and what of them is trained.
        image_size: of the input; its sides are multiples of the patch.

    Raises:
        UsageError: an input size that is no multiple of the patch, weights that do not fit, an attention
            implementation that is not installed, more last blocks than there are.
    """

    def __init__(self, config: ModelConfig, image_size: int | str | ImageSize) -> None:
        super().__init__()
        size = sizes(config.backbone)
        self.size, self.stride = for_patch(ImageSize.of(image_size), size.patch, config.backbone.name), size.patch
        if config.trainable == "last" and not 1 <= config.last_blocks <= size.depth:
            raise UsageError(f"model.last_blocks {config.last_blocks} must lie between 1 and the depth {size.depth}")
        self.dim, self.depth, self.grid = size.dim, size.depth, self.grid_of(*self.size.largest)
        self.registers, self.rope, self.final_norm = size.registers, size.rope, config.backbone.final_norm
        weights = config.backbone.weights
        # with released weights the random start would only cost time: shapes first, tensors from the file
        with torch.device("meta") if weights else contextlib.nullcontext():
            self.vit: Any = (_dinov3 if size.rope else _dinov2)(size, config.backbone)
            if not size.rope:
                self.vit.embeddings = Embeddings(self.vit.embeddings, self.grid, size.registers)
            if not config.backbone.final_norm:
                setattr(self.vit, "norm" if size.rope else "layernorm", nn.Identity())
        if size.rope:  # its frequencies follow from the config and are in no file: real also where all else is shapes
            with torch.device("cpu"):
                self.vit.rope_embeddings = type(self.vit.rope_embeddings)(self.vit.config)
        if weights:
            from pipeline.model.weights.pretrained import load_backbone

            load_backbone(self, weights, config.backbone.name)
        self._freeze(config)

    def _freeze(self, config: ModelConfig) -> None:
        """Sets what is trained, and adapters in where they are.

        A frozen adapter would add nothing for ever, its last Linear being zero, so frozen blocks get none. The mask
        token is never trained: it takes part in nothing, and DDP wants no idle trainable parameter.
        """
        last = {"adapters": self.depth, "full": self.depth, "frozen": 0, "last": config.last_blocks}[config.trainable]
        self.requires_grad_(config.trainable == "full")
        self.vit.embeddings.mask_token.requires_grad_(False)
        if config.trainable == "last":
            for module in (*self.blocks[self.depth - last :], self.vit.norm if self.rope else self.vit.layernorm):
                module.requires_grad_(True)
        if config.adapter.kind != "none":
            for block in self.blocks[self.depth - last :]:
                adapter = build_adapter(config.adapter, self.dim, self.grid, 1 + self.registers)
                block.mlp = AdaptedMLP(block.mlp, adapter, config.adapter.scale)

    @property
    def blocks(self) -> list[Any]:
        """The transformer blocks in order."""
        if not self.rope:
            return list(self.vit.encoder.layer)
        return list(getattr(self.vit, "model", self.vit).layer)  # transformers 5.17 has no `model` in between

    def adapters(self) -> list[nn.Module]:
        """The adapters in block order; empty without adapters."""
        return [block.mlp.adapter for block in self.blocks if isinstance(block.mlp, AdaptedMLP)]

    def grid_of(self, height: int, width: int, layer: int | None = None) -> Grid:
        """Rows and columns of the patch tokens of an input, after every block the same."""
        return height // self.stride, width // self.stride

    def _on(self, images: Tensor) -> None:
        """Brings positions and adapters to the images' grid, where it is another than that of the images before."""
        grid = self.grid_of(*images.shape[-2:])
        if grid == self.grid:
            return
        self.grid = grid
        for adapter in self.adapters():
            if isinstance(adapter, ConvAdapter):
                adapter.grid = grid
        if not self.rope:
            self.vit.embeddings.grid = grid
            self.vit.embeddings.refresh()

    def patches(self, images: Tensor, layer: int | None = None) -> Tensor:
        """[b, 3, H, W] -> [b, h*w, D] patch tokens after block `layer` (1 is the first), under the final norm.

        Args:
            layer: None takes the last, which is `forward` without its class token.

        Raises:
            UsageError: no such block.
        """
        if layer is None:
            return self(images)[:, 1:]
        if not 1 <= layer <= self.depth:
            raise UsageError(f"layer {layer}: the backbone's blocks are 1 to {self.depth}")
        self._on(images)
        found: list[Tensor] = []

        def keep(_: nn.Module, __: Any, output: Any) -> None:
            found.append(output if isinstance(output, Tensor) else output[0])

        hook = self.blocks[layer - 1].register_forward_hook(keep)
        try:
            self.vit(pixel_values=images)
        finally:
            hook.remove()
        norm = self.vit.norm if self.rope else self.vit.layernorm
        tokens: Tensor = norm(found[0])
        return tokens[:, 1 + self.registers :]

    def forward(self, images: Tensor) -> Tensor:
        """[b, 3, H, W] -> [b, 1 + h*w, D]: class token first, then patches row by row."""
        self._on(images)
        tokens: Tensor = self.vit(pixel_values=images).last_hidden_state
        if not self.registers:
            return tokens
        return torch.cat((tokens[:, :1], tokens[:, 1 + self.registers :]), dim=1)


def _dinov2(size: Sizes, config: BackboneConfig) -> Any:
    from transformers import Dinov2Config, Dinov2Model  # four seconds: only where a model is built

    settings: dict[str, Any] = {
        "hidden_size": size.dim,
        "num_hidden_layers": size.depth,
        "num_attention_heads": size.heads,
        "mlp_ratio": size.mlp_ratio,
        "image_size": size.pretrain_grid * size.patch,
        "patch_size": size.patch,
        "use_swiglu_ffn": size.swiglu,
        "layerscale_value": config.layerscale,
        "attn_implementation": config.attention,
    }
    return _built(lambda: Dinov2Model(Dinov2Config(**settings)), config)


def _dinov3(size: Sizes, config: BackboneConfig) -> Any:
    from transformers import DINOv3ViTConfig, DINOv3ViTModel

    settings: dict[str, Any] = {
        "hidden_size": size.dim,
        "num_hidden_layers": size.depth,
        "num_attention_heads": size.heads,
        "intermediate_size": size.mlp_ratio * size.dim,
        "patch_size": size.patch,
        "num_register_tokens": size.registers,
        "use_gated_mlp": size.swiglu,
        "hidden_act": "silu" if size.swiglu else "gelu",
        "layerscale_value": config.layerscale,
        "attn_implementation": config.attention,
        # the library would jitter positions in train mode: an image must be encoded alike in training and evaluation
        "pos_embed_rescale": None,
    }
    return _built(lambda: DINOv3ViTModel(DINOv3ViTConfig(**settings)), config)


def _built(build: Callable[[], Any], config: BackboneConfig) -> Any:
    try:
        return build()
    except (ImportError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise UsageError(f"backbone.attention {config.attention} cannot be used here: {reason}") from error
