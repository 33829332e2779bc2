"""The table renderer in its three forms, and foreign names that try to be more than names."""

from __future__ import annotations

import csv
import io
import sys

import pytest

from pipeline.common.errors import DataError
from pipeline.common.text import Table, csv_text, markdown_text, shown

TABLE = Table(
    ["set", "protocol", "R@1"],
    [["a", "single", "50.0"], ["a", "ordered16", "100.0"], ["b", "single", "7.5"]],
    left=(0, 1),
    marked=[(1, 2)],
    grouped=True,
)
HOSTILE = (
    "\x1b[31mred\x1b[0m",
    "two\nlines",
    "a\rb",
    "\x9b1m",
    "\u202egpj.exe",
    "tab\there",
    "\udcff",
    "\x00",
    "\u2028",
)


def test_text_is_aligned_groups_are_ruled_and_marks_hang_to_the_right() -> None:
    assert TABLE.text().splitlines() == [
        "set  protocol     R@1",
        "---  ---------  ------",
        "a    single      50.0",
        "     ordered16  100.0*",
        "---  ---------  ------",
        "b    single       7.5",
    ]
    assert Table((), [["x", "1"], ["long", "22"]]).text().splitlines() == ["x      1", "long  22"]
    assert Table(["only", "head"], []).text() == "only  head"


def test_markdown_and_csv_say_the_same() -> None:
    assert TABLE.markdown().splitlines()[:4] == [
        "| set | protocol | R@1 |",
        "| :--- | :--- | ---: |",
        "| a | single | 50.0 |",
        "| a | ordered16 | **100.0** |",
    ]
    assert list(csv.reader(io.StringIO(TABLE.csv()))) == [list(TABLE.head), *map(list, TABLE.rows)]


def test_a_terminal_gets_a_drawn_table(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", "80")
    Table(["set", "R@1"], [["[bold]x[/bold]", "1.0"], ["\x1b]0;title\x07", "2.0"]], marked=[(1, 1)]).print()
    drawn = capsys.readouterr().out
    assert "[bold]x[/bold]" in drawn and "─" in drawn and "2.0*" in drawn
    assert r"\x1b]0;title\x07" in drawn and "\x07" not in drawn


@pytest.mark.parametrize("name", HOSTILE, ids=ascii)
def test_no_control_character_of_a_name_reaches_any_form(name: str) -> None:
    assert shown(name).isprintable() and shown(name) != name
    table = Table(["name", "n"], [[name, "1"]])
    for text in (table.text(), table.markdown(), table.csv()):
        assert all(line.isprintable() for line in text.splitlines()), "one row stays one line"
        text.encode()
    assert len(table.text().splitlines()) == len(table.markdown().splitlines()) == 3


def test_names_that_need_no_help_stay_as_they_are() -> None:
    for name in ("Zürich/東京 photo (1).jpg", "@0543@41@.jpg", "=x", "", "a_b"):
        assert shown(name) == name
    assert markdown_text("ordered16_pca4096") == "ordered16_pca4096"


@pytest.mark.parametrize("name", ["=cmd|' /C calc'!A0", "+1+1", "-2+3", "@SUM(A1)", "=1", "\t=1", "\r=1"])
def test_csv_holds_no_formula(name: str) -> None:
    ((field, *_),) = csv.reader(io.StringIO(csv_text([[name, -1.5, "-", "-3.2", "+0.5"]])))
    assert not field.startswith(("=", "+", "-", "@", "\t", "\r"))


def test_csv_keeps_numbers() -> None:
    assert csv_text([[-1.5, "-", "-3.2", "+0.5", None, True]]) == "-1.5,-,-3.2,+0.5,,True\n"


@pytest.mark.parametrize("markup", ["<script>x</script>", "a|b", "*x*", "_x_", "`x`", "[x](http://y)", "~~x~~", "&lt;"])
def test_markdown_shows_markup_as_typed(markup: str) -> None:
    (row,) = Table(["n"], [[markup]]).markdown().splitlines()[2:]
    text = row[2:-2]
    bare = text.replace("\\", "")
    assert bare == markup
    for sign in "<>|*`[]~&":
        assert text.count(sign) == text.count("\\" + sign)


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


def test_every_error_for_the_user_is_one_printable_line() -> None:
    error = DataError("a\nname \x1b[31mred\x1b[0m: broken")
    assert str(error) == r"a\nname \x1b[31mred\x1b[0m: broken" and f"{error}" == str(error)
    path = "/data/" + "a/" * 450
    assert str(DataError(f"{path}: missing")) == f"{path}: missing", "an ordinary path stays whole"
    start, end = str(DataError(f"{'x/' * 5000}: cannot be read")).split("...")
    assert (start, end) == ("x/" * 250, "/" + "x/" * 249 + ": cannot be read")
