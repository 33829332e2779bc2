"""Draw the paper's figures from your own models.

    python -m jobs.figures --kind parameters --to figures/parameters.md
    python -m jobs.figures --kind attention --checkpoint outputs/RUN --photos a.jpg,b.jpg --to figures/attention.jpg
    python -m jobs.figures --kind tsne --checkpoint outputs/RUN --places_from data/gsv --to figures/places.png
    python -m jobs.figures --kind qualitative --checkpoint outputs/RUN --baseline outputs/OTHER --sets pitts30k \
        --to figures/retrieval.jpg

attention: channel means of the patch tokens, of the released and the adapted backbone. tsne: 36 places of 12 photos,
the features before adaptation, after it, and of the complete model. qualitative: the first answers of two models to
queries where they differ.
parameters: Total, Backbone, Adapter, Others and Tunable of every variant.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from jobs.cli import parse, run_job
from jobs.there import need_sets
from pipeline.common.errors import DataError, UsageError
from pipeline.common.files import check_writable, write_atomically
from pipeline.config import EvaluationConfig, ModelConfig
from pipeline.config.setting import setting
from pipeline.model.weights.where import check_weights


@dataclass(frozen=True)
class FiguresJob(EvaluationConfig):
    """Draw a figure of the paper. The settings of an evaluation apply; of `groups` the first counts."""

    kind: Literal["attention", "tsne", "qualitative", "parameters"] = "parameters"
    """Which figure."""
    to: str = ""
    """File to write: .png or .jpg at 110 dpi, .pdf or .svg for a paper (vectors, photos at 300 dpi); .md for the
    parameters."""
    groups: tuple[Literal["single", "shuffled", "ordered"], ...] = ("shuffled",)
    """Which images are described together; only the first value counts."""
    checkpoint: str = ""
    """Our model: a run or checkpoint folder, a file, or a released .pth."""
    image_size: str | int | None = setting(None, changes="numbers", image_size="any")
    """What photos are brought to, as in jobs.evaluate; none: what each model's file says."""
    baseline: tuple[str, ...] = ()
    """Models to compare with, as for --checkpoint; attention and tsne also take a backbone's weights, and without
    --baseline use the checkpoint's own backbone without its adapters."""
    photos: tuple[str, ...] = ()
    """attention: photos, or folders; of a folder six photos at even distances."""
    places_from: str = ""
    """tsne: a folder in a layout that jobs.prepare reads: GSV-Cities', or a folder a place."""
    places: int = 36
    """tsne: number of places (paper: 36)."""
    images: int = 12
    """tsne: photos of each place (paper: 12)."""
    perplexity: float = 30.0
    """tsne: the perplexity, about the number of neighbours that count; at most a third of the photos."""
    seed: int = 0
    """tsne: seed of the choice of places and photos."""
    count: int = 6
    """qualitative: rows."""
    variants: tuple[str, ...] = ()
    """parameters: the paper's names; none: all."""


def main() -> None:
    """Parses and draws."""
    job = parse(FiguresJob, __doc__ or "")
    endings = (".md",) if job.kind == "parameters" else (".png", ".jpg", ".pdf", ".svg")
    if (job.to and Path(job.to).suffix not in endings) or (not job.to and job.kind != "parameters"):
        raise UsageError(f"--to '{job.to}': a file ending in {' or '.join(endings)} is wanted")
    if job.kind == "parameters":
        parameters(job)
        return
    if not job.checkpoint:
        raise UsageError("--checkpoint is missing: a run folder such as outputs/cricavpr, or a model file")
    for source in (job.checkpoint, *job.baseline):
        check_weights(source)
    if job.kind == "attention":
        if not job.photos:
            raise UsageError("--photos is missing: photos, or a folder of them")
        for photo in job.photos:
            if not Path(photo).exists():
                raise UsageError(f"{photo}: no such photo or folder")
    if job.kind == "tsne" and not job.places_from:
        raise UsageError("--places_from is missing: a folder in GSV-Cities' layout, or one with a folder a place")
    if job.kind == "tsne" and not Path(job.places_from).is_dir():
        raise UsageError(f"--places_from {job.places_from}: there is no such folder")
    if job.kind == "qualitative":
        if not job.baseline or len(job.sets) != 1:
            raise UsageError("--kind qualitative wants --baseline (one model or more) and one set in --sets")
        need_sets(job)
    check_writable(Path(job.to).parent, "--to")
    import torch

    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    model = _model(job.checkpoint, None, device, job.image_size)
    {"attention": attention, "tsne": places, "qualitative": qualitative}[job.kind](job, model, device)
    print(f"written to {job.to}")


