"""Text for people: one table renderer (terminal, markdown, CSV), and foreign names made harmless.

Invariant: every name that comes from outside (a file, a folder, a data set, a run) is data. `printable` leaves no
control character in it, markdown shows its markup as typed, and a spreadsheet takes no CSV field for a formula.
"""

from __future__ import annotations

import csv
import io
import re
import sys
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

# what markdown reads as markup; an underscore inside a word is not
MARKUP = re.compile(r"[\\`*<>|\[\]~&]|(?<!\w)_|_(?!\w)")
PASSWORD = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*://)[^/\s?#'\"]*:[^/\s?#'\"]*@")  # of a URL
LIMIT = 200  # characters shown of a name or value in a message
LONG = re.compile(r"(\S{500})\S+(\S{500})")  # in a whole message
FORMULA = ("=", "+", "-", "@")


def shown(name: object, limit: int = LIMIT) -> str:
    r"""A file name, or a value read from a file, as one printable line of at most about `limit` characters.

    Ordinary names are returned as they are; a longer text loses its middle.
    """
    text = str(name)
    if len(text) > limit:
        text = f"{text[: limit // 2]}...{text[len(text) - limit // 2 :]}"
    return printable(text)


def printable(text: str) -> str:
    r"""The whole text in printable characters.

    Newlines, terminal escapes, other control characters, marks of writing direction and bytes that are no UTF-8 appear
    as `\n`, `\x1b`, `\u202e`, `\udcff`.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text)


def without_passwords(text: str) -> str:
    """The text with the `user:password@` of each URL left out, for whatever is printed or recorded."""
    return PASSWORD.sub(r"\1", text)


def message(text: str) -> str:
    """A whole message as one printable line. A name of more than 1000 characters without a space loses its middle, a
    URL its password."""
    return LONG.sub(r"\1...\2", printable(without_passwords(text)))


def markdown_text(text: str) -> str:
    """Text as markdown that shows it as it is."""
    return MARKUP.sub(r"\\\g<0>", printable(text))


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Rows as CSV, lines ended by a newline.

    A text that a spreadsheet would run as a formula (it begins with ``= + - @`` and is no number) gets an apostrophe
    before it, which a spreadsheet hides. Control characters are shown as escapes. Numbers are written as they are.
    """
    out = io.StringIO(newline="")
    csv.writer(out, lineterminator="\n").writerows([_field(cell) for cell in row] for row in rows)
    return out.getvalue()


def _field(cell: object) -> object:
    if not isinstance(cell, str):
        return cell
    text = printable(cell)
    return "'" + text if text.startswith(FORMULA) and text != "-" and not _number(text) else text


def _number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


@dataclass(frozen=True)
class Table:
    """Rows of text under a head.

    Attributes:
        head: names of the columns; empty: no head.
        rows: lines of cells, each as long as the head.
        left: columns aligned to the left; all others to the right.
        marked: (row, column) of cells that stand out: `*` in text, bold in markdown, nothing in CSV.
        grouped: rows with the same first cell belong together: text shows that cell once, and a rule between groups.
    """

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    left: Collection[int] = (0,)
    marked: Collection[tuple[int, int]] = ()
    grouped: bool = False

    def text(self) -> str:
        """Aligned columns for a log file or a pipe."""
        lines = self._cells()
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        rule = "  ".join("-" * width for width in widths)
        out = []
        for i, line in enumerate(lines):
            cells = (
                c.ljust(w) if n in self.left else c.rjust(w) for n, (c, w) in enumerate(zip(line, widths, strict=True))
            )
            row = i - bool(self.head)
            if (row == 0 and self.head) or (row > 0 and self._opens(row)):
                out.append(rule)
            out.append("  ".join(cells).rstrip())
        return "\n".join(out)

    def print(self) -> None:
        """To standard output: drawn by `rich` on a terminal, as `text` elsewhere."""
        if not sys.stdout.isatty():
            print(self.text())
            return
        from rich.box import SIMPLE_HEAD
        from rich.console import Console
        from rich.table import Table as RichTable
        from rich.text import Text

        lines = self._cells()
        head = lines.pop(0) if self.head else [""] * len(lines[0])
        drawn = RichTable(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, show_header=bool(self.head))
        for n, name in enumerate(head):
            drawn.add_column(Text(name), justify="left" if n in self.left else "right", overflow="fold")
        for row, line in enumerate(lines):
            style = ["bold green" if (row, n) in self.marked else "" for n in range(len(line))]
            opens_next = row + 1 < len(lines) and self._opens(row + 1)
            drawn.add_row(*map(Text, line, style), end_section=opens_next)
        Console().print(drawn)

    def markdown(self) -> str:
        """A markdown table, marked cells in bold."""
        rows = [
            [f"**{markdown_text(c)}**" if (i, n) in self.marked else markdown_text(c) for n, c in enumerate(row)]
            for i, row in enumerate(self.rows)
        ]
        align = [":---" if n in self.left else "---:" for n in range(len(self.head))]
        lines = [[markdown_text(name) for name in self.head], align, *rows]
        return "".join("| " + " | ".join(line) + " |\n" for line in lines)

    def csv(self) -> str:
        """The same as CSV, without marks."""
        return csv_text([self.head, *self.rows])

    def _opens(self, row: int) -> bool:
        """Whether a row is the first of its group."""
        return self.grouped and (row == 0 or self.rows[row][0] != self.rows[row - 1][0])

    def _cells(self) -> list[list[str]]:
        """Head and rows as shown in text; a mark hangs to the right of its column, so that the digits stand in line."""
        wide = {column for _, column in self.marked}
        lines = [[printable(name) + " " * (n in wide) for n, name in enumerate(self.head)]] if self.head else []
        for i, row in enumerate(self.rows):
            cells = [printable(c) + ("*" if (i, n) in self.marked else " " * (n in wide)) for n, c in enumerate(row)]
            if self.grouped and not self._opens(i):
                cells[0] = ""
            lines.append(cells)
        return lines
