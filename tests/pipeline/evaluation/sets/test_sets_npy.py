"""Fixed `.npy` lists: read as numpy wrote them, and never run what a stranger wrote into them."""

from __future__ import annotations

import io
import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from pipeline.common.errors import DataError, UsageError
from pipeline.config import EvaluationConfig
from pipeline.evaluation.sets.load import load_set
from pipeline.evaluation.sets.npy_lists import read_indices, read_ragged, read_strings


def ragged(rows: list[list[int]], dtype: str = "int64") -> np.ndarray:
    array = np.empty(len(rows), object)
    for at, row in enumerate(rows):
        array[at] = np.array(row, dtype)
    return array


def save(path: Path, array: np.ndarray) -> Path:
    np.save(path, array, allow_pickle=True)
    return path


def with_payload(path: Path, payload: bytes, length: int = 1) -> Path:
    """An `.npy` object array whose pickle is `payload`."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "|O", "fortran_order": False, "shape": (length,)})
    path.write_bytes(stream.getvalue() + payload)
    return path


@pytest.mark.parametrize("dtype", ["int64", "int32", "uint8", ">i4"])
def test_object_arrays_come_back_as_numpy_wrote_them(tmp_path: Path, dtype: str) -> None:
    rows = [[0, 1, 200], [], [7]]
    got = read_ragged(save(tmp_path / "gt.npy", ragged(rows, dtype)))
    assert [row.tolist() for row in got] == rows and all(row.dtype == np.int64 for row in got)


@pytest.mark.parametrize("protocol", [2, 3, 4])
def test_older_pickle_protocols_too(tmp_path: Path, protocol: int) -> None:
    """Files written by Python 2 and by early versions of numpy use protocols 2 and 3."""
    rows = [[3, 250], [128, 65_000]]
    path = with_payload(tmp_path / "gt.npy", pickle.dumps(ragged(rows), protocol=protocol), 2)
    assert [row.tolist() for row in read_ragged(path)] == rows


def test_lists_and_rectangles(tmp_path: Path) -> None:
    mixed = np.empty(2, object)
    mixed[:] = [[1, 2], [3]]
    assert [row.tolist() for row in read_ragged(save(tmp_path / "l.npy", mixed))] == [[1, 2], [3]]
    assert [row.tolist() for row in read_ragged(save(tmp_path / "r.npy", np.array([[1, 2], [3, 4]])))] == [
        [1, 2],
        [3, 4],
    ]
    assert [row.tolist() for row in read_ragged(save(tmp_path / "o.npy", np.array([5, 6])))] == [[5], [6]]


class Harmful:
    def __init__(self, function: object, *arguments: object) -> None:
        self.call = function, arguments

    def __reduce__(self) -> tuple:
        return self.call


@pytest.mark.parametrize("where", ["element", "whole"])
def test_a_malicious_file_is_refused_and_not_run(tmp_path: Path, where: str) -> None:
    proof = tmp_path / "ran"
    harmful = Harmful(os.mkdir, str(proof))
    if where == "element":
        array = np.empty(2, object)
        array[:] = [np.array([1]), harmful]
        path = save(tmp_path / "gt.npy", array)
    else:
        path = with_payload(tmp_path / "gt.npy", pickle.dumps(harmful))
    with pytest.raises(DataError, match=r"refused, not an array of index lists: it asks for \w+\.mkdir"):
        read_ragged(path)
    assert not proof.exists()
    np.load(path, allow_pickle=True)
    assert proof.exists(), "the file must be one that does harm when unpickled blindly"


@pytest.mark.parametrize(
    "payload",
    [
        pickle.dumps(Harmful(eval, "1")),
        pickle.dumps(Harmful(getattr, "text", "format")),
        pickle.dumps(Harmful(np.dtype, "O")),
        b"cnumpy\nload\n(S'x'\ntR.",
        b"cos\nsystem\n(S'true'\ntR.",
        b"cnumpy.core.multiarray\nscalar\n.",
        b"c_codecs\nencode\n(Vabc\nVzlib_codec\ntR.",
        b"c_codecs\nencode\n(dS'x'\nI1\nsb.",
        b"cnumpy\nndarray\n(dS'x'\nI1\nsb.",
        b"Pid\n.",
        b"",
        b"\x80\x04",
    ],
)
def test_nothing_but_index_lists_gets_through(tmp_path: Path, payload: bytes) -> None:
    with pytest.raises(DataError, match="refused"):
        read_ragged(with_payload(tmp_path / "gt.npy", payload))


def test_lengths_that_lie_are_refused(tmp_path: Path) -> None:
    honest = pickle.dumps(ragged([[1, 2, 3]]), protocol=3)
    with pytest.raises(DataError, match="the header says"):
        read_ragged(with_payload(tmp_path / "a.npy", honest, length=9))
    shape = b"K\x03\x85"  # (3,), the shape of the inner array
    assert honest.count(shape) == 1
    with pytest.raises(DataError, match="length is not what it says"):
        read_ragged(with_payload(tmp_path / "b.npy", honest.replace(shape, b"K\x7f\x85")))
    with pytest.raises(DataError, match="no integer"):
        read_ragged(save(tmp_path / "c.npy", ragged([[1]], "float64")))
    with pytest.raises(DataError, match="not a list of integers"):
        read_ragged(save(tmp_path / "d.npy", np.array([{"a": 1}, None], object)))


def test_plain_arrays_are_checked(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="expected a list of image names"):
        read_strings(save(tmp_path / "n.npy", np.array([1, 2])))
    with pytest.raises(DataError, match=r"not a readable \.npy"):
        read_strings(save(tmp_path / "o.npy", np.array(["a", None], object)))
    with pytest.raises(DataError, match="expected a list of integers"):
        read_indices(save(tmp_path / "f.npy", np.array([1.5])))
    with pytest.raises(DataError, match="no such file"):
        read_ragged(tmp_path / "absent.npy")


def write_lists(folder: Path, prefix: str, database: list[str], queries: list[str], photos: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / f"{prefix}_dbImages.npy", np.array(database))
    np.save(folder / f"{prefix}_qImages.npy", np.array(queries))
    for name in (*database, *queries):
        (photos / name).parent.mkdir(parents=True, exist_ok=True)
        (photos / name).touch()


@pytest.mark.parametrize("photos", [".", "..", "root/pitts30k", "root/pitts30k_test", "root"])
def test_lists_with_their_photos_in_the_usual_places(tmp_path: Path, photos: str) -> None:
    folder = tmp_path / "below" / "lists"
    place = (tmp_path / photos) if photos.startswith("root") else folder / photos
    write_lists(folder, "pitts30k_test", ["000/b.jpg", "000/a.jpg"], ["q/1.jpg"], place)
    save(folder / "pitts30k_test_gt.npy", ragged([[1]]))
    loaded = load_set(str(folder), EvaluationConfig(root=str(tmp_path / "root")))
    assert [p.name for p in loaded.database] == ["b.jpg", "a.jpg"], "the order of the list, which positives count in"
    assert (loaded.name, loaded.rule, loaded.positives[0].tolist()) == ("pitts30k_test", "listed positives", [1])


def test_msls_lists_keep_the_indexed_queries(tmp_path: Path) -> None:
    write_lists(tmp_path, "msls_val", ["d/1.jpg", "d/2.jpg"], ["q/1.jpg", "q/2.jpg", "q/3.jpg"], tmp_path)
    np.save(tmp_path / "msls_val_qIdx.npy", np.array([0, 2]))
    save(tmp_path / "msls_val_pIdx.npy", ragged([[0], [0, 1]]))
    loaded = load_set(str(tmp_path / "msls_val_dbImages.npy"), EvaluationConfig())
    assert [p.name for p in loaded.queries] == ["1.jpg", "3.jpg"]
    assert [p.tolist() for p in loaded.positives] == [[0], [0, 1]] and "2 of the 3 listed" in loaded.remarks[0]
    (tmp_path / "q" / "3.jpg").unlink()
    with pytest.raises(DataError, match=r"1 of 2 photos are not on disk, the first is .*3\.jpg"):
        load_set(str(tmp_path), EvaluationConfig())


def test_several_lists_in_a_folder_go_by_split(tmp_path: Path) -> None:
    for split in ("val", "test"):
        write_lists(tmp_path, f"pitts30k_{split}", ["a.jpg"], [f"{split}.jpg"], tmp_path)
        save(tmp_path / f"pitts30k_{split}_gt.npy", ragged([[0]]))
    assert load_set(str(tmp_path), EvaluationConfig(split="val")).queries[0].name == "val.jpg"
    with pytest.raises(UsageError, match="name one file"):
        load_set(str(tmp_path), EvaluationConfig(split="train"))
    (tmp_path / "pitts30k_val_gt.npy").unlink()
    with pytest.raises(DataError, match=r"pitts30k_val_gt\.npy: no ground truth"):
        load_set(str(tmp_path), EvaluationConfig(split="val"))


def test_real_lists_are_what_numpy_reads(shared_dir: Path) -> None:
    for name in ("msls_val/msls_val_pIdx.npy", "Nordland/Nordland_gt.npy"):
        path = shared_dir / "data" / "ground_truth" / name
        assert all(map(np.array_equal, read_ragged(path), np.load(path, allow_pickle=True)))
