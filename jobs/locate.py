"""Where was this photo taken? Answers from an index of your own photos, with or without positions.

    python -m jobs.locate --checkpoint outputs/RUN --build PHOTOS --index my-index
    python -m jobs.locate --checkpoint outputs/RUN --index my-index --photos A.jpg B.jpg

PHOTOS are folders (positions from names, `@UTM_east@UTM_north@`, or from EXIF GPS) or manifests: .csv or .parquet with
`image` and, if known, `lat` and `lon` or `utm_east` and `utm_north`. Building again describes only what is new: the
index then holds exactly the photos that PHOTOS hold now. Both at once build and then ask. Answers are printed and
written to `<index>/answers/`: answers.json, and the photos beside their answers in answers.jpg.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from jobs.cli import parse, run_job
from pipeline.common.errors import UsageError
from pipeline.common.files import check_writable

SHOWN = 12  # photos that ask, in the picture; the text and the JSON have all


@dataclass(frozen=True)
class LocateJob:
    """Build an index of photos, ask it, or both."""

    checkpoint: str = ""
    """A run folder (its best checkpoint), a checkpoint folder, a .safetensors file, or a released .pth."""
    index: str = ""
    """Folder of the index; belongs to the checkpoint that made it."""
    photos: tuple[str, ...] = ()
    """Photos to be located, or folders of them."""
    build: tuple[str, ...] = ()
    """Folders of photos, or manifests, to make the index of; what it has of them already is not described again."""
    answers: int = 5
    """Places shown a photo."""
    output: str | None = None
    """Folder of the answers; none: `<index>/answers`."""
    search: Literal["exact", "ivfpq", "hnsw"] = "exact"
    """Building: exact search, or an approximate one for very many photos."""
    pca: int | None = None
    """Building: dimensions kept by PCA of the index's own photos; none keeps all."""
    resize: Literal["antialias", "published"] = "antialias"
    """Building: antialias as in training; published: normalise, then resize without."""
    precision: Literal["fp32", "bf16", "fp16"] = "fp32"
    """Building: autocast of the per-image part."""
    groups: Literal["auto", "bank", "single"] = "auto"
    """Building: each photo beside the bank of training images that lies beside the weights (docs/one_photo.md), or
    alone; auto: beside the bank where there is one."""
    batch: int | None = None
    """Building: images a forward pass; none: 1 on a CPU, which loses little there and makes an index the same to the
    last bit however it has grown, and 32 on a GPU."""
    workers: int = 4
    """Building: decoding processes."""
    device: str = "auto"
    """auto (a GPU where there is one), cpu, cuda, cuda:1 ..."""
    figures: bool = True
    """Draw answers.jpg."""


def main() -> None:
    """Parses, builds where asked to, answers where asked to."""
    job = parse(LocateJob, __doc__ or "", path_words(sys.argv[1:]))
    for name, example in (("checkpoint", "outputs/cricavpr"), ("index", "my-index")):
        if not getattr(job, name):
            raise UsageError(f"--{name} is missing: for example --{name} {example}")
    if not job.build and not job.photos:
        raise UsageError("nothing to do: give --photos to be located, or --build PHOTOS to make the index")
    if job.answers < 1:
        raise UsageError(f"--answers is {job.answers}; it must be at least 1")
    if job.batch is not None and job.batch < 1:
        raise UsageError(f"--batch is {job.batch}; it must be at least 1")
    run(job)


def path_words(argv: Sequence[str]) -> list[str]:
    """`--photos A.jpg B.jpg` and `--build A B` as one list each for the parser, whatever characters the names hold."""
    words: list[str] = []
    paths: list[str] | None = None
    for word in [*argv, "--"]:
        if word.startswith("--"):
            words += [] if paths is None else [json.dumps(paths)]
            paths = [] if word in ("--photos", "--build") else None
            words.append(word)
        elif paths is None:
            words.append(word)
        else:
            paths.append(word)
    return words[:-1]


