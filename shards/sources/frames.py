"""CSV tables that come with a data set, as text, and their columns as numbers within a range.

Invariant: what cannot be read is one line that names file, row, column and value. Rows are counted from 1, without the
header.
"""

from __future__ import annotations

import gzip
import io
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from pyarrow import csv

from pipeline.common.errors import DataError
from pipeline.common.files import open_ordinary
from pipeline.common.text import shown

MAX_BYTES = 1 << 30  # of a table, unpacked; the largest of GSV-Cities has 5 MB
_SEPARATORS = (",", ";", "\t")
_BOM = b"\xef\xbb\xbf"


def read_frame(path: Path, columns: Sequence[str]) -> pa.Table:
    """The wanted columns of a .csv or .csv.gz file as trimmed text, whatever else it holds.

    The separator is the one of `,`, `;` and tab with which the header names all columns. A byte order mark, Windows
    line ends and quotes are understood.

    Raises:
        DataError: it is no such table; names what is missing or the row that is wrong.
    """
    data = _content(path)
    separator, names = _header(data, path, columns)
    block = min(max(len(data), 1 << 16), 1 << 24)  # a row must fit into a block
    convert = csv.ConvertOptions(
        column_types=dict.fromkeys(columns, pa.string()), include_columns=list(columns), strings_can_be_null=False
    )
    try:
        rows = csv.read_csv(
            io.BytesIO(data),
            csv.ReadOptions(block_size=block, skip_rows=1, column_names=names),
            csv.ParseOptions(delimiter=separator),
            convert,
        )
    except (pa.ArrowException, OSError, ValueError, KeyError) as error:
        raise DataError(f"{shown(path)}: not a readable CSV file: {shown(error)}") from None
    return pa.table({name: pc.utf8_trim_whitespace(rows[name]) for name in columns})


def numbers(table: pa.Table, name: str, path: Path, least: float, most: float) -> NDArray[np.float64]:
    """A text column as finite numbers within a range, float64 [rows].

    Raises:
        DataError: names file, row, column and value.
    """
    column = table[name].combine_chunks()
    try:
        values = column.cast(pa.float64()).to_numpy(zero_copy_only=False)
        wrong = np.flatnonzero(~((values >= least) & (values <= most)))
    except pa.ArrowInvalid:  # says which value, but not where
        wrong = np.array([next(i for i, text in enumerate(column.to_pylist()) if not _is_number(text))])
    if len(wrong):
        value = shown(column[int(wrong[0])].as_py(), 60)
        told = f"row {int(wrong[0]) + 1}: {name} is '{value}', not a number from {least:,.10g} to {most:,.10g}"
        raise DataError(f"{shown(path)}: {told}; correct or remove the row")
    return np.asarray(values, np.float64)


def whole_numbers(table: pa.Table, name: str, path: Path, least: int, most: int) -> NDArray[np.int64]:
    """A text column as whole numbers within a range, int64 [rows]; "2015.0" passes too. Raises as `numbers`."""
    values = numbers(table, name, path, least, most)
    wrong = np.flatnonzero(values != np.floor(values))
    if len(wrong):
        value = shown(table[name][int(wrong[0])].as_py(), 60)
        told = f"row {int(wrong[0]) + 1}: {name} is '{value}', not a whole number"
        raise DataError(f"{shown(path)}: {told}; correct or remove the row")
    return values.astype(np.int64)


def _is_number(text: str) -> bool:
    try:
        pa.array([text]).cast(pa.float64())
    except pa.ArrowInvalid:
        return False
    return True


def _content(path: Path) -> bytes:
    """The unpacked bytes of a table, bounded before it is read."""
    try:
        with open_ordinary(path) as stream:
            packed = path.name.lower().endswith(".gz")
            data = gzip.GzipFile(fileobj=stream).read(MAX_BYTES + 1) if packed else stream.read(MAX_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        told = getattr(error, "strerror", None) or error
        raise DataError(f"{shown(path)}: cannot be read ({shown(told)})") from None
    if len(data) > MAX_BYTES:
        raise DataError(f"{shown(path)}: has more than {MAX_BYTES:,} bytes, which no such table has")
    return data


def _header(data: bytes, path: Path, columns: Sequence[str]) -> tuple[str, list[str]]:
    """The separator, and a name for each column: its own where it is wanted, else its number."""
    header = data[:65536].removeprefix(_BOM).split(b"\n", 1)[0]
    try:
        first = header.decode().strip("\r\n")
    except UnicodeDecodeError:
        raise DataError(f"{shown(path)}: its first line is no UTF-8 text; save it as CSV in UTF-8") from None
    found = {s: [name.strip().strip('"').strip() for name in first.split(s)] for s in _SEPARATORS}
    best = max(_SEPARATORS, key=lambda s: len(set(columns) & set(found[s])))
    if missing := [name for name in columns if name not in found[best]]:
        told = f"no column {', '.join(missing)}; columns needed: {', '.join(columns)}"
        raise DataError(f"{shown(path)}: {told}; its first line is '{shown(first, 100)}'")
    if twice := [name for name in columns if found[best].count(name) > 1]:
        raise DataError(f"{shown(path)}: two columns are called {twice[0]}")
    return best, [name if name in columns else f"#{i}" for i, name in enumerate(found[best])]
