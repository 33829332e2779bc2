"""Downloads that are something else than weights: called what they are, quickly, in one printable line."""

from __future__ import annotations

import io
import struct
import time
import zipfile
import zlib
from pathlib import Path

import pytest
import torch
from torch import Tensor

from pipeline.common.errors import DataError, UsageError
from pipeline.model.weights import pretrained
from pipeline.model.weights.files import read_metadata
from pipeline.model.weights.pretrained import read_tensors


def saved(tensors: object, **options: object) -> bytes:
    stream = io.BytesIO()
    torch.save(tensors, stream, **options)  # type: ignore[arg-type]
    return stream.getvalue()


def packed(**members: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name.replace("__", "/"), data)
    return stream.getvalue()


def bomb(unpacked: int = 1 << 30) -> bytes:
    """A real PyTorch zip of about a megabyte whose storage unpacks to a gigabyte of zeros."""
    stream = io.BytesIO()
    whole = zipfile.ZipFile(io.BytesIO(saved({"x": torch.zeros(4)})))
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in whole.namelist():
            if not name.endswith("data/0"):
                archive.writestr(name, whole.read(name))
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    block = packer.compress(bytes(1 << 24)) + packer.flush(zlib.Z_FULL_FLUSH)  # may be repeated
    data = block * (unpacked >> 24) + packer.flush()
    with zipfile.ZipFile(stream, "a", zipfile.ZIP_STORED) as archive:
        name = whole.namelist()[0].split("/")[0] + "/data/0"
        archive.writestr(name, data)
        entry = archive.getinfo(name)
        entry.compress_type, entry.file_size = zipfile.ZIP_DEFLATED, unpacked
    return stream.getvalue()


