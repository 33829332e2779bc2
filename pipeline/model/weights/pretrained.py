"""Released weights from wherever they lie: a .pth, safetensors, a transformers folder, the hub (`hub:OWNER/NAME`).

Invariant: nothing foreign is ever executed: pickles are read with `weights_only=True`, everything else is
safetensors; every failure is one line that names the source. Nothing is asked of the network but what begins with
`hub:`, so a mistyped path stays here.
"""

from __future__ import annotations

import importlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from pipeline.common.errors import DataError, UsageError
from pipeline.common.text import shown
from pipeline.model.weights.foreign import check_file, check_tensors, is_safetensors, message
from pipeline.model.weights.names import fit, published_name, to_published
from pipeline.model.weights.where import FILE, HUB, HUB_NAME, no_such_weights

# wrappers that training codes put around a state dict
WRAPPERS = ("model_state_dict", "state_dict", "model", "teacher")
# what torch.compile, sharding and checkpointing add to the names of the modules they wrap, at any depth
ADDED = ("_orig_mod.", "_fsdp_wrapped_module.", "_checkpoint_wrapped_module.", "_forward_module.")
INSIDE = re.compile("|".join(rf"(?:(?<=\.)|^){re.escape(word)}" for word in ADDED))


def read_tensors(source: str) -> dict[str, Tensor]:
    """The state dict of a file (.pth .pt .bin .safetensors), a transformers folder or `hub:OWNER/NAME`, on the
    CPU.

    Raises:
        UsageError: nothing there under that path or name.
        DataError: a file that is broken, or that holds more than tensors.
    """
    if source.startswith(HUB):
        return _read_safetensors(_from_hub(source.removeprefix(HUB)))
    path = Path(source).expanduser()
    if path.is_dir():
        index = path / "model.safetensors.index.json"
        if index.is_file():
            return {name: t for file in _indexed(index) for name, t in _read_safetensors(path / file).items()}
        if not (path / FILE).is_file():
            raise UsageError(f"{source}: the folder holds no model.safetensors")
        return _read_safetensors(path / FILE)
    if path.is_file():
        return _read_file(path)
    raise UsageError(no_such_weights(source))


def _read_file(path: Path) -> dict[str, Tensor]:
    """A file by what it holds, whatever its name ends in."""
    try:
        check_file(path)
        return _read_safetensors(path) if is_safetensors(path) else _read_pickle(path)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error})") from error


def _indexed(index: Path) -> list[str]:
    """The files that transformers' index of a model in parts names."""
    try:
        files = sorted(set(json.loads(index.read_text())["weight_map"].values()))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{index}: not an index of safetensors files ({message(error)})") from error
    for file in files:
        if not isinstance(file, str) or Path(file).name != file or not (index.parent / file).is_file():
            raise DataError(f"{index}: the file '{shown(file)}' is not beside it")
    return files


def _read_safetensors(path: Path) -> dict[str, Tensor]:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        return load_file(path)
    except (SafetensorError, OSError) as error:
        raise DataError(f"{path}: not a readable safetensors file ({message(error)})") from error


