"""What a weights file really is, told before anything reads it: downloads are often something else.

Invariant: only the head of a file and a zip's list of members are read here, so that neither a web page nor an archive
made to unpack to terabytes costs more than a look.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from pipeline.common.errors import DataError
from pipeline.common.text import shown

LFS = b"version https://git-lfs"
HTML = "a web page, not weights: the download led to a login, a confirmation or an error page; get the file itself"
PACKED = "a {} archive, not weights: unpack it and give the file inside"
# beginning of the file -> what it is; text is looked at without leading white space
KINDS: tuple[tuple[bytes, str], ...] = (
    (LFS, "a git-lfs pointer, not the weights themselves: run `git lfs pull`, or download the file from its page"),
    (b"<", HTML),
    (b"{", "JSON text, not weights"),
    (b"%PDF", "a PDF, not weights"),
    (b"\x1f\x8b", PACKED.format("gzip")),
    (b"BZh", PACKED.format("bzip2")),
    (b"\xfd7zXZ", PACKED.format("xz")),
    (b"7z\xbc\xaf", PACKED.format("7-Zip")),
    (b"Rar!", PACKED.format("RAR")),
    (b"\x89HDF", "an HDF5 file; PyTorch or safetensors files are read"),
    (b"\x93NUMPY", "a NumPy array; PyTorch or safetensors files are read"),
)
PICKLE, ZIP = b"\x80", b"PK\x03\x04"
UNPACKED = 10  # PyTorch stores its members uncompressed; more than so many times the file's size is an attack
SLACK = 1 << 20  # bytes that tiny files may differ by


def is_safetensors(path: Path) -> bool:
    """Whether a file begins as safetensors do: the length of a JSON header, then the header."""
    with path.open("rb") as stream:
        head = stream.read(9)
    return len(head) == 9 and head[8:] == b"{" and 2 <= int.from_bytes(head[:8], "little") <= path.stat().st_size


def check_file(path: Path) -> None:
    """Raises `DataError`, saying what the file is, unless it may be a file that `torch.save` wrote, or safetensors."""
    if is_safetensors(path):
        return
    with path.open("rb") as stream:
        head = stream.read(512)
    problem = ""
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if not head:
        problem = "an empty file (0 bytes); download it again"
    elif not head.strip(b"\0"):
        problem = "a file of zeros: the download was not finished; download it again"
    elif head.startswith(ZIP):
        problem = _zip_problem(path)
    elif head[257:262] == b"ustar":
        problem = PACKED.format("tar")
    elif not head.startswith(PICKLE):
        problem = next(
            (what for begin, what in KINDS if text.startswith(begin)),
            f"neither a PyTorch nor a safetensors file (it begins with {shown(repr(head[:16]))})",
        )
    if problem:
        raise DataError(f"{shown(path)}: {problem}")


def _zip_problem(path: Path) -> str:
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        return f"a PyTorch file that is cut off or damaged ({message(error)}); download it again"
    names = [member.filename for member in members]
    if not any(name.endswith("data.pkl") for name in names):
        held = ", ".join(map(shown, names[:3])) or "nothing"
        return f"a zip archive ({held}), not a PyTorch file: unpack it and give the file inside"
    whole, size = sum(member.file_size for member in members), path.stat().st_size
    if whole > UNPACKED * size + SLACK:
        return f"{size:,} bytes that would unpack to {whole:,}, which no PyTorch file does; refused"
    return ""


def check_tensors(tensors: Mapping[str, Tensor], path: Path) -> None:
    """Raises `DataError` where tensors claim more numbers than their file can hold."""
    size = path.stat().st_size
    whole = 0
    for name, tensor in tensors.items():
        claimed = tensor.numel() * tensor.element_size()
        whole += claimed
        if claimed > tensor.untyped_storage().nbytes() or whole > UNPACKED * size + SLACK:
            raise DataError(
                f"{shown(path)}: '{shown(name)}' of shape {list(tensor.shape)} claims more numbers than the file's "
                f"{size:,} bytes hold; refused"
            )


def message(error: Exception) -> str:
    """A library's error as one short printable line: without terminal colours, and without its advice.

    PyTorch advises to load without `weights_only`, which would run a stranger's code.
    """
    text = re.sub(r"\x1b\[[0-9;]*[A-Za-z]", "", str(error))
    asked = re.search(r"GLOBAL ([\w.]+)", text)
    if asked is not None:
        return f"it asks for {asked[1]}"
    text = " ".join(re.split(r"Please|To execute|In PyTorch|Check the doc", text)[0].split()) or type(error).__name__
    return shown(text if len(text) < 160 else text[:157] + "...")
