"""Fixed `.npy` lists: read as numpy wrote them, and never run what a stranger wrote into them."""

from __future__ import annotations

import dataclasses
import io
import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from pipeline.common.errors import DataError, UsageError
from pipeline.config import EvaluationConfig
from pipeline.evaluation.sets.evaluation_set import EvaluationSet
from pipeline.evaluation.sets.load import available, load_set
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
    with pytest.raises(UsageError, match="give one file instead: pitts30k_test_dbImages"):
        load_set(str(tmp_path), EvaluationConfig(split="train"))
    (tmp_path / "pitts30k_val_gt.npy").unlink()
    with pytest.raises(DataError, match=r"pitts30k_val_gt\.npy: no ground truth"):
        load_set(str(tmp_path), EvaluationConfig(split="val"))


def test_real_lists_are_what_numpy_reads(shared_dir: Path) -> None:
    for name in ("msls_val/msls_val_pIdx.npy", "Nordland/Nordland_gt.npy"):
        path = shared_dir / "data" / "ground_truth" / name
        assert all(map(np.array_equal, read_ragged(path), np.load(path, allow_pickle=True)))


def answers(evaluated: EvaluationSet) -> tuple[list[str], list[str], list[list[int]]]:
    """What a set asks, searches and accepts."""
    return [q.name for q in evaluated.queries], [d.name for d in evaluated.database], [
        p.tolist() for p in evaluated.positives]  # fmt: skip


@pytest.mark.parametrize("folders", [("database", "queries"), ("ref", "query"), ("new", "old"), ("gallery", "queries")])
@pytest.mark.parametrize("names", [("dbImages", "qImages", "gt"), ("ref_image_names", "query_image_names", "gt_25m")])
def test_a_folder_and_one_of_its_lists_are_the_same_set(
    tmp_path: Path, folders: tuple[str, str], names: tuple[str, str, str]
) -> None:
    """Photos that the folders hold and the lists leave out; positives that no radius gives."""
    sides = [[f"{folder}/@{i * 100}.00@{at}.00@.jpg" for i in range(8)] for at, folder in enumerate(folders)]
    write_lists(tmp_path, "walk_val", sides[0], sides[1], tmp_path)
    for file in tmp_path.glob("*.npy"):
        file.unlink()
    np.save(tmp_path / f"walk_val_{names[0]}.npy", np.array(sides[0][::-1]))
    np.save(tmp_path / f"walk_val_{names[1]}.npy", np.array(sides[1][:4]))
    save(tmp_path / f"walk_val_{names[2]}.npy", ragged([[0, 1], [2], [3], []]))
    whole = answers(load_set(str(tmp_path), EvaluationConfig()))
    assert len(whole[0]) == 4 and whole[2] == [[0, 1], [2], [3], []]
    for what in names:
        assert answers(load_set(str(tmp_path / f"walk_val_{what}.npy"), EvaluationConfig())) == whole


def test_a_folder_and_its_manifest_are_the_same_set(tmp_path: Path) -> None:
    for side, role in (("database", 0), ("queries", 1)):
        (tmp_path / side).mkdir()
        for i in range(3):
            (tmp_path / side / f"@{i * 100}.50@{role}.25@.jpg").touch()
    manifest = tmp_path / "set.csv"
    manifest.write_text("image,role,frame\ndatabase/@0.50@0.25@.jpg,database,0\nqueries/@200.50@1.25@.jpg,query,0\n")
    assert answers(load_set(str(tmp_path), EvaluationConfig())) == answers(load_set(str(manifest), EvaluationConfig()))
    (tmp_path / "again.csv").write_text(manifest.read_text())
    with pytest.raises(UsageError, match=r"again\.csv, set\.csv are all manifests; give one of the files"):
        load_set(str(tmp_path), EvaluationConfig())


