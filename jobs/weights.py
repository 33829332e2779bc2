"""Identify a weights file, import released weights, export a model to one file.

    python -m jobs.weights --source dinov2_vitb14_pretrain.pth --to weights/dinov2_vitb14.safetensors
    python -m jobs.weights --source CricaVPR.pth --to weights/cricavpr.safetensors
    python -m jobs.weights --source ResNet50_512_cosplace.pth --to weights/cosplace.safetensors
    python -m jobs.weights --source outputs/RUN --to weights/mine.safetensors
    python -m jobs.weights --source outputs/RUN --to weights/mine.onnx

The ending of --to decides what is written: .safetensors (everything, with the config inside), .pth (published names,
tensors only), .onnx (the per-image path, checked by onnxruntime against torch). Without --to it only says what the
source is. Of pickles only tensors are read; no code in a file is ever run.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from jobs.cli import parse, run_job
from pipeline.common.errors import UsageError
from pipeline.config import ModelConfig
from pipeline.config.setting import setting
from pipeline.model.weights.where import check_weights

if TYPE_CHECKING:
    from pipeline.model.vpr import PlaceModel

ENDINGS = (".safetensors", ".pth", ".onnx")


@dataclass(frozen=True)
class WeightsJob:
    """Describe, import or export weights."""

    source: str = ""
    """A run or checkpoint folder, a file of ours, a released CricaVPR or DINOv2 .pth, a release of another method
    (CosPlace, EigenPlaces, MixVPR, SALAD, BoQ, NetVLAD, SFRS, GCL, TransVPR), a transformers folder, or hub:OWNER/NAME
    (asked of the model hub, if it is not on this machine already)."""
    to: str = ""
    """The file to write: .safetensors, .pth or .onnx; none: only say what the source is."""
    kind: Literal[
        "auto", "model", "cricavpr", "backbone",
        "cosplace", "mixvpr", "salad", "boq", "netvlad", "sfrs", "gcl", "gcl_avg", "gem", "transvpr",
    ] = "auto"  # fmt: skip
    """What the source must be; auto looks. cosplace is EigenPlaces too; gcl_avg must be said, its average pooling
    leaves no trace in the file."""
    image_size: str | int | None = setting(None, changes="numbers", image_size="any")
    """Of the input: a side (224), height x width (480x640), or native (not for .onnx); none: as the file says; for
    released weights that of their authors' evaluation (CricaVPR: 224)."""
    variant: str = ""
    """For a backbone: write the whole model of this variant of the paper, with the rest untrained."""
    onnx: Literal["descriptors", "single", "regions"] = "descriptors"
    """.onnx. descriptors: each image beside the bank if the source has one, else as its own group; single: always as
    its own group; regions: the regional features before the cross-image encoder."""
    model: ModelConfig = field(default_factory=ModelConfig)
    """Sizes of a released CricaVPR or backbone that is not the paper's; other releases state their own."""


def main() -> None:
    """Parses, reads, tells, writes."""
    job = parse(WeightsJob, __doc__ or "")
    if not job.source:
        raise UsageError("--source is missing: a run folder, a file of ours, or released weights")
    target = Path(job.to) if job.to else None
    if target is not None and target.suffix not in ENDINGS:
        raise UsageError(f"--to {job.to}: the ending decides what is written; give one of {', '.join(ENDINGS)}")
    if target is not None and target.exists() and target.resolve() == Path(job.source).expanduser().resolve():
        raise UsageError(f"--to {job.to} is the source itself; give another file")
    check_weights(job.source)
    from pipeline.model.weights import convert

    found = convert.kind_of(job.source)
    kind = found if job.kind == "auto" else job.kind
    if kind == "model" and found != "model":
        raise UsageError(f"{job.source}: not {convert.KINDS['model']} but {convert.KINDS[found]}")
    if kind == "backbone" and not job.variant:
        _backbone(job, target, convert.KINDS[found])
        return
    if kind == "backbone":
        from pipeline.model.variants import variant

        config = variant(job.variant, job.model)
        backbone = convert.fitting_backbone(job.source, config.backbone)
        config = dataclasses.replace(config, backbone=backbone)
        model = convert.around_backbone(job.source, config, job.image_size)
    else:
        model = convert.read_model(job.source, kind, job.model, job.image_size)
    print(f"{job.source}: {convert.KINDS[kind if found == 'unpooled' else found]}")
    _describe(model)
    if target is not None:
        _write(model, target, job)


def _backbone(job: WeightsJob, target: Path | None, what: str) -> None:
    """Tells what backbone it is, and writes it under the release's names."""
    from pipeline.model.weights import convert

    config = convert.fitting_backbone(job.source, job.model.backbone)
    print(f"{job.source}: {what}; its backbone is {config.name}")
    if target is None:
        return
    if target.suffix != ".safetensors":
        raise UsageError(f"--to {job.to}: a backbone alone is written as .safetensors; --variant NAME makes it a model")
    tensors = convert.write_backbone(job.source, config, target)
    numbers = sum(tensor.numel() for tensor in tensors.values())
    print(f"  {len(tensors)} tensors, {numbers:,} numbers, read back and equal")
    _wrote(target, f"use it as --model.backbone.name {config.name} --model.backbone.weights {target}")


def _describe(model: PlaceModel) -> None:
    from pipeline.model.vpr import parameter_counts

    counts = parameter_counts(model)
    print(f"  {model.input_size.text} px -> {model.descriptor_dim:,} numbers ({model.regions} regions)")
    print(f"  parameters: {', '.join(f'{name} {count:,}' for name, count in counts.items())}")


def _write(model: PlaceModel, target: Path, job: WeightsJob) -> None:
    from pipeline.model.weights import convert

    if target.suffix == ".onnx":
        from pipeline.model.weights.onnx_export import export_onnx

        difference = export_onnx(model, target, job.onnx)
        print(f"  onnxruntime against torch, 1 and 3 images: largest difference {difference:.1e}")
        _wrote(target, "input 'images' [batch, 3, {}, {}], one output".format(*model.input_size.largest))
    elif target.suffix == ".pth":
        convert.write_published(model, target)
        _wrote(target, "published names, tensors alone")
    else:
        convert.write_model(model, target, job.source)
        _wrote(target, f"load_model('{target}'), or --checkpoint {target} in jobs.evaluate")


def _wrote(target: Path, how: str) -> None:
    size = sum(f.stat().st_size for f in (target, target.with_name(target.name + ".data")) if f.is_file())
    print(f"wrote {target} ({size / 1e6:,.1f} MB): {how}")


if __name__ == "__main__":
    run_job(main)