def run(job: LocateJob) -> None:
    """The work itself."""
    import torch

    from pipeline.config import EvaluationConfig
    from pipeline.evaluation.identity import model_digest
    from pipeline.locate.answers import locate
    from pipeline.locate.photo_index import make_index, open_index
    from pipeline.model.weights.files import checkpoint_file
    from pipeline.model.weights.load import load_any

    photos = asked(job.photos)
    device = job.device if job.device != "auto" else "cuda" if torch.cuda.is_available() else "cpu"
    file, folder = checkpoint_file(job.checkpoint), Path(job.index)
    if job.build:
        check_writable(folder, "--index")
    if photos and job.output:
        check_writable(Path(job.output), "--output")
    elif photos and folder.is_dir():
        check_writable(folder, "--output")
    model = load_any(file, device)
    fingerprint = model_digest(model)
    if job.build:
        batch = job.batch or (1 if torch.device(device).type == "cpu" else 32)
        groups = job.groups if job.groups != "auto" else "single" if model.bank is None else "bank"
        config = EvaluationConfig(groups=(groups,), resize=job.resize, precision=job.precision, search=job.search,
                                  pca=job.pca, batch=batch, workers=job.workers)  # fmt: skip
        sources, about = [Path(source) for source in job.build], {"checkpoint": str(file)}
        index = make_index(model, sources, folder, config, device, fingerprint, about)
        where = {"none": "without positions", "utm": "with UTM positions", "degrees": "with latitude and longitude"}
        zone = f", zone {index.zone}" if index.zone else ""
        for remark in index.about["remarks"]:
            print(remark)
        print(index.growth)
        size = f"{index.index.d:,} numbers each, {job.search} search, {index.about['bytes'] / 1e6:,.1f} MB"
        print(f"{folder}: {len(index.photos):,} photos {where[index.coordinates]}{zone}, {size}")
    else:
        index = open_index(folder, fingerprint)
    if photos:
        tell(job, index, locate(model, index, photos, job.answers, device))


def asked(given: Sequence[str]) -> list[Path]:
    """The photos of the command line, folders unfolded. Raises `UsageError` for what is not there."""
    from pipeline.evaluation.sets.evaluation_set import list_images

    photos: list[Path] = []
    for path in map(Path, given):
        if not path.exists():
            raise UsageError(f"{path}: no such photo")
        photos += list_images(path) if path.is_dir() else [path]
    return photos


def tell(job: LocateJob, index: object, answers: Sequence[object]) -> None:
    """Prints the answers and writes them down."""
    from pipeline.evaluation.report import figures
    from pipeline.locate.answers import Answer, place_text
    from pipeline.locate.photo_index import PhotoIndex

    assert isinstance(index, PhotoIndex)
    root = index.about["root"]
    print(f"answers are photos below {root}\n")
    rows, pictured = [], []
    for answer in answers:
        assert isinstance(answer, Answer)
        gps = place_text(answer.own, "degrees") or (f"broken GPS: {answer.problem}" if answer.problem else "")
        print(f"{answer.photo}  {gps}".rstrip())
        notes = []
        for rank, (place, far) in enumerate(zip(answer.places, answer.distances, strict=True), 1):
            where = place_text(answer.positions[rank - 1], index.coordinates)
            degrees, metres = place_text(answer.degrees[rank - 1], "degrees"), answer.metres[rank - 1]
            away = "" if metres is None else f"{metres:,.0f} m away"
            shown = place.relative_to(root) if place.is_relative_to(root) else place
            told = "  ".join(filter(None, (where, degrees and f"({degrees})", away)))
            print(f"  {rank:>2}  distance {far:.3f}  {shown}  {told}".rstrip())
            notes.append((place, f"distance {far:.3f}\n{where or away}"))
        rows.append(answer.to_dict(index.coordinates))
        pictured.append((answer.photo, notes))
    output = Path(job.output) if job.output else index.folder / "answers"
    output.mkdir(parents=True, exist_ok=True)
    about = {"index": str(index.folder), "fingerprint": index.about["fingerprint"], "protocol": index.about["protocol"]}
    (output / "answers.json").write_text(json.dumps({**about, "photos": rows}, indent=2) + "\n")
    written = [output / "answers.json"]
    if job.figures:
        protocol = index.protocol
        how = f"each photo beside {protocol.group_size} others" if protocol.groups == "bank" else "each photo alone"
        below = f"{len(index.photos):,} photos in {index.folder.name} · {protocol.search} search · {how}"
        left = f", the first {SHOWN} of {len(pictured)}" if len(pictured) > SHOWN else ""
        figures.answer_grid(pictured[:SHOWN], output / "answers.jpg", f"The most similar places{left}", below)
        written.append(output / "answers.jpg")
    print("\nwritten: " + "  ".join(map(str, written)))


if __name__ == "__main__":
    run_job(main)