GOOD = saved({"a": torch.arange(4.0)})
KINDS = {
    "page": (b"\n <!DOCTYPE html><html>Google Drive - Virus scan warning", "a web page, not weights"),
    "page with a byte order mark": (b"\xef\xbb\xbf<html>", "a web page, not weights"),
    "pointer": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n", "a git-lfs pointer.*lfs pull"),
    "json": (b'{"error": "not found"}', "JSON text"),
    "empty": (b"", r"an empty file \(0 bytes\)"),
    "zeros": (bytes(4096), "a file of zeros"),
    "gzip": (b"\x1f\x8b\x08" + bytes(99), "a gzip archive.*unpack"),
    "tar": (bytes([97]) * 257 + b"ustar" + bytes(300), "a tar archive.*unpack"),
    "zip of something else": (packed(model__weights=b"x"), r"a zip archive \(model/weights\)"),
    "cut off": (GOOD[: len(GOOD) // 2], "cut off or damaged"),
    "cut at the end": (GOOD[:-30], "cut off or damaged"),
    "text": (b"\x1b[31mred\x1b[0m no weights", r"neither a PyTorch nor a safetensors file \(it begins with b'.x1b"),
    "numpy": (b"\x93NUMPY\x01\x00", "a NumPy array"),
}  # fmt: skip


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_no_weights_file_is_called_what_it_is(tmp_path: Path, kind: str, suffix: str) -> None:
    data, told = KINDS[kind]
    path = tmp_path / f"weights{suffix}"
    path.write_bytes(data)
    for read in (lambda: read_tensors(str(path)), lambda: read_metadata(path)):
        with pytest.raises(DataError, match=told) as caught:
            read()
        assert str(caught.value).isprintable() and str(path) in str(caught.value)


def test_a_zip_bomb_is_refused_at_once(tmp_path: Path) -> None:
    path = tmp_path / "bomb.pth"
    path.write_bytes(bomb())
    assert 900_000 < path.stat().st_size < 1_200_000
    start = time.process_time()
    with pytest.raises(DataError, match=r"would unpack to 1,073,7\d\d,\d\d\d, which no PyTorch file does"):
        read_tensors(str(path))
    assert time.process_time() - start < 5  # unpacking alone takes far longer


def test_a_tensor_of_more_numbers_than_the_file_holds_is_refused(tmp_path: Path) -> None:
    for name, tensors in {
        "stretched": {"a": torch.zeros(1).expand(1 << 20, 1 << 20)},
        "repeated": dict.fromkeys(map(str, range(50)), torch.zeros(1 << 18)),
    }.items():
        torch.save(tensors, tmp_path / f"{name}.pth")
        with pytest.raises(DataError, match="claims more numbers than the file's"):
            read_tensors(str(tmp_path / f"{name}.pth"))


def test_messages_hold_no_terminal_escapes_and_no_dangerous_advice(tmp_path: Path) -> None:
    path = tmp_path / "trap.pth"
    torch.save({"a": torch.zeros(1), "path": Path("x")}, path)
    with pytest.raises(DataError, match=r"not loaded: .* code in a file is never run \(it asks for pathlib") as caught:
        read_tensors(str(path))
    assert str(caught.value).isprintable() and "weights_only" not in str(caught.value)


@pytest.mark.parametrize(
    "name",
    ["module.{}", "_orig_mod.{}", "module._orig_mod.{}", "_orig_mod.module.{}", "module.module.{}", "inside"],
)
def test_what_wrappers_add_to_names_is_taken_out(tmp_path: Path, name: str) -> None:
    names = ("backbone.blocks.0.weight", "head.bias")
    if name == "inside":
        given = [
            "backbone._orig_mod.blocks.0._fsdp_wrapped_module.weight",
            "_orig_mod.head._checkpoint_wrapped_module.bias",
        ]
    else:
        given = [name.format(own) for own in names]
    torch.save({"state_dict": {key: torch.zeros(2) for key in given}}, tmp_path / "x.pth")
    assert sorted(read_tensors(str(tmp_path / "x.pth"))) == sorted(names)


def test_names_that_only_resemble_a_wrapper_stay(tmp_path: Path) -> None:
    tensors: dict[object, Tensor] = {
        "my_orig_mod.a": torch.zeros(1),
        "module.b": torch.zeros(1),
        "module2.c": torch.zeros(1),
    }
    torch.save({**tensors, 3: torch.zeros(1)}, tmp_path / "x.pth")
    assert sorted(read_tensors(str(tmp_path / "x.pth"))) == ["module.b", "module2.c", "my_orig_mod.a"]
    torch.save({"a._orig_mod.b": torch.zeros(1), "a.b": torch.ones(1)}, tmp_path / "twice.pth")
    with pytest.raises(DataError, match="two tensors have the same name"):
        read_tensors(str(tmp_path / "twice.pth"))


def test_safetensors_are_read_under_any_ending(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    save_file({"a": torch.arange(3.0)}, tmp_path / "x.pth")
    assert torch.equal(read_tensors(str(tmp_path / "x.pth"))["a"], torch.arange(3.0))
    (tmp_path / "old.safetensors").write_bytes(saved({"a": torch.arange(3.0)}, _use_new_zipfile_serialization=False))
    assert torch.equal(read_tensors(str(tmp_path / "old.safetensors"))["a"], torch.arange(3.0))
    (tmp_path / "lies.safetensors").write_bytes(struct.pack("<Q", 20) + b'{"a": {"dtype": "F3' + bytes(20))
    with pytest.raises(DataError, match="not a readable safetensors file"):
        read_tensors(str(tmp_path / "lies.safetensors"))


@pytest.mark.parametrize("file", ['"../x.safetensors"', '"/etc/passwd"', "3", '"none.safetensors"', "{", None])
def test_an_index_names_files_beside_it_alone(tmp_path: Path, file: str | None) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "model.safetensors.index.json").write_text("[]" if file is None else f'{{"weight_map": {{"a": {file}}}}}')
    (tmp_path / "x.safetensors").touch()
    with pytest.raises(DataError, match=r"index\.json: (not an index|.* is not beside it)"):
        read_tensors(str(folder))
    with pytest.raises(UsageError, match="no such weights file"):
        read_tensors(str(tmp_path / "nothing.pth"))


def test_only_what_begins_with_hub_is_asked_of_the_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def hub(name: str) -> Path:
        asked.append(name)
        raise UsageError("the hub was asked")

    monkeypatch.setattr(pretrained, "_from_hub", hub)
    monkeypatch.chdir(tmp_path)
    for mistyped in ("weigths/dinov2", "facebook/dinov2-base", "a/b/c", "dinov2", "~/dinov2"):
        with pytest.raises(UsageError, match="there is no such weights file or folder"):
            read_tensors(mistyped)
    with pytest.raises(UsageError, match="if a model of the model hub is meant, write hub:facebook/dinov2-base"):
        read_tensors("facebook/dinov2-base")
    assert asked == []
    with pytest.raises(UsageError, match="the hub was asked"):
        read_tensors("hub:facebook/dinov2-base")
    assert asked == ["facebook/dinov2-base"]
    monkeypatch.undo()
    with pytest.raises(UsageError, match=r"hub:\.\./x: a name on the model hub is OWNER/NAME"):
        read_tensors("hub:../x")
