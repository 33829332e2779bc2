"""Names from outside, shown in messages."""

from __future__ import annotations

import pytest

from pipeline.common.text import shown


@pytest.mark.parametrize(
    ("name", "seen"),
    [
        ("Images/PRS/São Paulo 東京.jpg", "Images/PRS/São Paulo 東京.jpg"),
        ("a\nb\r\tc", r"a\nb\r\tc"),
        ("\x1b[31mred\x07", r"\x1b[31mred\x07"),
        ("photo\u202egpj.exe", r"photo\u202egpj.exe"),
        (b"\xff.jpg".decode("utf-8", "surrogateescape"), r"\udcff.jpg"),
        ("x" * 300, "x" * 100 + "..." + "x" * 100),
        (-1.5, "-1.5"),
    ],
)
def test_a_name_is_shown_as_one_printable_line(name: object, seen: str) -> None:
    assert shown(name) == seen
    assert shown(name).isprintable()