def test_tables_beside_folders_that_are_not_read_are_named(tmp_path: Path) -> None:
    for side in ("database", "queries"):
        (tmp_path / "images" / "test" / side).mkdir(parents=True)
        (tmp_path / "images" / "test" / side / "@583400.00@4477100.00@.jpg").touch()
    write_lists(tmp_path, "city_val", ["a.jpg"], ["b.jpg"], tmp_path)
    (tmp_path / "truth.npz").touch(), (tmp_path / "._truth.npz").touch()
    (remark,) = load_set(str(tmp_path), EvaluationConfig()).remarks
    assert remark == "not read: city_val_dbImages.npy, city_val_qImages.npy, truth.npz; the folders decide"


def test_the_validation_folders_of_openvprlab(tmp_path: Path) -> None:
    pitts, msls = tmp_path / "pitts30k-val", tmp_path / "msls-val"
    write_lists(pitts, "pitts30k_val", ["000/a.jpg", "000/b.jpg"], ["q/1.jpg"], pitts)
    save(pitts / "pitts30k_val_gt_25m.npy", ragged([[1]]))
    write_lists(msls, "msls_val", ["cph/database/a.jpg", "sf/database/b.jpg"], ["sf/query/1.jpg"], msls)
    for old, new in (("dbImages", "ref_image_names"), ("qImages", "query_image_names")):
        (msls / f"msls_val_{old}.npy").rename(msls / f"msls_val_{new}.npy")
    save(msls / "msls_val_ground_truth_25m.npy", ragged([[1]]))
    config = EvaluationConfig(root=str(tmp_path))
    for name in ("msls_val", "msls-val", str(msls)):
        assert answers(load_set(name, config)) == (["1.jpg"], ["a.jpg", "b.jpg"], [[1]])
        assert any("published are 18,871 and 740" in remark for remark in load_set(name, config).remarks)
    for name in ("pitts30k-val", str(pitts)):
        loaded = load_set(name, config)
        assert answers(loaded) == (["1.jpg"], ["a.jpg", "b.jpg"], [[1]]) and loaded.rule == "25 m"
    assert load_set("pitts30k", dataclasses.replace(config, split="val")).name == "pitts30k"
    with pytest.raises(DataError, match=r"pitts30k is not there: expected .*pitts30k"):
        load_set("pitts30k", config)  # the lists are those of the validation split
    there = {entry.name for entry in available(str(tmp_path)) if entry.folder is not None}
    assert there == {"msls_val"}
    other = load_set(str(pitts), dataclasses.replace(config, radius=10.0))
    assert other.rule == "25 m" and "radius=10 does not apply" in other.remarks[0]


@pytest.mark.parametrize("name", ["../../etc/passwd", "/etc/passwd", "a/../../b.jpg", "nul\0.jpg", ""])
def test_a_list_names_nothing_outside_its_folder(tmp_path: Path, name: str) -> None:
    write_lists(tmp_path, "s", ["a.jpg"], ["b.jpg"], tmp_path)
    save(tmp_path / "s_gt.npy", ragged([[0]]))
    np.save(tmp_path / "s_qImages.npy", np.array([f"{name}", "b.jpg"]) if name else np.array(["", "b.jpg"]))
    if "\0" in name:  # numpy drops a NUL at the end of a text alone
        assert np.load(tmp_path / "s_qImages.npy")[0] == name
    with pytest.raises(DataError, match="is no plain path relative to the photos' folder"):
        load_set(str(tmp_path), EvaluationConfig())


def test_names_that_are_no_text_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "u.npy", np.array(["abc", "d"]))
    content = bytearray((tmp_path / "u.npy").read_bytes())
    content[-1] = 0x7F  # the highest byte of a character: far above the last one that exists
    (tmp_path / "u.npy").write_bytes(content)
    with pytest.raises(DataError, match="characters that do not exist"):
        read_strings(tmp_path / "u.npy")
    np.save(tmp_path / "s.npy", np.array([b"\xff\xfe"]))
    with pytest.raises(DataError, match="not UTF-8"):
        read_strings(tmp_path / "s.npy")
    np.save(tmp_path / "b.npy", np.array(["über"]).astype(">U4"))
    assert read_strings(tmp_path / "b.npy") == ["über"]
