"""Released weights from wherever they lie: .pth, safetensors, a transformers folder, or a hub name.

Invariant: nothing foreign is ever executed: pickles are read with `weights_only=True`, everything else is
safetensors; every failure is one line that names the source.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from pipeline.model.names import fit, published_name, to_published
from shards.errors import DataError, UsageError

FILE = "model.safetensors"
# wrappers that training codes put around a state dict
WRAPPERS = ("model_state_dict", "state_dict", "model", "teacher")


def read_tensors(source: str) -> dict[str, Tensor]:
    """The state dict of a file (.pth .pt .bin .safetensors), a transformers folder or a hub name, on the CPU.

    Raises:
        UsageError: nothing there under that path or name.
        DataError: a file that is broken, or that holds more than tensors.
    """
    path = Path(source).expanduser()
    if path.is_dir():
        index = path / "model.safetensors.index.json"
        if index.is_file():
            files = sorted(set(json.loads(index.read_text())["weight_map"].values()))
            return {name: t for file in files for name, t in _read_safetensors(path / file).items()}
        if not (path / FILE).is_file():
            raise UsageError(f"{source}: the folder holds no model.safetensors")
        return _read_safetensors(path / FILE)
    if path.is_file():
        return _read_safetensors(path) if path.suffix == ".safetensors" else _read_pickle(path)
    if path.suffix or source.count("/") != 1:
        raise UsageError(f"{source}: there is no such weights file or folder")
    return _read_safetensors(_from_hub(source))


def _read_safetensors(path: Path) -> dict[str, Tensor]:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        return load_file(path)
    except (SafetensorError, OSError) as error:
        raise DataError(f"{path}: not a readable safetensors file ({_line(error)})") from error


def _read_pickle(path: Path) -> dict[str, Tensor]:
    # the published trainer keeps its recalls as NumPy arrays in the checkpoint: plain data, allowed by name
    array: Any = importlib.import_module("numpy._core.multiarray")
    numpy_data: list[Any] = [np.dtype, np.ndarray, np.dtypes.Float64DType, np.dtypes.Float32DType, np.dtypes.Int64DType]
    for function in (array.scalar, array._reconstruct):
        for module in ("numpy.core.multiarray", "numpy._core.multiarray"):
            numpy_data.append((function, f"{module}.{function.__name__}"))
    try:
        with torch.serialization.safe_globals(numpy_data):
            loaded = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load has no closed list: zip, pickle, end of file, unsafe globals
        raise DataError(
            f"{path}: not loaded, it is broken or holds more than tensors, and foreign code is never run "
            f"({_line(error)})"
        ) from error
    if not isinstance(loaded, Mapping):
        raise DataError(f"{path}: holds a {type(loaded).__name__}, not a state dict")
    return unwrap(loaded, str(path))


def unwrap(state: Mapping[str, Any], source: str) -> dict[str, Tensor]:
    """The bare state dict: a trainer's wrapper opened, the prefixes of parallel and compiled modules taken off.

    Raises:
        DataError: no tensors in it.
    """
    for key in WRAPPERS:
        if isinstance(state.get(key), Mapping):
            state = state[key]
            break
    tensors = {name: t for name, t in state.items() if isinstance(t, Tensor)}
    if not tensors:
        raise DataError(f"{source}: holds no tensors")
    for prefix in ("module.", "_orig_mod."):
        if all(name.startswith(prefix) for name in tensors):
            tensors = {name.removeprefix(prefix): t for name, t in tensors.items()}
    return tensors


def _from_hub(name: str) -> Path:
    from huggingface_hub import HfApi, hf_hub_download

    try:
        return Path(hf_hub_download(name, FILE, local_files_only=True))
    except Exception as missing:  # not fetched before: ask the hub, once, before the download begins its long retries
        try:
            HfApi().model_info(name, timeout=10)
            return Path(hf_hub_download(name, FILE))
        except Exception as error:  # the client's own errors and those of every network library under it
            raise UsageError(
                f"{name}: no such file or folder here, and the model hub did not give it ({_line(error)}); "
                "download the weights and give their path"
            ) from missing


def _line(error: Exception) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) < 160 else text[:157] + "..."


def backbone_tensors(tensors: Mapping[str, Tensor], source: str) -> dict[str, Tensor]:
    """A DINOv2 backbone's tensors under published names, whatever naming they came in.

    Understood are the release's own names, a CricaVPR state dict (its backbone without adapters), and those of
    transformers, old and new.

    Raises:
        UsageError: none of these, or a variant with register tokens.
    """
    if any("register_tokens" in name for name in tensors):
        raise UsageError(f"{source}: a DINOv2 with register tokens; this backbone takes the variant without them")
    if "blocks.0.norm1.weight" in tensors:
        return {f"backbone.{name}": t for name, t in tensors.items()}
    if "backbone.blocks.0.norm1.weight" in tensors:
        return {n: t for n, t in tensors.items() if n.startswith("backbone.") and ".adapter." not in n}
    bare = {name.removeprefix("dinov2."): t for name, t in tensors.items()}
    if "encoder.layer.0.norm1.weight" in bare:
        own = {f"backbone.vit.{n}": t for n, t in bare.items() if not n.startswith("classifier.")}
        return to_published(own)
    raise UsageError(f"{source}: no DINOv2 weights in it (first tensor: '{published_name(next(iter(bare)))[0]}')")


def load_backbone(backbone: nn.Module, source: str, kind: str) -> None:
    """Loads released weights, as float32, into a backbone without adapters (which may be on the meta device).

    Raises:
        UsageError: nothing at that path, or weights of another size; DataError: a broken file.
    """
    tensors = backbone_tensors(read_tensors(source), source)
    width = tensors["backbone.norm.weight"].shape[0] if "backbone.norm.weight" in tensors else 0
    tensors.setdefault("backbone.mask_token", torch.zeros(1, width))  # unused; some exports leave it out
    floats = {name: t.float() for name, t in tensors.items()}
    fit(backbone, floats, f"{source} (for backbone.name {kind})", prefix="backbone.", assign=True)
