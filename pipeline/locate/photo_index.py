"""A searchable index of a user's own photos that grows: what is new is described, the rest is kept.

Invariant: an index is a function of the photos that its sources hold, the weights and the settings, not of how it came
to be: grown or built at once, it gives the same answers, to the last bit where photos are described one a pass
(`config.batch` 1). It is replaced by one rename: a build that dies leaves the former index answering, and the next
build continues behind it. An index knows its weights and protocol, and is refused beside others.

An index is a folder: `described/`, the descriptors of single photos (`descriptor_cache`); `index-<number>/` with
`index.faiss`,
`photos.parquet` (`photo`, relative to `root` of `about.json` where it is below it, `bytes`, `modified`, and `first`,
`second`, `lat`, `lon`, its coordinates or null), `calibration.json` (`no_match`), and `pca.safetensors` where PCA was
asked for; and `about.json`, which names the number: without it there is no index.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from pipeline.common.errors import DataError, UsageError
from pipeline.common.files import locked, naming, sync_path, write_atomically
from pipeline.config import EvaluationConfig
from pipeline.config.image_size import input_size
from pipeline.evaluation.describe.bank import chosen_bank
from pipeline.evaluation.describe.encode import describe_each, evaluating
from pipeline.evaluation.identity import Identity
from pipeline.evaluation.protocol import Protocol, protocols, read_protocol
from pipeline.evaluation.search.approximate import build_index, load_index, save_index
from pipeline.evaluation.search.projection import (
    Prefix,
    Projection,
    check_prefix,
    fit_rows,
    load_projection,
    projected,
    sample_rows,
)
from pipeline.locate.descriptor_cache import KeptDescriptors
from pipeline.locate.no_match import SAMPLE, Apart, Calibration, calibrate
from pipeline.locate.photos import Photos, find_photos

FORMAT = "place-index 4"  # 4: calibrated; latitude and longitude wherever the zone is known
ABOUT, INDEX, PHOTOS, PCA = "about.json", "index.faiss", "photos.parquet", "pca.safetensors"
CALIBRATION = "calibration.json"
DESCRIBED, LOCK = "described", ".lock"
LARGEST = 65_536  # images of a bank: all that it has


@dataclass(frozen=True)
class Growth:
    """What a build changed, in photos."""

    new: int
    changed: int
    """Same path, other size or time."""
    gone: int
    kept: int
    described: int
    """How many went through the model: not those that an earlier, unfinished build had described."""

    def __str__(self) -> str:
        """One line for people."""
        line = f"{self.new:,} new, {self.changed:,} changed, {self.gone:,} gone, {self.kept:,} kept"
        fresh = self.new + self.changed
        if self.described < fresh:
            return f"{line}; {fresh - self.described:,} had been described by an earlier build"
        if self.described > fresh:
            return f"{line}; {self.described - fresh:,} of these described again: other weights or settings made them"
        return line


@dataclass(frozen=True)
class PhotoIndex:
    """A searchable folder of photos."""

    folder: Path
    index: Any
    """faiss index, answering with rows of `photos`."""
    photos: list[Path]
    positions: np.ndarray | None
    """float64 [n, 2] in `coordinates`, NaN rows where a photo has none; None where no photo has one."""
    degrees: np.ndarray | None
    """Latitude and longitude [n, 2] of UTM positions whose zone is known."""
    coordinates: str
    """utm (east, north in metres), degrees (latitude, longitude), or none."""
    zone: str
    """Zone and hemisphere of UTM positions, "31N"; empty where it is not known."""
    protocol: Protocol
    projection: Projection | Prefix | None
    about: dict[str, Any]
    calibration: Calibration
    """From which distance on a photo is probably not on the map."""
    growth: Growth | None = None
    """What the build did that made it; None for an index that was opened."""


def make_index(
    model: nn.Module,
    sources: Path | Sequence[Path],
    folder: Path,
    config: EvaluationConfig,
    device: torch.device | str,
    fingerprint: str,
    about: dict[str, Any] | None = None,
    progress: bool = True,
    zone: str = "",
    apart: Apart | None = None,
) -> PhotoIndex:
    """Makes the index in `folder` one of exactly the photos of `sources`, describing those it has not described yet.

    Args:
        sources: folders of photos, or manifests (`photos.find_photos`).
        config: its `resize`, `precision`, `search`, `refine`, `prefix`, `pca` and `pca_whiten` make the index, and the
            first of its `groups`: `bank` (the model's own) or `single`; `batch` and `workers` its speed. A `batch`
            above 1 may change the rounding of descriptors.
        fingerprint: identifies the model (`identity.model_digest`).
        about: more to be kept in `about.json`, such as the checkpoint's path.
        zone: "31N", the UTM zone of metres that do not tell theirs.
        apart: which photos are certainly of different places, to calibrate "not on this map"; None: the defaults.

    Raises:
        DataError: no photos, one that does not decode (named), positions that are none.
        UsageError: metres of an unknown zone beside other positions; more PCA dimensions than photos; a folder that
            holds other things, or that another build works in.
    """
    sources = [sources] if isinstance(sources, Path) else list(sources)
    groups: Any = ("bank",) if config.groups[0] == "bank" else ("single",)
    config = dataclasses.replace(
        config, groups=groups, bank_from="train", bank=LARGEST, store="none", pca_from=None, rerank=0, recalls=(1,)
    )
    bank = chosen_bank(model, config, (), device)
    protocol = protocols(config, input_size(model).setting, "none", bank)[0]
    check_prefix(protocol.prefix, int(model.descriptor_dim))  # type: ignore[arg-type]
    apart = apart or Apart()
    photos = find_photos(sources, progress, zone)
    with _building(folder):
        former = _former(folder)
        # of each photo by itself: `kept` compares the files one by one
        each_alone = Identity("photo", fingerprint, "", protocol.grouping)
        kept = KeptDescriptors(folder / DESCRIBED, {"identity": each_alone.digest})
        found = kept.find(photos.files, photos.states)
        missing = [at for at in range(len(photos.files)) if at not in found]
        growth = _growth(former, photos, len(missing))
        if missing:
            paths, rows = [photos.files[at] for at in missing], np.array(missing, np.int64)
            with evaluating(model):
                memory = None if bank is None else model.remember(bank)  # type: ignore[operator]
                each = describe_each(model, paths, config, torch.device(device), "describing", progress, memory)
                kept.keep(photos.files, photos.states, ((rows[positions], values) for positions, values in each))
            found = kept.find(photos.files, photos.states)
        contents = _contents(photos, protocol, fingerprint, apart)
        place = _place(folder, former[0]) if former else folder
        if not former or former[0].get("contents") != contents or not (place / INDEX).is_file():
            number = 1 + max((int(f.name[6:]) for f in folder.glob("index-*") if f.name[6:].isdigit()), default=-1)
            place = folder / f"index-{number:06d}"
            place.mkdir()
            blocks = kept.blocks([found[at] for at in range(len(photos.files))])
            if protocol.pca:
                sample = sample_rows(len(photos.files))
                name = f"{', '.join(map(str, sources))}, {len(sample)} of {len(photos.files)} photos"
                projection = fit_rows(blocks, sample, protocol.pca, protocol.whiten, name, device)
                projection.save(place / PCA)
                blocks = projected(blocks, projection)
            elif protocol.prefix:
                blocks = projected(blocks, Prefix(protocol.prefix))
            built = build_index(blocks, config.search, protocol.refine > 0)
            save_index(built, place / INDEX)
            asked = sample_rows(len(photos.files), SAMPLE)
            taken = np.concatenate([block[np.isin(rows, asked)] for rows, block in blocks()])
            calibration = calibrate(built, photos, asked, taken, apart)
            near = {"how": calibration.how, "elsewhere": calibration.elsewhere.tolist()}
            write_atomically(place / CALIBRATION, json.dumps(near) + "\n")
            _write_photos(photos, place / PHOTOS)
            for file in [*place.iterdir(), place]:
                sync_path(file)
            whole = {
                "format": FORMAT,
                "number": number,
                "fingerprint": fingerprint,
                "sources": [str(source.absolute()) for source in sources],
                "root": str(photos.root),
                "photos": len(photos.files),
                "coordinates": photos.coordinates,
                "zone": photos.zone,
                "given_zone": zone,
                "protocol": protocol.to_dict(),
                "bytes": (place / INDEX).stat().st_size,
                "contents": contents,
                "remarks": list(photos.remarks),
                **(about or {}),
            }
            write_atomically(folder / ABOUT, json.dumps(whole, indent=2) + "\n")  # from here on it answers
        _clean(folder, place)
        kept.tidy(photos.files, photos.states, found)
    return dataclasses.replace(open_index(folder, fingerprint), growth=growth)


def open_index(folder: Path, fingerprint: str) -> PhotoIndex:
    """Reads the index of a folder.

    Raises:
        DataError: there is none, or not all of it.
        UsageError: it was made with other weights than those of `fingerprint`.
    """
    if not (folder / ABOUT).is_file():
        raise DataError(f"{folder}: no finished index there; make one with --build PHOTOS --index {folder}")
    before = (folder / ABOUT).read_bytes()
    try:
        return _open(folder, fingerprint)
    except DataError:
        if (folder / ABOUT).read_bytes() == before:
            raise
        return _open(folder, fingerprint)  # a build has replaced it in between


def _open(folder: Path, fingerprint: str) -> PhotoIndex:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        about = json.loads((folder / ABOUT).read_text())
        if about["format"] != FORMAT:
            raise DataError(f"{folder}: an index of format '{about['format']}', this is '{FORMAT}'; build it again")
        if about["fingerprint"] != fingerprint:
            made = f"{about['fingerprint']}{' of ' + about['checkpoint'] if 'checkpoint' in about else ''}"
            raise UsageError(
                f"{folder}: made with other weights ({made}) than this checkpoint's ({fingerprint}), their descriptors "
                "cannot be compared; give that checkpoint, or build the index again"
            )
        place = _place(folder, about)
        table = pq.read_table(place / PHOTOS)
        root, protocol = Path(about["root"]), read_protocol(about["protocol"], str(folder))
        photos = [root / name for name in table["photo"].to_pylist()]
        near = json.loads((place / CALIBRATION).read_text())
        calibration = Calibration(np.array(near["elsewhere"], np.float64), str(near["how"]))
        pairs = [
            np.stack([table[name].to_numpy() for name in names], axis=1)
            for names in (("first", "second"), ("lat", "lon"))
        ]
    except (OSError, ValueError, KeyError, TypeError, pa.ArrowInvalid) as error:
        raise DataError(f"{folder}: not a readable index ({error}); build it again") from None
    positions, degrees = (None if np.isnan(pair).all() else pair for pair in pairs)
    index = load_index(place / INDEX)
    if not len(photos) == about["photos"] == index.ntotal:
        raise DataError(f"{folder}: {index.ntotal} descriptors of {len(photos)} photos; build it again")
    projection: Projection | Prefix | None = Prefix(protocol.prefix) if protocol.prefix else None
    if protocol.pca:
        projection = load_projection(place / PCA)
    coordinates, zone = about["coordinates"], about["zone"]
    return PhotoIndex(
        folder, index, photos, positions, degrees, coordinates, zone, protocol, projection, about, calibration
    )


@contextlib.contextmanager
def _building(folder: Path) -> Iterator[None]:
    """Holds the folder for one build; refuses a folder that holds other things than an index."""
    ours = {DESCRIBED, LOCK, ABOUT + ".tmp", "index-*"}
    if folder.is_dir() and not (folder / ABOUT).is_file() and any(
        not any(entry.match(name) for name in ours) for entry in folder.iterdir()
    ):  # fmt: skip
        raise UsageError(f"{folder}: holds other things than an index; give an empty or a new folder")
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder / LOCK, f"{folder}: another build works in it; wait for that, or give another folder"):
        yield


def _former(folder: Path) -> tuple[dict[str, Any], dict[Path, tuple[int, int]]] | None:
    """(`about.json`, path -> (bytes, time) of its photos) of the index there; None where there is none to be read."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    if not (folder / ABOUT).is_file():
        return None
    try:
        about = json.loads((folder / ABOUT).read_text())
        ours = str(about["format"]).startswith("place-index")
    except (OSError, ValueError, KeyError, TypeError):
        ours = False
    if not ours:
        raise UsageError(f"{folder}: its {ABOUT} is not that of an index; give an empty or a new folder")
    try:
        table = pq.read_table(_place(folder, about) / PHOTOS).to_pydict()
        states = zip(table["bytes"], table["modified"], strict=True)
        return about, {Path(about["root"]) / name: state for name, state in zip(table["photo"], states, strict=True)}
    except (OSError, ValueError, KeyError, TypeError, pa.ArrowInvalid):
        return None  # of an older format, or damaged: it is built anew


def _growth(
    former: tuple[dict[str, Any], dict[Path, tuple[int, int]]] | None, photos: Photos, described: int
) -> Growth:
    old = former[1] if former else {}
    states = dict(zip(photos.files, map(tuple, photos.states.tolist()), strict=True))
    both = old.keys() & states.keys()
    kept = sum(old[photo] == states[photo] for photo in both)
    return Growth(len(states) - len(both), len(both) - kept, len(old) - len(both), kept, described)


def _contents(photos: Photos, protocol: Protocol, fingerprint: str, apart: Apart) -> str:
    """Digest of the identity of all that the index is made of."""
    seen = hashlib.sha256(json.dumps([FORMAT, photos.zone, photos.coordinates, apart.metres, apart.frames]).encode())
    for array in (photos.positions, photos.degrees):
        seen.update(b"|" if array is None else np.ascontiguousarray(array).tobytes())
    files = hashlib.sha256("\n".join(map(str, photos.files)).encode("utf-8", "surrogateescape"))
    files.update(np.ascontiguousarray(photos.states).tobytes())
    return Identity("photos", fingerprint, files.hexdigest()[:16], protocol, seen.hexdigest()[:16]).digest


def _write_photos(photos: Photos, file: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    names = [str(p.relative_to(photos.root) if p.is_relative_to(photos.root) else p) for p in photos.files]
    table = {"photo": names, "bytes": photos.states[:, 0], "modified": photos.states[:, 1]}
    empty = np.full((len(names), 2), np.nan)
    for (first, second), pair in ((("first", "second"), photos.positions), (("lat", "lon"), photos.degrees)):
        values = empty if pair is None else pair
        table[first], table[second] = (pa.array(values[:, i], from_pandas=True) for i in (0, 1))  # NaN is null
    with naming(file):
        pq.write_table(pa.table(table), file)


def _place(folder: Path, about: dict[str, Any]) -> Path:
    return folder / f"index-{int(about['number']):06d}"


def _clean(folder: Path, place: Path) -> None:
    """Removes former indexes, what killed builds left, and the files of the first format."""
    for left in folder.glob("index-*"):
        if left != place:
            shutil.rmtree(left)
    for name in (INDEX, PHOTOS, PCA):
        (folder / name).unlink(missing_ok=True)
