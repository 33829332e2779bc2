"""What a valid shard set is: the columns of its index, the keys of its manifest, and how the two must agree.

Both files come from outside: a download may be damaged, and anybody can edit them and seal them again. Invariant: what
passes `check_manifest` and `check_index` can be used without another look. Shard names are plain file names, so reading
or fetching them stays inside the folder; every round holds every place once; every member lies inside its shard.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
from collections.abc import Iterator
from typing import Any, NoReturn

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from pipeline.common.errors import DataError
from pipeline.common.text import shown

FORMAT_VERSION = 2
WITHOUT_POSITIONS = 1  # the format before it, without `lat` and `lon`: still read
IMAGES_A_SAMPLE = 4
MAX_ROUNDS = 128  # as many files are open at once in each worker that writes
INDEX, MANIFEST, REPORT, UNFINISHED = "index.parquet", "manifest.json", "report.csv", "unfinished"
SCHEMA = pa.schema(
    [
        ("sample", pa.string()),  # "000123": prefix of the sample's members, unique in the set
        ("round", pa.int32()),
        ("city", pa.string()),
        ("place_id", pa.string()),
        ("place", pa.int32()),  # 0..P-1 in the order of (city, place_id); the same in all rounds
        ("shard", pa.string()),  # file name
        ("offsets", pa.list_(pa.int64(), IMAGES_A_SAMPLE)),  # byte position of each JPEG in the shard
        ("sizes", pa.list_(pa.int64(), IMAGES_A_SAMPLE)),  # its length in bytes
        ("json_offset", pa.int64()),
        ("json_size", pa.int64()),
        ("lat", pa.float64()),  # degrees: mean of the place's images, the same in all rounds; null where unknown
        ("lon", pa.float64()),
    ]
)
_OLD_SCHEMA = pa.schema([field for field in SCHEMA if field.name not in ("lat", "lon")])
_TEXTS = ("sample", "city", "place_id", "shard")
HEADER = 512  # bytes of a tar header, which stands before each member
_LONGEST_TEXT = 4096  # of a city's or a place's name
_COUNTS = (
    "places", "places_named", "places_under_four", "places_fallen", "rounds", "samples", "images_named", "images_used",
    "images_bad", "images_unused", "duplicates", "unlisted", "made_again", "shards", "bytes",
)  # fmt: skip


def canonical(value: Any) -> bytes:
    """JSON with sorted keys: equal values give equal bytes."""
    return (json.dumps(value, indent=1, sort_keys=True, ensure_ascii=False) + "\n").encode()


def sha256(data: bytes) -> str:
    """Hex digest."""
    return hashlib.sha256(data).hexdigest()


def sealed_manifest(manifest: dict[str, Any]) -> bytes:
    """The bytes of manifest.json: canonical JSON with the sha256 of all the rest inside."""
    rest = {key: value for key, value in manifest.items() if key != "manifest_sha256"}
    return canonical({**rest, "manifest_sha256": sha256(canonical(rest))})


def is_shard_name(name: object) -> bool:
    """Whether a shard may be called so: letters, digits and `._-` with the ending .tar, no path, no hidden file."""
    return isinstance(name, str) and re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,150}\.tar", name) is not None


def check_manifest(raw: bytes) -> dict[str, Any]:
    """The manifest of its bytes.

    Raises:
        DataError: it is no JSON, was changed, or contradicts itself; the message begins with the file's name.
    """
    try:
        manifest = json.loads(raw.decode(), parse_constant=_no_number)
        sealed = isinstance(manifest, dict) and raw == sealed_manifest(manifest)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{MANIFEST} is not valid JSON: {shown(error)}") from None
    if not sealed:
        raise DataError(f"{MANIFEST} has changed: it does not agree with the sha256 inside it")
    version = manifest.get("format_version")
    if type(version) is not int or version not in (WITHOUT_POSITIONS, FORMAT_VERSION):
        told = f"has format version {shown(version)}, this program reads {FORMAT_VERSION}"
        raise DataError(f"{MANIFEST} {told}: prepare the shards again")
    _need(manifest, {"settings": dict, "counts": dict, "left_out": dict, "shards": list})
    for name in ("index_sha256", "report_sha256"):
        _digest(manifest.get(name), name)
    for name in _COUNTS:
        _whole(manifest["counts"].get(name), f"counts.{name}")
    for reason, number in manifest["left_out"].items():
        _whole(number, f"left_out[{shown(reason)}]")
    before = ""
    for i, shard in enumerate(manifest["shards"]):
        _check_entry(shard, f"shards[{i}]")
        if shard["name"] <= before:
            _wrong(f"shards[{i}].name is {shard['name']}, but shards are to be sorted, each name once")
        before = shard["name"]
    _check_sums(manifest)
    return manifest


def _check_entry(shard: Any, where: str) -> None:
    if not isinstance(shard, dict):
        _wrong(f"{where} is {shown(shard)}, not an object")
    if not is_shard_name(shard.get("name")):
        _wrong(f"{where}.name is '{shown(shard.get('name'))}', not the plain file name of a .tar file")
    _digest(shard.get("sha256"), f"{where}.sha256")
    for name in ("bytes", "samples"):
        _whole(shard.get(name), f"{where}.{name}", least=1)
    if shard["bytes"] < shard["samples"] * (IMAGES_A_SAMPLE + 1) * 2 * HEADER:
        _wrong(f"{where}.bytes is {shard['bytes']:,}, too few for its {shard['samples']:,} samples")


def _check_sums(manifest: dict[str, Any]) -> None:
    counts, shards, left_out = manifest["counts"], manifest["shards"], manifest["left_out"]
    if counts["places"] < 1 or not 1 <= counts["rounds"] <= MAX_ROUNDS:
        _wrong(f"counts {counts['places']:,} places and {counts['rounds']:,} rounds; rounds are 1 to {MAX_ROUNDS}")
    for name, expected, of in (
        ("samples", counts["places"] * counts["rounds"], "places x rounds"),
        ("samples", sum(shard["samples"] for shard in shards), "the sum over the shards"),
        ("bytes", sum(shard["bytes"] for shard in shards), "the sum over the shards"),
        ("shards", len(shards), "the number of shards"),
        ("images_bad", sum(left_out.values()), "the sum of left_out"),
        ("images_named", counts["images_used"] + counts["images_unused"] + counts["images_bad"],
         "images_used + images_unused + images_bad"),
        ("places_named", counts["places"] + counts["places_under_four"] + counts["places_fallen"],
         "places + places_under_four + places_fallen"),
    ):  # fmt: skip
        if counts[name] != expected:
            _wrong(f"counts.{name} is {counts[name]:,}, but {of} is {expected:,}")
    if manifest["settings"].get("rounds") != counts["rounds"]:
        _wrong(f"settings.rounds is {shown(manifest['settings'].get('rounds'))}, counts.rounds {counts['rounds']:,}")


def _need(value: dict[str, Any], kinds: dict[str, type]) -> None:
    for name, kind in kinds.items():
        if not isinstance(value.get(name), kind):
            _wrong(f"{name} is {shown(value.get(name))}, not {'an object' if kind is dict else 'a list'}")


def _digest(value: Any, where: str) -> None:
    if not isinstance(value, str) or not re.fullmatch("[0-9a-f]{64}", value):
        _wrong(f"{where} is '{shown(value)}', not a sha256")


def _whole(value: Any, where: str, least: int = 0) -> None:
    if type(value) is not int or not least <= value < 1 << 62:
        _wrong(f"{where} is {shown(value)}, not a whole number from {least}")


def _no_number(text: str) -> NoReturn:
    raise ValueError(f"{text} is no number")


def _wrong(what: str) -> NoReturn:
    raise DataError(f"{MANIFEST} {what}; fetch the file again or prepare the shards again")


def check_index(raw: bytes, manifest: dict[str, Any]) -> pa.Table:
    """The index table (columns of `SCHEMA`) of the bytes of index.parquet, given a manifest that was checked.

    Raises:
        DataError: it is no such table, or it contradicts itself or the manifest; the message begins with the file's
            name and names row, column and value.
    """
    if sha256(raw) != manifest["index_sha256"]:
        raise DataError(f"{INDEX} has changed: its sha256 is not the manifest's")
    old = manifest["format_version"] == WITHOUT_POSITIONS
    table = _read_parquet(raw, _OLD_SCHEMA if old else SCHEMA, manifest["counts"]["samples"])
    for problem in _problems(table, manifest):
        raise DataError(f"{INDEX} {problem}; fetch the file again or prepare the shards again")
    for name in ("lat", "lon") if old else ():
        table = table.append_column(name, pa.nulls(table.num_rows, pa.float64()))
    return table.cast(SCHEMA).combine_chunks()


def _read_parquet(raw: bytes, schema: pa.Schema, rows: int) -> pa.Table:
    """The table, its texts as dictionaries, so that a small file cannot become a table of any size."""
    try:
        file = pq.ParquetFile(io.BytesIO(raw), read_dictionary=list(_TEXTS))
        found = [(field.name, _value_type(field)) for field in file.schema_arrow]
        if found != [(field.name, field.type) for field in schema]:
            told = ", ".join(f"{shown(name)} ({shown(kind)})" for name, kind in found)
            raise DataError(f"{INDEX} has columns {shown(told, 1000)}, expected {', '.join(schema.names)}")
        if file.metadata.num_rows != rows:
            told = f"has {file.metadata.num_rows:,} rows, the manifest says {rows:,}"
            raise DataError(f"{INDEX} {told}; fetch the file again or prepare the shards again")
        if rows > 1_000_000 + len(raw):  # a real index has several bytes a row
            raise DataError(f"{INDEX} has {rows:,} rows in {len(raw):,} bytes, which no real index has")
        return file.read()
    except (pa.ArrowException, OSError, ValueError, KeyError, TypeError, MemoryError) as error:
        raise DataError(f"{INDEX} cannot be read: {shown(error)}") from None


def _value_type(field: pa.Field) -> pa.DataType:
    dictionary = pa.types.is_dictionary(field.type)
    return field.type.value_type if dictionary else field.type


def _problems(table: pa.Table, manifest: dict[str, Any]) -> Iterator[str]:
    """What is wrong, first things first; a later check may rely on the earlier ones. Work on whole columns."""
    places, rounds = manifest["counts"]["places"], manifest["counts"]["rounds"]
    columns = {name: table[name].combine_chunks() for name in table.schema.names}
    for name, column in columns.items():
        values = column.flatten() if name in ("offsets", "sizes") else column
        if name not in ("lat", "lon") and (column.null_count or values.null_count):
            nulls = column if column.null_count else values
            row = int(np.flatnonzero(nulls.is_null().to_numpy(False))[0])
            yield f"row {row // (len(values) // max(len(column), 1) if nulls is values else 1)}: {name} is null"

    def first(wrong: NDArray[np.bool_], name: str, why: str) -> Iterator[str]:
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            sample = shown(columns["sample"][row].as_py(), 60)
            yield f"row {row} (sample '{sample}'): {name} is {shown(columns[name][row].as_py())}, {why}"

    for name in _TEXTS:
        words = columns[name].dictionary
        lengths = pc.utf8_length(words).to_numpy(False)
        valid = (lengths > 0) & (lengths <= _LONGEST_TEXT)
        if name == "sample":
            valid &= pc.match_substring_regex(words, r"^[0-9]{6,18}$").to_numpy(False)
        if name == "shard":
            valid &= pc.is_in(words, pa.array([s["name"] for s in manifest["shards"]], pa.string())).to_numpy(False)
        why = {"sample": "not a sample's name of 6 to 18 digits", "shard": "which the manifest does not name"}
        codes = columns[name].indices.to_numpy(False)
        yield from first(~valid[codes], name, why.get(name, "an empty or endless name"))

    samples = columns["sample"].cast(pa.string()).cast(pa.int64()).to_numpy(False)
    yield from first(np.diff(samples, prepend=-1) <= 0, "sample", "but samples are to be sorted, each name once")
    each = np.repeat(np.arange(rounds), places)
    round_ = columns["round"].to_numpy(False)
    yield from first(round_ != each, "round", f"but rounds of {places:,} places are to follow each other")
    place = columns["place"].to_numpy(False).astype(np.int64)
    yield from first((place < 0) | (place >= places), "place", f"but there are {places:,} places, from 0")
    yield from first(_repeated(each * places + place), "place", "which an earlier row of the same round has")

    by_place = np.argsort(each * places + place, kind="stable").reshape(rounds, places)  # rows of place p in each round
    for name in ("city", "place_id"):
        codes = columns[name].cast(pa.string()).dictionary_encode().indices.to_numpy(False)
        other = np.zeros(len(codes), np.bool_)
        other[by_place] = codes[by_place] != codes[by_place[0]]
        yield from first(other, name, "not that of the same place in the first round")
    names = table.select(["city", "place_id"]).take(pa.array(by_place[0]))
    names = names.cast(pa.schema([("city", pa.string()), ("place_id", pa.string())]))
    yield from _unordered(names)
    yield from _misplaced(columns, manifest, first)
    if "lat" in columns:
        yield from _off_the_earth(columns, by_place, first)


def _repeated(codes: NDArray[Any]) -> NDArray[np.bool_]:
    """Whether an earlier row has the same value."""
    repeated = np.ones(len(codes), np.bool_)
    repeated[np.unique(codes, return_index=True)[1]] = False
    return repeated


def _unordered(names: pa.Table) -> Iterator[str]:
    """Places are numbered in the order of (city, place_id), each pair once."""
    city, place_id = names["city"].combine_chunks(), names["place_id"].combine_chunks()
    before, after = slice(0, len(city) - 1), slice(1, len(city))
    same = pc.equal(city[before], city[after])
    rising = pc.if_else(same, pc.less(place_id[before], place_id[after]), pc.less(city[before], city[after]))
    wrong = np.flatnonzero(~rising.to_numpy(False))
    if len(wrong):
        n = int(wrong[0]) + 1
        here, former = (f"'{shown(city[i].as_py())}/{shown(place_id[i].as_py())}'" for i in (n, n - 1))
        yield f"numbers place {n} {here} after {former}, but places are numbered by city and place_id, each once"


def _misplaced(columns: dict[str, Any], manifest: dict[str, Any], first: Any) -> Iterator[str]:
    """Members inside their shard, in order, and overlapping no other sample's; samples of each shard as counted."""
    shards = {shard["name"]: shard for shard in manifest["shards"]}
    words = columns["shard"].dictionary.to_pylist()
    codes = columns["shard"].indices.to_numpy(False)
    length = np.array([shards[word]["bytes"] for word in words], np.int64)[codes]
    offsets, sizes = (
        np.concatenate([columns[images].flatten().to_numpy(False).reshape(-1, IMAGES_A_SAMPLE),
                        columns[json_].to_numpy(False)[:, None]], axis=1)
        for images, json_ in (("offsets", "json_offset"), ("sizes", "json_size"))
    )  # fmt: skip
    for n, (offset, size) in enumerate((("offsets", "sizes"), ("json_offset", "json_size"))):
        which = slice(0, IMAGES_A_SAMPLE) if n == 0 else slice(IMAGES_A_SAMPLE, None)
        at, long = offsets[:, which], sizes[:, which]
        yield from first(((long < 1) | (long > length[:, None])).any(1), size, "not between 1 and the shard's bytes")
        outside = (at < HEADER) | (at % HEADER != 0) | (at > length[:, None] - long)
        yield from first(outside.any(1), offset, "which is no member's place in the shard")
    ends = offsets + sizes
    yield from first((offsets[:, 1:] < ends[:, :-1] + HEADER).any(1), "offsets", "members that overlap")
    order = np.lexsort((offsets[:, 0], codes))
    overlap = np.zeros(len(codes), np.bool_)
    follows = codes[order][1:] == codes[order][:-1]
    overlap[order[1:]] = follows & (offsets[order[1:], 0] < ends[order[:-1], -1] + HEADER)
    yield from first(overlap, "offsets", "where another sample of the shard lies")
    counted = dict(zip(words, np.bincount(codes, minlength=len(words)).tolist(), strict=True))
    for name, shard in shards.items():
        if counted.get(name, 0) != shard["samples"]:
            told = f"has {counted.get(name, 0):,} rows of {name}, the manifest says {shard['samples']:,} samples"
            yield told


def _off_the_earth(columns: dict[str, Any], by_place: NDArray[Any], first: Any) -> Iterator[str]:
    lat, lon = (columns[name].to_numpy(False) for name in ("lat", "lon"))
    unknown = [columns[name].is_null().to_numpy(False) for name in ("lat", "lon")]
    for name, values, limit, null in (("lat", lat, 90, unknown[0]), ("lon", lon, 180, unknown[1])):
        yield from first(~null & ~(np.abs(values) <= limit), name, f"not in degrees from -{limit} to {limit}")
        other = np.zeros(len(values), np.bool_)
        filled = np.where(null, np.inf, values)
        other[by_place] = filled[by_place] != filled[by_place[0]]
        yield from first(other, name, "not that of the same place in the first round")
    yield from first(unknown[0] != unknown[1], "lat", "but one of lat and lon alone cannot be null")
