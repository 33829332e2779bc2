"""Where was this photo taken? Answers from an index of your own photos, with or without positions.

    python -m jobs.locate --checkpoint outputs/RUN --build PHOTOS --index my-index
    python -m jobs.locate --checkpoint outputs/RUN --index my-index --photos A.jpg trip/ "b/*.jpg" drive.mp4
    python -m jobs.locate --checkpoint outputs/RUN --index my-index --serve

PHOTOS are folders (positions from names, `@UTM_east@UTM_north@`, or from EXIF GPS) or manifests: .csv or .parquet with
`image` and, if known, `lat` and `lon` or `utm_east` and `utm_north`. Building again describes only what is new: the
index then holds exactly the photos that PHOTOS hold now. Both at once build and then ask. Answers are printed and
written to `<index>/answers/`: answers.json, and the photos beside their answers in answers.jpg.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from jobs.cli import parse, run_job
from jobs.there import need_model
from pipeline.common.errors import DataError, UsageError
from pipeline.common.files import check_writable, write_atomically
from pipeline.config import SearchKind
from pipeline.config.setting import setting

if TYPE_CHECKING:
    from pipeline.locate.answers import Answer, Locator
    from pipeline.locate.no_match import Calibration
    from pipeline.locate.photo_index import PhotoIndex

SHOWN = 12  # photos that ask, in the picture; the text and the JSON have all


@dataclass(frozen=True)
class LocateJob:
    """Build an index of photos, ask it, or both."""

    checkpoint: str = ""
    """A run folder (its best checkpoint), a checkpoint folder, a .safetensors file, or a released .pth."""
    index: str = ""
    """Folder of the index; belongs to the checkpoint that made it."""
    photos: tuple[str, ...] = ()
    """Photos to be located, folders of them, patterns in quotes ("trip/*.jpg"), or videos (PyAV)."""
    every: float = 1.0
    """Seconds from frame to frame of a video."""
    build: tuple[str, ...] = ()
    """Folders of photos, or manifests, to make the index of; what it has of them already is not described again."""
    answers: int = 5
    """Places shown a photo."""
    output: str | None = None
    """Folder of the answers; none: `<index>/answers`."""
    to: tuple[str, ...] = ()
    """More files of the answers, by their ending: .geojson, .csv, .kml, or .txt (lines `query db`, pairs for hloc)."""
    radius: float = 25.0
    """Metres within which an answer is right, where a photo tells where it was taken."""
    zone: str = ""
    """Building: UTM zone, such as 31N, of metres that do not tell theirs."""
    apart: float = 100.0
    """Building: photos farther apart than so many metres are of different places ("not on this map" is calibrated on
    them)."""
    apart_frames: int | None = None
    """Building, where no position is known: photos of one folder with more than so many between them are of different
    places; none: not known, and no confidence is told."""
    search: SearchKind = "exact"
    """Building: exact search, of codes of a byte (int8) or a bit (binary) a dimension, or approximate for very many
    photos."""
    refine: int = 0
    """Building: int8, binary, ivfpq: float descriptors, read from the disk, put so many first candidates in order
    anew; 0: none."""
    prefix: int | None = None
    """Building: dimensions kept from the beginning of the descriptor (of a model trained with loss.prefixes)."""
    pca: int | None = None
    """Building: dimensions kept by PCA of the index's own photos; none keeps all."""
    image_size: str | int | None = setting(None, changes="numbers", image_size="any")
    """Building: what photos are brought to, as in jobs.evaluate; none: what the checkpoint says. Photos that ask are
    brought to what the index was made with."""
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
    serve: bool = False
    """Answer on a local page (http://127.0.0.1:PORT, from this machine alone) until Ctrl-C."""
    port: int = 8765
    """Of the page; 0 takes a free one."""


def main() -> None:
    """Parses, builds where asked to, answers where asked to."""
    job = parse(LocateJob, __doc__ or "", path_words(sys.argv[1:]))
    for name, example in (("checkpoint", "outputs/cricavpr"), ("index", "my-index")):
        if not getattr(job, name):
            raise UsageError(f"--{name} is missing: for example --{name} {example}")
    if not job.build and not job.photos and not job.serve:
        raise UsageError(
            "nothing to do: give --photos to be located, --serve for a local page, or --build PHOTOS to make the index"
        )
    if not 0 <= job.port < 65536:
        raise UsageError(f"--port is {job.port}; it must be 0 to 65535")
    if job.answers < 1:
        raise UsageError(f"--answers is {job.answers}; it must be at least 1")
    if job.batch is not None and job.batch < 1:
        raise UsageError(f"--batch is {job.batch}; it must be at least 1")
    for name in ("every", "radius", "apart"):
        if not 0 < getattr(job, name) < math.inf:
            raise UsageError(f"--{name} is {getattr(job, name)}; it must be above 0")
    if job.apart_frames is not None and job.apart_frames < 0:
        raise UsageError(f"--apart_frames is {job.apart_frames}; it must be at least 0")
    need_model(job.checkpoint)
    for path in (*job.photos, *job.build):
        if not Path(path).exists() and not set(path) & set("*?["):
            raise UsageError(f"{path}: no such photo or folder")
    if not job.build and not Path(job.index).is_dir():
        raise DataError(f"{job.index}: no finished index there; make one with --build PHOTOS")
    run(job)