def parameters(job: FiguresJob) -> None:
    """Prints the table; writes markdown where asked."""
    from pipeline.model.variants import VARIANTS
    from pipeline.paper import parameter_table

    table = parameter_table.printed(parameter_table.table(job.variants or VARIANTS))
    print("Parameters in millions")
    table.print()
    if job.to:
        write_atomically(Path(job.to), table.markdown())
        print(f"\nwritten to {job.to}")


def attention(job: FiguresJob, model: Any, device: Any) -> None:
    """Frozen and adapted backbone side by side."""
    from pipeline.evaluation.report.figures import attention_maps
    from pipeline.paper.paper_figures import attention_comparison
    from pipeline.paper.place_features import pretrained

    photos = _photos(job.photos)
    maps = []
    for name in job.baseline:
        maps.append((_short(name), attention_maps(_model(name, model, device, job.image_size), photos)))
    if not maps:
        with pretrained(model):
            maps.append(("pre-trained", attention_maps(model, photos)))
    maps.append(("adapted", attention_maps(model, photos)))
    size = model.input_size
    below = f"Channel mean of the patch tokens, {size.text} px, each map over its own range · {job.checkpoint}"
    attention_comparison(photos, maps, size, Path(job.to), below)


def places(job: FiguresJob, model: Any, device: Any) -> None:
    """t-SNE of places before adaptation, after it, and of the complete model."""
    from pipeline.paper.paper_figures import place_maps
    from pipeline.paper.place_features import choose_places, stages

    chosen = choose_places(Path(job.places_from), job.places, job.images, job.seed)
    baselines = [(_short(name), _model(name, model, device, job.image_size)) for name in job.baseline]
    config = _config(job)
    found = stages(model, baselines, chosen.paths, config, device)
    groups = config.groups[0] + ("" if config.groups[0] == "single" else str(config.group_size))
    below = f"{job.places_from} · {job.checkpoint} · groups {groups} · perplexity {job.perplexity:g}"
    shares = place_maps(found, chosen.labels, Path(job.to), below, job.perplexity)
    for stage, share in zip(found, shares, strict=True):
        print(f"{stage.title:<32} nearest photo of the same place {share:5.1f} %")


def qualitative(job: FiguresJob, model: Any, device: Any) -> None:
    """First answers where the model and a baseline differ."""
    from pipeline.evaluation.evaluate import evaluate
    from pipeline.evaluation.sets.load import load_set
    from pipeline.paper.paper_figures import retrieval_comparison

    config = _config(job)
    evaluated = load_set(job.sets[0], config)
    results = [("ours", evaluate(model, [evaluated], config, device)[0])]
    for name in job.baseline:
        results.append(
            (_short(name), evaluate(_model(name, None, device, job.image_size), [evaluated], config, device)[0])
        )
    found = retrieval_comparison(evaluated, results, Path(job.to), job.count)
    print(f"ours alone right: {len(found.ours)}; {results[1][0]} alone right: {len(found.baseline)}")


def _config(job: FiguresJob) -> EvaluationConfig:
    values = {f.name: getattr(job, f.name) for f in dataclasses.fields(EvaluationConfig)}
    return EvaluationConfig(**values | {"groups": job.groups[:1]})


def _model(source: str, like: Any | None, device: Any, image_size: int | str | None) -> Any:
    """A model; or, where one is given to compare with, released weights in a backbone like its own."""
    from pipeline.model.weights import convert

    kind = convert.kind_of(source)
    if kind != "backbone":
        return convert.read_model(source, kind, ModelConfig(), image_size).to(device)
    if like is None:
        raise UsageError(f"{source}: a backbone alone; make it a model first: jobs.weights --variant FrozenDINOv2-SPM")
    from pipeline.model.variants import variant

    config = variant("FrozenDINOv2-SPM", like.config)
    return convert.around_backbone(source, config, like.image_size).to(device)


def _photos(given: tuple[str, ...], each: int = 6) -> list[Path]:
    found: list[Path] = []
    for name in map(Path, given):
        if name.is_dir():
            inside = sorted(p for p in name.rglob("*") if p.suffix.lower() in (".jpg", ".jpeg", ".png"))
            if not inside:
                raise DataError(f"{name}: no photos in it")
            step = max(1, len(inside) // each)
            found += inside[step // 2 :: step][:each]
        else:
            found.append(name)
    return found


def _short(source: str) -> str:
    """What a baseline is called in a figure: its file's or run folder's name."""
    path = Path(source)
    return path.stem if path.suffix else path.name


if __name__ == "__main__":
    run_job(main)
