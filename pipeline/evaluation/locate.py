"""Where was this photo taken: an index of a user's own photos, and the places that look most like new ones.

Invariant: every descriptor is of one image alone (`single`), and photos that ask are described and searched one by one,
so that an answer never depends on which other photos were asked about, to the last bit. An index knows the weights and
the protocol it was made under, and is refused beside others.

An index is a folder: `index.faiss`; `photos.parquet` with `photo` (relative to `root` of `about.json` where it is below
it), `first` and `second` (its coordinates or null); `pca.safetensors` where PCA was asked for; and, written last,
`about.json`: without it there is no index.
"""

from __future__ import annotations

import dataclasses
import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from pipeline.config import EvaluationConfig
from pipeline.evaluation.descriptors import describe_alone, evaluating
from pipeline.evaluation.engine import Engine
from pipeline.evaluation.evaluation_set import EvaluationSet, list_images
from pipeline.evaluation.manifest import SUFFIXES, read_photos
from pipeline.evaluation.projection import Projection, fit_rows, load_projection, projected, sample_rows
from pipeline.evaluation.protocol import Protocol, protocols
from pipeline.evaluation.retrieval import Blocks, build_index, index_bytes, load_index, save_index, search_index
from pipeline.evaluation.utm import file_positions
from shards.errors import DataError, UsageError
from shards.progress import track

FORMAT = "place-index 1"
ABOUT, INDEX, PHOTOS, PCA = "about.json", "index.faiss", "photos.parquet", "pca.safetensors"


@dataclass(frozen=True)
class PhotoIndex:
    """A searchable folder of photos."""

    folder: Path
    index: Any
    """faiss index, answering with rows of `photos`."""
    photos: list[Path]
    positions: np.ndarray | None
    """float64 [n, 2] in `coordinates`; None where the photos have no positions."""
    coordinates: str
    """utm (east, north in metres), degrees (latitude, longitude), or none."""
    protocol: Protocol
    projection: Projection | None
    about: dict[str, Any]


@dataclass(frozen=True)
class Answer:
    """The photos of an index that look most like one photo, best first."""

    photo: Path
    rows: list[int]
    places: list[Path]
    distances: list[float]
    """L2 between descriptors of unit length: 0 the same, 1.41 nothing in common."""
    positions: list[tuple[float, float] | None]

    def to_dict(self, coordinates: str) -> dict[str, Any]:
        """Plain values, coordinates under their names."""
        names = {"utm": ("utm_east", "utm_north"), "degrees": ("lat", "lon")}.get(coordinates)
        found = []
        for place, distance, position in zip(self.places, self.distances, self.positions, strict=True):
            where = dict(zip(names, position, strict=True)) if names and position is not None else {}
            found.append({"place": str(place), "distance": distance, **where})
        return {"photo": str(self.photo), "answers": found}


def photos_with_positions(source: Path) -> tuple[list[Path], np.ndarray | None, str]:
    """The photos below a folder, or of a manifest (.csv, .parquet), with their positions [n, 2] and coordinates.

    A folder has UTM positions where the names carry them (`@UTM_east@UTM_north@...`), in all or in none. A manifest has
    the column `image`, and `lat` and `lon`, or `utm_east` and `utm_north`, or no position; where it has `role`, its
    database rows count.

    Raises:
        DataError: nothing there, or positions that are none.
    """
    if source.suffix.lower() in SUFFIXES:
        return read_photos(source)
    if not source.is_dir():
        raise DataError(f"{source}: no such folder of photos, and no .csv or .parquet manifest")
    photos = list_images(source)
    positions = file_positions(photos)
    return photos, positions, "none" if positions is None else "utm"