def _read_pickle(path: Path) -> dict[str, Tensor]:
    # the published trainer keeps its recalls as NumPy arrays in the checkpoint: plain data, allowed by name
    array: Any = importlib.import_module("numpy._core.multiarray")
    numpy_data: list[Any] = [np.dtype, np.ndarray, np.dtypes.Float64DType, np.dtypes.Float32DType, np.dtypes.Int64DType]
    for function in (array.scalar, array._reconstruct):
        for module in ("numpy.core.multiarray", "numpy._core.multiarray"):
            numpy_data.append((function, f"{module}.{function.__name__}"))
    try:
        with (
            torch.serialization.safe_globals(numpy_data),
            path.open("rb") as stream,
        ):  # a path's ending would mislead it
            loaded = torch.load(stream, map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load has no closed list: zip, pickle, end of file, unsafe globals
        raise DataError(
            f"{path}: not loaded: it is broken or holds more than tensors, and code in a file is never run "
            f"({message(error)})"
        ) from error
    if not isinstance(loaded, Mapping):
        raise DataError(f"{path}: holds a {type(loaded).__name__}, not a state dict")
    tensors = unwrap(loaded, str(path))
    check_tensors(tensors, path)
    return tensors


def unwrap(state: Mapping[str, Any], source: str) -> dict[str, Tensor]:
    """The bare state dict: a trainer's wrapper opened, the prefixes of parallel and compiled modules taken off.

    Raises:
        DataError: no tensors in it.
    """
    for key in WRAPPERS:
        if isinstance(state.get(key), Mapping):
            state = state[key]
            break
    tensors = {name: t for name, t in state.items() if isinstance(t, Tensor) and isinstance(name, str)}
    if not tensors:
        raise DataError(f"{source}: holds no tensors")
    bare = {INSIDE.sub("", name): t for name, t in tensors.items()}
    while all(name.startswith("module.") for name in bare):
        bare = {name.removeprefix("module."): t for name, t in bare.items()}
    if len(bare) < len(tensors):
        raise DataError(f"{source}: two tensors have the same name once {', '.join(ADDED)} are taken out")
    return bare


def _from_hub(name: str) -> Path:
    if HUB_NAME.fullmatch(name) is None:
        raise UsageError(f"{shown(HUB + name)}: a name on the model hub is OWNER/NAME, as in hub:facebook/dinov2-base")
    from huggingface_hub import HfApi, hf_hub_download

    try:
        return Path(hf_hub_download(name, FILE, local_files_only=True))
    except Exception as missing:  # not fetched before: ask the hub, once, before the download begins its long retries
        try:
            HfApi().model_info(name, timeout=10)
            return Path(hf_hub_download(name, FILE))
        except Exception as error:  # the client's own errors and those of every network library under it
            raise UsageError(
                f"{HUB}{name}: the model hub did not give it ({message(error)}); "
                "download the weights and give their path"
            ) from missing


def backbone_tensors(tensors: Mapping[str, Tensor], source: str, registers: bool = False) -> dict[str, Tensor]:
    """A DINOv2 backbone's tensors under published names, whatever naming they came in.

    Understood are the release's own names, a CricaVPR state dict (its backbone without adapters), and those of
    transformers, old and new.

    Raises:
        UsageError: none of these, or register tokens where the backbone has none, or none where it has.
    """
    found = any("register_tokens" in name for name in tensors)
    if found != registers:
        which = ("with", "without") if found else ("without", "with")
        raise UsageError(
            f"{source}: a DINOv2 {which[0]} register tokens; this backbone takes the variant {which[1]} them "
            f"(backbone.name ending in _reg has them)"
        )
    if "blocks.0.norm1.weight" in tensors:
        return {f"backbone.{name}": t for name, t in tensors.items()}
    if "backbone.blocks.0.norm1.weight" in tensors:
        return {n: t for n, t in tensors.items() if n.startswith("backbone.") and ".adapter." not in n}
    prefixes = ("dinov2.", "dinov2_with_registers.")
    bare = {name.removeprefix(prefixes[0]).removeprefix(prefixes[1]): t for name, t in tensors.items()}
    if "encoder.layer.0.norm1.weight" in bare:
        own = {f"backbone.vit.{n}": t for n, t in bare.items() if not n.startswith("classifier.")}
        return to_published(own)
    first = published_name(next(iter(bare)))[0]
    raise UsageError(f"{source}: no DINOv2 weights in it, nor a release that is known here (first tensor: '{first}')")


def load_backbone(backbone: Any, source: str, kind: str) -> None:
    """Loads released weights, as float32, into a backbone without adapters (which may be on the meta device).

    Raises:
        UsageError: nothing at that path, or weights of another size; DataError: a broken file.
    """
    rope, registers = bool(backbone.rope), bool(backbone.registers)
    given = read_tensors(source)
    tensors = dinov3_tensors(given, source) if rope else backbone_tensors(given, source, registers)
    width = tensors["backbone.norm.weight"].shape[0] if "backbone.norm.weight" in tensors else 0
    if not backbone.final_norm:
        tensors = {name: t for name, t in tensors.items() if not name.startswith("backbone.norm.")}
    # unused; some exports leave it out
    tensors.setdefault("backbone.mask_token", torch.zeros((1, 1, width) if rope else (1, width)))
    floats = {name: t.float() for name, t in tensors.items()}
    fit(backbone, floats, f"{source} (for backbone.name {kind})", prefix="backbone.", assign=True)


# DINOv3's release -> transformers
DINOV3_NAMES = [
    (re.compile(pattern), replacement)
    for pattern, replacement in [
        (r"^storage_tokens$", "embeddings.register_tokens"),
        (r"^(cls_token|mask_token)$", r"embeddings.\1"),
        (r"^patch_embed\.proj\.", "embeddings.patch_embeddings."),
        (r"^blocks\.", "layer."),
        (r"\.attn\.proj\.", ".attention.o_proj."),
        (r"\.ls([12])\.gamma$", r".layer_scale\1.lambda1"),
        (r"\.mlp\.w1\.", ".mlp.gate_proj."),
        (r"\.mlp\.(fc1|w2)\.", ".mlp.up_proj."),
        (r"\.mlp\.(fc2|w3)\.", ".mlp.down_proj."),
    ]
]


def dinov3_tensors(tensors: Mapping[str, Tensor], source: str) -> dict[str, Tensor]:
    """A DINOv3 backbone's tensors under our file's names, from its release or from transformers.

    The release fuses query, key and value; its keys have no bias (masked), and its rotary periods follow from the
    config, so neither is read.

    Raises:
        UsageError: no DINOv3 in it.
    """
    if not any("register_tokens" in name or "storage_tokens" in name for name in tensors):
        raise UsageError(f"{source}: no DINOv3 weights in it (they have register or storage tokens)")
    own: dict[str, Tensor] = {}
    for name, tensor in tensors.items():
        if name.endswith(("bias_mask", "rope_embed.periods", "inv_freq")):
            continue
        if name == "mask_token":
            tensor = tensor.reshape(1, 1, -1)
        for pattern, replacement in DINOV3_NAMES:
            name = pattern.sub(replacement, name)
        fused = re.match(r"(layer\.\d+\.)attn\.qkv\.(weight|bias)$", name)
        if fused is None:
            own[f"backbone.vit.{name.removeprefix('dinov3_vit.').removeprefix('model.')}"] = tensor
            continue
        for part, piece in zip("qkv", tensor.chunk(3), strict=True):
            if (part, fused[2]) != ("k", "bias"):
                own[f"backbone.vit.{fused[1]}attention.{part}_proj.{fused[2]}"] = piece
    return to_published(own)


def load_resnet(backbone: nn.Module, source: str, kind: str) -> None:
    """Loads torchvision-named weights, as float32, into a residual network; its classifier and unused stages stay out.

    Raises:
        UsageError: nothing at that path, or weights of another network; DataError: a broken file.
    """
    own = backbone.state_dict()
    stages = {name.split(".")[0] for name in own}
    tensors = {
        f"backbone.{name}": t.float() if t.is_floating_point() else t
        for name, t in read_tensors(source).items()
        if not name.startswith("fc.") and (not name.startswith("layer") or name.split(".")[0] in stages)
    }
    for name in own:  # only counts batches; some exports leave it out
        if name.endswith("num_batches_tracked"):
            tensors.setdefault(f"backbone.{name}", torch.tensor(0))
    fit(backbone, tensors, f"{source} (for backbone.name {kind})", prefix="backbone.", assign=True)


def load_vgg(backbone: nn.Module, source: str, kind: str) -> None:
    """Loads torchvision-named weights, as float32, into VGG-16; its classifier stays out.

    Raises:
        UsageError: nothing at that path, or weights of another network; DataError: a broken file.
    """
    given = read_tensors(source)
    tensors = {f"backbone.{name}": t.float() for name, t in given.items() if not name.startswith("classifier.")}
    fit(backbone, tensors, f"{source} (for backbone.name {kind})", prefix="backbone.", assign=True)
