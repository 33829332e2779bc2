"""The per-image path as an ONNX file, checked by onnxruntime against torch before it is put in its place.

Invariant: what is exported does not look across images. `regions` is `encode`, which never does. `descriptors` is the
whole model, at any batch: beside its bank where it has one, whose keys and values are constants of the graph; else, or
with `single`, with every image as a group of its own. The cross-image encoder's layers are shared by the regions and
know no positions, so b images alone are one image with b*R regions, and that is exact.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import logging
import shutil
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pipeline.common.errors import DataError, UsageError
from pipeline.common.files import naming
from pipeline.config import to_dict
from pipeline.data.images import MEAN, STD
from pipeline.model.beside import BesideBank
from pipeline.model.vpr import PlaceModel

Output = Literal["descriptors", "single", "regions"]
PACKAGES = ("onnx", "onnxruntime", "onnxscript")
TOLERANCE = 1e-4  # of the largest value; float32 with another order of sums stays a hundred times below


class PerImage(nn.Module):
    """images [b, 3, H, W], normalised -> regions [b, R, D], or descriptors [b, R*D]."""

    def __init__(self, model: PlaceModel, output: Output) -> None:
        super().__init__()
        self.model, self.output = model, output
        self.beside = BesideBank(model, model.bank) if output == "descriptors" and model.bank is not None else None

    def forward(self, images: Tensor) -> Tensor:
        """[b, 3, H, W] -> [b, R, D] or [b, R*D]."""
        regions = self.model.encode(images)
        if self.output == "regions":
            return regions
        if self.beside is not None:
            related = self.model.cross_image.beside(regions, self.beside.memory())
            return F.normalize(related.flatten(1), dim=-1)
        alone = self.model.cross_image(regions.flatten(0, 1)[None])
        return F.normalize(alone.view_as(regions).flatten(1), dim=-1)


def export_onnx(model: PlaceModel, path: Path, output: Output = "descriptors") -> float:
    """Writes the ONNX file (above 2 GB its tensors go beside it, in `<name>.data`); returns the largest difference.

    The input is `images`, float32 [batch, 3, H, W], ImageNet-normalised; the file's metadata holds the config, the
    image size, mean and standard deviation.

    Raises:
        UsageError: the packages of the extra `onnx` are missing, or inputs have no one size.
        DataError: onnxruntime's result is not torch's; nothing is written then.
    """
    absent = [name for name in PACKAGES if importlib.util.find_spec(name) is None]
    if absent:
        raise UsageError(f"ONNX export needs {', '.join(absent)}: pip install 'place-recognition-training[onnx]'")
    if model.input_size.native:
        raise UsageError(f"{path}: an ONNX file has inputs of one size: give --image_size a side, or height x width")
    model = model.float().cpu().eval()
    folder = path.with_name(f".{path.name}.partial")
    shutil.rmtree(folder, ignore_errors=True)  # of a killed export
    try:
        with naming(path):
            folder.mkdir(parents=True)
            _write(model, folder / path.name, output)
        difference = check(model, folder / path.name, output)
        for written in sorted(folder.iterdir(), key=lambda f: f.name == path.name):  # the model itself comes last
            written.replace(path.parent / written.name)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return difference


def _write(model: PlaceModel, file: Path, output: Output) -> None:
    per_image = PerImage(model, output).eval()
    named = "regions" if output == "regions" else "descriptors"
    groups = "none: encode alone" if output == "regions" else "single"
    if per_image.beside is not None:
        bank = per_image.beside.bank
        groups = f"bank of {len(bank.regions)} images from {bank.source}, {bank.digest}"
    batch = torch.export.Dim("batch", min=1)
    example = torch.zeros(2, 3, *model.input_size.largest)
    with _quiet(), torch.no_grad():
        graph = torch.export.export(per_image, (example,), dynamic_shapes={"images": {0: batch}})
        program: Any = torch.onnx.export(
            graph, (), None, input_names=["images"], output_names=[named], dynamo=True, verbose=False
        )
    program.model.metadata_props.update(
        {
            "config": json.dumps(to_dict(model.config)),
            "image_size": str(model.image_size),
            "normalisation": json.dumps({"scale": 255, "mean": MEAN, "std": STD}),
            "groups": groups,
        }
    )
    program.save(file)


def check(model: PlaceModel, file: Path, output: Output) -> float:
    """The largest difference between onnxruntime and torch, on one image and on three; torch takes them one by one.

    Raises:
        DataError: it is above `TOLERANCE` of the largest value.
    """
    import onnxruntime

    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    generator = torch.Generator().manual_seed(0)
    worst = 0.0
    for count in (1, 3):
        images = torch.randn(count, 3, *model.input_size.largest, generator=generator)
        one: Any = model.encode if output == "regions" else model
        if output == "descriptors" and model.bank is not None:
            one = BesideBank(model, model.bank)
        with torch.no_grad():
            wanted = torch.cat([one(image[None]) for image in images])
        found = torch.from_numpy(session.run(None, {"images": images.numpy()})[0])
        difference = float((found - wanted).abs().max()) if found.shape == wanted.shape else float("inf")
        if not difference <= TOLERANCE * float(wanted.abs().max()):
            raise DataError(f"{file.name}: onnxruntime differs from torch by {difference:.1e}; the file was not kept")
        worst = max(worst, difference)
    return worst


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without the exporter's remarks on packages that are not installed and on its own innards."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