def path_words(argv: Sequence[str]) -> list[str]:
    """`--photos A.jpg B.jpg`, `--build A B` and `--to F G` as one list each for the parser, whatever the names hold."""
    words: list[str] = []
    paths: list[str] | None = None
    for word in [*argv, "--"]:
        if word.startswith("--"):
            words += [] if paths is None else [json.dumps(paths)]
            paths = [] if word in ("--photos", "--build", "--to") else None
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
    from pipeline.locate.answers import Locator, locate
    from pipeline.locate.asked import asked_photos
    from pipeline.locate.exports import check_format
    from pipeline.locate.no_match import Apart
    from pipeline.locate.photo_index import make_index, open_index
    from pipeline.locate.photos import check_zone
    from pipeline.model.weights.files import at_size, checkpoint_file
    from pipeline.model.weights.load import load_any

    check_zone(job.zone)
    for path in map(Path, job.to):
        check_format(path)
        check_writable(path.absolute().parent, "--to")
    file, folder = checkpoint_file(job.checkpoint), Path(job.index)
    photos = asked_photos(job.photos, output_of(job) / "frames", job.every)
    device = job.device if job.device != "auto" else "cuda" if torch.cuda.is_available() else "cpu"
    if job.build:
        check_writable(folder, "--index")
    if photos and job.output:
        check_writable(Path(job.output), "--output")
    elif photos and folder.is_dir():
        check_writable(folder, "--output")
    model = load_any(file, device, job.image_size)
    fingerprint = model_digest(model)
    if job.build:
        batch = job.batch or (1 if torch.device(device).type == "cpu" else 32)
        groups = job.groups if job.groups != "auto" else "single" if model.bank is None else "bank"
        config = EvaluationConfig(groups=(groups,), resize=job.resize, precision=job.precision, search=job.search,
                                  refine=job.refine, prefix=job.prefix,
                                  pca=job.pca, batch=batch, workers=job.workers)  # fmt: skip
        sources, about = [Path(source) for source in job.build], {"checkpoint": str(file)}
        apart = Apart(job.apart, job.apart_frames)
        index = make_index(model, sources, folder, config, device, fingerprint, about, zone=job.zone, apart=apart)
        where = {"none": "without positions", "utm": "with UTM positions", "degrees": "with latitude and longitude"}
        zone = f", zone {index.zone}" if index.zone else ""
        for remark in index.about["remarks"]:
            print(remark)
        print(index.growth)
        size = f"{index.index.d:,} numbers each, {job.search} search, {index.about['bytes'] / 1e6:,.1f} MB"
        print(f"{folder}: {len(index.photos):,} photos {where[index.coordinates]}{zone}, {size}")
        print(no_match_text(index.calibration))
    else:
        index = open_index(folder, fingerprint)
        if job.image_size not in (None, index.protocol.image_size):
            raise UsageError(
                f"--image_size {job.image_size}: {folder} was made with {index.protocol.image_size}; leave it out, or "
                "build the index again"
            )
        model = at_size(model, index.protocol.image_size)
    if photos:
        tell(job, index, locate(model, index, photos, job.answers, device, radius=job.radius))
    if job.serve:
        serve(Locator(model, index, device, job.radius), job)


def serve(locator: Locator, job: LocateJob) -> None:
    """Answers on a local page until Ctrl-C."""
    from pipeline.locate.server import listen

    server = listen(locator, job.answers, job.port)
    print(f"http://127.0.0.1:{server.server_port} answers, from this machine alone; Ctrl-C ends it", flush=True)
    server.serve_forever()  # Werkzeug takes Ctrl-C as the end that it is here, and closes: exit code 0


def output_of(job: LocateJob) -> Path:
    """Folder of the answers."""
    return Path(job.output) if job.output else Path(job.index) / "answers"


def no_match_text(calibration: Calibration) -> str:
    """The index's threshold in a line for people."""
    if calibration.threshold is None:
        return f"no confidence is told, and nothing is called 'not on this map': {calibration.how}"
    return f"probably not on this map: from distance {calibration.threshold:.3f} on (by {calibration.how})"


def tell(job: LocateJob, index: PhotoIndex, answers: Sequence[Answer]) -> None:
    """Prints the answers and writes them down."""
    from pipeline.evaluation.report import figures
    from pipeline.locate.exports import NO_MATCH, export, label, table

    print(f"answers are photos below {index.about['root']}\n")
    table(answers, index).print()
    known = [answer.found[0].right for answer in answers if answer.found and answer.found[0].right is not None]
    if known:
        print(
            f"\n* within {job.radius:g} m of the photo's own position; {sum(known)} of {len(known)} first answers are"
        )
    output = output_of(job)
    about = {"index": str(index.folder), "fingerprint": index.about["fingerprint"], "protocol": index.about["protocol"],
             "utm_zone": index.zone, "no_match_from": index.calibration.threshold}  # fmt: skip
    rows = [answer.to_dict() for answer in answers]
    write_atomically(output / "answers.json", json.dumps({**about, "photos": rows}, indent=2) + "\n")
    written = [output / "answers.json"]
    for path in map(Path, job.to):
        export(answers, index, path)
        written.append(path)
    if job.figures:
        protocol, few = index.protocol, answers[:SHOWN]
        how = f"each photo beside {protocol.group_size} others" if protocol.groups == "bank" else "each photo alone"
        below = f"{len(index.photos):,} photos in {index.folder.name} · {protocol.search} search · {how}"
        off = sum(answer.matched is False for answer in few)
        below += f" · {off} {NO_MATCH}" if off else ""
        left = f", the first {SHOWN} of {len(answers)}" if len(answers) > SHOWN else ""
        pictured = [(answer.photo, [(found.place, label(found)) for found in answer.found]) for answer in few]
        right = [[found.right for found in answer.found] for answer in few]
        figures.answer_grid(pictured, output / "answers.jpg", f"The most similar places{left}", below, right)
        written.append(output / "answers.jpg")
    print("\nwritten: " + "  ".join(map(str, written)))


if __name__ == "__main__":
    run_job(main)
