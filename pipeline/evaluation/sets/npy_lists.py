"""Lists of index arrays in `.npy` files, as fixed ground truth is handed around (`*_gt.npy`, `msls_val_pIdx.npy`).

Such a file holds an object array, and an object array is a pickle: `numpy.load(allow_pickle=True)` would run whatever
code a stranger wrote into it. Invariant: nothing here ever calls a function that a file names. The unpickler knows
five names, and answers each with an inert stand-in that only records its arguments; numpy arrays are built afterwards,
from checked bytes, by this module. Any other name, and any content that is not lists of integers, raises `DataError`.
"""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.common.errors import DataError
from pipeline.common.text import shown


class _Dtype:
    """Stand-in for numpy.dtype: its code and, from its state, its byte order."""

    def __init__(self, code: Any = None, *_: Any) -> None:
        self.code = code
        self.order = "="

    def __setstate__(self, state: Any) -> None:
        if isinstance(state, tuple) and len(state) > 1:
            self.order = state[1]

    def real(self) -> np.dtype:
        if not isinstance(self.code, str) or self.code not in ("O8", "O", *_INTEGERS):
            raise pickle.UnpicklingError(f"dtype {self.code!r} is no integer")
        if self.order not in ("<", ">", "=", "|"):
            raise pickle.UnpicklingError(f"byte order {self.order!r}")
        return np.dtype(object if self.code.startswith("O") else self.order + self.code)


_INTEGERS = tuple(f"{kind}{size}" for kind in "iu" for size in (1, 2, 4, 8))


class _Array:
    """Stand-in for numpy.ndarray: the state a real one would be restored from."""

    def __init__(self, *_: Any) -> None:
        self.state: Any = None

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Function:
    """Stand-in for a function: an object without attributes, so that a file cannot set any on it either."""

    __slots__ = ()

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError("it sets the state of a function")


class _Reconstruct(_Function):
    """For numpy's `_reconstruct(ndarray, (0,), b"b")`, which every pickled array begins with."""

    __slots__ = ()

    def __call__(self, *_: Any) -> _Array:
        return _Array()


class _Encode(_Function):
    """For `_codecs.encode`, by which protocol 2 writes bytes; latin-1 and nothing else."""

    __slots__ = ()

    def __call__(self, text: Any, encoding: Any = "latin1", *_: Any) -> bytes:
        if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
            raise pickle.UnpicklingError(f"encoding {encoding!r}")
        return text.encode("latin-1")


_KNOWN = {
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Dtype,
    ("numpy.core.multiarray", "_reconstruct"): _Reconstruct(),
    ("numpy._core.multiarray", "_reconstruct"): _Reconstruct(),
    ("_codecs", "encode"): _Encode(),
}


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        try:
            return _KNOWN[module, name]
        except KeyError:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, which no list of indices needs") from None

    def persistent_load(self, pid: Any) -> Any:
        raise pickle.UnpicklingError("it refers to objects outside the file")


def _plain(path: Path, what: str) -> np.ndarray:
    """An array without objects in it. Raises `DataError` for anything else."""
    try:
        array = np.load(path, allow_pickle=False)
        if isinstance(array, np.ndarray):
            return array
        reason = "an archive of arrays"
    except OSError as error:
        reason = error.strerror or str(error)
    except Exception as error:  # numpy parses the header as Python: a damaged one raises SyntaxError, TokenError ...
        reason = " ".join(str(error).split()) or type(error).__name__
    raise DataError(f"{path}: not a readable .npy array of {what} ({shown(reason)})")


def read_strings(path: Path) -> list[str]:
    """A one-dimensional `.npy` array of text (image names). Raises `DataError` for anything else."""
    array = _plain(path, "text")
    if array.ndim != 1 or array.dtype.kind not in "US":
        raise DataError(f"{path}: expected a list of image names, found {array.dtype} {array.shape}")
    if array.dtype.kind == "U" and array.size:
        codes = np.ascontiguousarray(array).view(np.dtype(np.uint32).newbyteorder(array.dtype.byteorder))
        if int(codes.max()) > 0x10FFFF:  # numpy would make a str of it that Python itself cannot hold
            raise DataError(f"{path}: its names hold characters that do not exist; the file is damaged")
    try:
        return [name.decode() if isinstance(name, bytes) else str(name) for name in array.tolist()]
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: its names are not UTF-8 ({error})") from error


def read_ragged(path: Path) -> list[np.ndarray]:
    """The index lists of a `.npy` file, int64 arrays: an object array of integer arrays, or a rectangular array.

    Raises `DataError` for a file that is not readable as such, above all for one that holds code.
    """
    try:
        content = path.read_bytes()
        stream = io.BytesIO(content)
        version = np.lib.format.read_magic(stream)
        read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        if version not in read_header:
            raise ValueError(f"format version {version}")
        shape, _, dtype = read_header[version](stream)
        if not dtype.hasobject:
            array = np.load(io.BytesIO(content), allow_pickle=False)
            if array.ndim not in (1, 2) or array.dtype.kind not in "iu":
                raise ValueError(f"{array.dtype} {array.shape}, not lists of indices")
            return [np.atleast_1d(row).astype(np.int64) for row in array]
        lists = _rows(_Unpickler(stream).load())
        if shape != (len(lists),):
            raise ValueError(f"the header says {shape}, the content has {len(lists)} lists")
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such file") from error
    except Exception as error:  # a hostile file may raise anything; the user needs one line, and gets it
        raise DataError(f"{path}: refused, not an array of index lists: {error}") from error
    return lists


def read_indices(path: Path) -> np.ndarray:
    """A one-dimensional `.npy` array of integers, as int64. Raises `DataError` for anything else."""
    array = _plain(path, "integers")
    if array.ndim != 1 or array.dtype.kind not in "iu":
        raise DataError(f"{path}: expected a list of integers, found {array.dtype} {array.shape}")
    return array.astype(np.int64)


def _rows(value: Any) -> list[np.ndarray]:
    """The outer object array (or list) as integer arrays."""
    items = _content(value) if isinstance(value, _Array) else value
    if not isinstance(items, list):
        raise pickle.UnpicklingError("the outer array holds no lists")
    return [_integers(item) for item in items]


def _integers(item: Any) -> np.ndarray:
    values = _content(item) if isinstance(item, _Array) else item
    if isinstance(values, np.ndarray):
        return values.astype(np.int64)
    if isinstance(values, list | tuple) and all(type(v) is int for v in values):
        return np.array(values, np.int64)
    raise pickle.UnpicklingError(f"an element is {type(item).__name__}, not a list of integers")


def _content(stand_in: _Array) -> np.ndarray | list[Any]:
    """What a recorded array state stands for: integers as an array, objects as a list."""
    state = stand_in.state
    if not (isinstance(state, tuple) and len(state) == 5):
        raise pickle.UnpicklingError("an array without its state")
    _, shape, dtype, _, data = state
    if not (isinstance(shape, tuple) and len(shape) == 1 and type(shape[0]) is int and isinstance(dtype, _Dtype)):
        raise pickle.UnpicklingError(f"an array of shape {shape!r}; lists are one-dimensional")
    kind = dtype.real()
    if kind == np.dtype(object):
        if not isinstance(data, list) or len(data) != shape[0]:
            raise pickle.UnpicklingError("an object array whose length is not what it says")
        return data
    if not isinstance(data, bytes) or len(data) != shape[0] * kind.itemsize:
        raise pickle.UnpicklingError("an integer array whose length is not what it says")
    return np.frombuffer(data, kind)
