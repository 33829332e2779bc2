"""Text for people: names and values from outside, made safe to show in one line.

Invariant: what `shown` returns is one line of printable characters, whatever a file is called.
"""

from __future__ import annotations

LIMIT = 200  # characters shown of a name or value


def shown(name: object, limit: int = LIMIT) -> str:
    r"""A file name, or a value read from a file, as one printable line of at most about `limit` characters.

    Newlines, terminal escapes, other control characters, marks of writing direction and bytes that are no UTF-8 appear
    as `\n`, `\x1b`, `\u202e`, `\udcff`; a longer text loses its middle. Ordinary names are returned as they are.
    """
    text = str(name)
    if len(text) > limit:
        text = f"{text[: limit // 2]}...{text[len(text) - limit // 2 :]}"
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text)
