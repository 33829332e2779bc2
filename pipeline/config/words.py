"""What the words of a config file or of an option mean; a word of a file means the same as an option.

YAML 1.1 turns `off`, `no`, `123`, `010`, `1:30` and `2024-01-01` into other types before anybody can ask what the
setting takes. Here a scalar stays the text that was written, and the setting's own type reads it (`from_text`).
"""

from __future__ import annotations

import contextlib
import re
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from pipeline.common.errors import UsageError
from pipeline.common.text import shown
from pipeline.config.setting import (
    alternatives,
    did_you_mean,
    is_section,
    leaves,
    present_name,
    shortened,
    type_hints,
)

WORDS = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}
LARGEST = 1 << 20  # bytes; the largest of ours has three thousand


class _Texts(yaml.BaseLoader):
    """Every scalar a text; a key that comes twice is an error, not the last one's value."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"'{key.value}' comes twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def read_config(path: str) -> dict[str, Any]:
    """The settings of a YAML file: names -> a text, a list of texts, or a section's dict of the same.

    Raises:
        UsageError: no such file, or one that is no YAML mapping.
    """
    try:
        if not Path(path).is_file():
            raise UsageError(f"{shortened(path)}: no such config file")
        with Path(path).open("rb") as stream:
            content = stream.read(LARGEST + 1)
    except (OSError, ValueError) as error:
        raise UsageError(f"{shortened(path)}: cannot be read ({error})") from None
    if len(content) > LARGEST:
        raise UsageError(f"{path}: more than {LARGEST:,} bytes; this is no config file")
    told = read_texts(content, path)
    if told in (None, ""):
        return {}
    if not isinstance(told, dict):
        raise UsageError(f"{path}: settings are written as `name: value`; this file holds {shortened(told)}")
    return told


def file_settings(kind: type, path: str) -> list[tuple[str, Any]]:
    """(dotted name, value) of all settings in a YAML file of config class `kind`, as `from_text` reads them.

    Raises:
        UsageError: as `read_config`; a setting that does not exist, with the nearest known name.
    """
    found: list[tuple[str, Any]] = []

    def walk(inner: type, values: Mapping[str, Any], where: str) -> None:
        hints = type_hints(inner)
        for given, value in values.items():
            name = present_name(inner, given)
            if name not in hints:
                told, known = where + given, [name for name, _ in leaves(kind)]
                raise UsageError(f"{path}: there is no setting {shown(told)}{did_you_mean(told, known)}")
            if not is_section(hints[name]):
                found.append((where + name, from_text(hints[name], value)))
            elif isinstance(value, dict):
                walk(hints[name], value, f"{where}{name}.")
            elif value != "":  # a section with nothing in it
                raise UsageError(f"{path}: {where}{name} is a section with settings of its own, not {shortened(value)}")

    walk(kind, read_config(path), "")
    return found


def read_texts(content: bytes | str, where: str) -> Any:
    """YAML with every scalar as its text. Raises `UsageError`."""
    try:
        return yaml.load(content, _Texts)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        raise UsageError(
            f"{where}{line}: not YAML ({shown(getattr(error, 'problem', None) or ' '.join(str(error).split()))})"
        ) from None
    except (RecursionError, UnicodeError, ValueError, TypeError) as error:
        raise UsageError(f"{where}: not YAML ({type(error).__name__})") from None


def from_text(hint: Any, given: Any) -> Any:
    """What the words of a file or an option mean for a setting of type `hint`.

    Args:
        hint: the setting's type.
        given: a text; for a tuple also a list of texts, or `a,b`, or `[a, b]`.

    Returns:
        The value; or `given` itself where it means nothing for that type, which `check` will then refuse.
    """
    kinds = alternatives(hint)
    if types.NoneType in typing.get_args(hint) and given in ("none", "null", ""):
        return None
    if kinds != (hint,):
        many = isinstance(given, list) or str(given).startswith("[")
        return from_text(next((k for k in kinds if (typing.get_origin(k) is tuple) == many), kinds[0]), given)
    if typing.get_origin(hint) is tuple:
        items = _items(given) if isinstance(given, str) else given
        return tuple(from_text(typing.get_args(hint)[0], item) for item in items) if isinstance(items, list) else given
    if not isinstance(given, str):
        return given
    if hint is bool:
        return WORDS.get(given.lower(), given)
    if hint is int:  # 010 would be 8 to YAML 1.1 and 10 to others
        return int(given) if re.fullmatch(r"[+-]?(0|[1-9][0-9_]{0,20})", given) else given
    if hint is float:
        with contextlib.suppress(ValueError):
            return float(given)
    return given


def _items(text: str) -> Any:
    """`a,b` or `[a, "b, c"]` -> a list of texts."""
    return read_texts(text, shortened(text)) if text.startswith("[") else [item for item in text.split(",") if item]