def make_index(
    model: nn.Module,
    source: Path,
    folder: Path,
    config: EvaluationConfig,
    device: torch.device | str,
    fingerprint: str,
    about: dict[str, Any] | None = None,
    progress: bool = True,
) -> PhotoIndex:
    """Describes the photos of `source` one by one and writes an index of them to `folder`, replacing the one there.

    Args:
        config: its `resize`, `precision`, `search`, `pca` and `pca_whiten` make the index; `batch` and `workers` its
            speed.
        fingerprint: identifies the weights (`evaluate.model_fingerprint`).
        about: more to be kept in `about.json`, such as the checkpoint's path.

    Raises:
        DataError: no photos, one that does not decode (named), positions in some names only.
        UsageError: more PCA dimensions than photos; a folder that holds other things.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    photos, positions, coordinates = photos_with_positions(source)
    if folder.is_dir() and any(folder.iterdir()) and not (folder / INDEX).is_file():
        raise UsageError(f"{folder}: holds other things than an index; give an empty or a new folder")
    device = torch.device(device)
    config = dataclasses.replace(config, groups=("single",), store="none", pca_from=None)
    nothing = [np.zeros(0, np.int64)]
    photo_set = EvaluationSet("photo", photos, photos[:1], nothing, "", has_ground_truth=False)
    protocol = protocols(config, int(model.image_size), "none")[0]  # type: ignore[arg-type]
    projection: Projection | None = None
    with evaluating(model), tempfile.TemporaryDirectory() as temporary:
        engine = Engine(model, config, device, None, Path(temporary), progress, "")
        side = engine.side(photo_set, "database", [protocol])
        blocks: Blocks | None = side.describe(protocol)
        side.close()
        assert blocks is not None  # one process
        if protocol.pca:
            rows = sample_rows(len(photos))
            name = f"{source}, {len(rows)} of {len(photos)} photos"
            projection = fit_rows(blocks, rows, protocol.pca, protocol.whiten, name, device)
            blocks = projected(blocks, projection)
        index = build_index(blocks, config.search)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / ABOUT).unlink(missing_ok=True)  # from here on, and until it is written again, there is no index
    save_index(index, folder / INDEX)
    (folder / PCA).unlink(missing_ok=True)
    if projection is not None:
        projection.save(folder / PCA)
    root = (source.parent if source.suffix.lower() in SUFFIXES else source).absolute()
    absolute = [photo.absolute() for photo in photos]
    names = [str(p.relative_to(root) if p.is_relative_to(root) else p) for p in absolute]
    first, second = (None, None) if positions is None else (positions[:, 0], positions[:, 1])
    empty = pa.nulls(len(photos), pa.float64())
    table = {"photo": names, "first": empty if first is None else first, "second": empty if second is None else second}
    pq.write_table(pa.table(table), folder / PHOTOS)
    whole = {
        "format": FORMAT,
        "fingerprint": fingerprint,
        "root": str(root),
        "photos": len(photos),
        "coordinates": coordinates,
        "protocol": protocol.to_dict(),
        "bytes": index_bytes(index),
        **(about or {}),
    }
    fresh = folder / (ABOUT + ".tmp")
    fresh.write_text(json.dumps(whole, indent=2) + "\n")
    fresh.replace(folder / ABOUT)
    return open_index(folder, fingerprint)


def open_index(folder: Path, fingerprint: str) -> PhotoIndex:
    """Reads the index of a folder.

    Raises:
        DataError: there is none, or not all of it.
        UsageError: it was made with other weights than those of `fingerprint`.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    if not (folder / ABOUT).is_file():
        raise DataError(f"{folder}: no finished index there; make one with --build PHOTOS --index {folder}")
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
        table = pq.read_table(folder / PHOTOS)
        root, protocol = Path(about["root"]), Protocol(**about["protocol"])
        photos = [root / name for name in table["photo"].to_pylist()]
    except (OSError, ValueError, KeyError, TypeError, pa.ArrowInvalid) as error:
        raise DataError(f"{folder}: not a readable index ({error}); build it again") from None
    positions = None
    if about["coordinates"] != "none":
        positions = np.stack([table["first"].to_numpy(), table["second"].to_numpy()], axis=1)
    index = load_index(folder / INDEX)
    if not len(photos) == about["photos"] == index.ntotal:
        raise DataError(f"{folder}: {index.ntotal} descriptors of {len(photos)} photos; build it again")
    projection = load_projection(folder / PCA) if protocol.pca else None
    return PhotoIndex(folder, index, photos, positions, about["coordinates"], protocol, projection, about)


def locate(
    model: nn.Module,
    index: PhotoIndex,
    photos: Sequence[Path],
    count: int,
    device: torch.device | str,
    progress: bool = True,
) -> list[Answer]:
    """The `count` most similar photos of an index (fewer where it holds fewer) for each of `photos`.

    Raises:
        DataError: a photo that does not decode (named), or whose descriptor is not finite.
    """
    device, protocol = torch.device(device), index.protocol
    answers = []
    with evaluating(model):
        for photo in track(photos, "locating", unit="photos") if progress else photos:
            described = describe_alone(model, photo, protocol.resize, protocol.precision, device)
            if not np.isfinite(described).all():
                raise DataError(f"{photo}: its descriptor is not finite: the model has diverged; take another one")
            if index.projection is not None:
                described = index.projection(described)
            squared, rows = search_index(index.index, described, min(count, len(index.photos)))
            kept = rows[0] >= 0  # an approximate search may find fewer
            found = [int(row) for row in rows[0][kept]]
            where = [None if index.positions is None else tuple(map(float, index.positions[row])) for row in found]
            distances = [float(d) for d in np.sqrt(np.maximum(squared[0][kept], 0))]
            answers.append(Answer(photo, found, [index.photos[row] for row in found], distances, where))  # type: ignore[arg-type]
    return answers


def place_text(position: tuple[float, float] | None, coordinates: str) -> str:
    """A position for people; empty where it is not known."""
    if position is None:
        return ""
    if coordinates == "degrees":
        return f"{position[0]:.6f}, {position[1]:.6f}"  # as map services take it
    return f"{position[0]:.1f} E  {position[1]:.1f} N"
