"""What a setting is beside its type and default: its range, and what changing it means. Said once, at the field.

    workers: int = setting(4, changes="speed", at_least=0, at_most=MANY)

Invariant: a config cannot hold a value outside its type and range, whether it was built in Python, by
`dataclasses.replace`, from a file or from the command line: `Settings` checks when it is built.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import functools
import math
import reprlib
import types
import typing
from collections.abc import Iterator
from typing import Any, Literal, TypeVar

from pipeline.common.errors import UsageError
from pipeline.common.text import shown
from pipeline.config.image_size import ANY, FIXED, parsed

Value = TypeVar("Value")
Changes = Literal["numbers", "speed", "none"]
OnResume = Literal["refused", "free", "free unless train.schedule=cosine"]
LONGEST = 4096  # characters of a text: a path's limit on Linux


class SettingError(UsageError):
    """A value outside its setting's type or range. `prefix` puts the section before the setting's name."""

    def __init__(self, name: str, wanted: str, value: Any) -> None:
        self.name, self.wanted, self.value = name, wanted, value
        super().__init__(f"{name} must be {wanted}; it is {shortened(value)}")

    def prefix(self, where: str) -> SettingError:
        """The same error about `where` + the setting's name."""
        return SettingError(where + self.name, self.wanted, self.value)


def setting(
    default: Value,
    *,
    changes: Changes,
    resume: OnResume | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
    above: float | None = None,
    below: float | None = None,
    may_be_empty: bool = False,
    file_name: bool = False,
    image_size: Literal["fixed", "any", ""] = "",
    formerly: str = "",
) -> Value:
    """A field of a `Settings` class.

    Args:
        default: its value where nothing is said.
        changes: what another value changes: `numbers`, the results; `speed`, only time and memory; `none`, only where
            and how a run is recorded.
        resume: whether a resumed run may change it; by default only where it does not change numbers.
        at_least, at_most, above, below: bounds of a number, or of each number of a tuple. Numbers are always finite.
        may_be_empty: whether a text or a tuple may be empty.
        file_name: the text becomes a plain file name: no separators, not hidden, at most 200 bytes.
        image_size: the value is a size of input (`image_size.ImageSize`), `native` among them or not.
        formerly: the name it has in older configs.
    """
    about = {
        "changes": changes,
        "resume": resume,
        "at_least": at_least, "at_most": at_most, "above": above, "below": below,
        "may_be_empty": may_be_empty, "file_name": file_name, "image_size": image_size, "formerly": formerly,
    }  # fmt: skip
    return dataclasses.field(default=default, metadata=about)


class Settings:
    """Base of the frozen config dataclasses: a new one is checked.

    Raises:
        SettingError: with the setting's name, its value and its range.
    """

    def __post_init__(self) -> None:
        check(self)


def check(config: Any) -> None:
    """Refuses a frozen dataclass whose own fields (not its sections') are outside their types or ranges.

    Lists become tuples, whole numbers floats where a float is wanted, and sizes of input take their canonical form.
    Raises `SettingError`.
    """
    kind: type = type(config)
    hints = type_hints(kind)
    for field in dataclasses.fields(config):
        given = getattr(config, field.name)
        try:
            value = _fitting(field.metadata, hints[field.name], given)
        except ValueError:
            raise SettingError(field.name, wanted(field, hints[field.name]), given) from None
        if type(value) is not type(given) or value != given:
            object.__setattr__(config, field.name, value)


@functools.cache
def type_hints(kind: Any) -> dict[str, Any]:
    """The types of a dataclass' fields."""
    return typing.get_type_hints(kind)


def is_section(hint: Any) -> bool:
    """Whether a field of this type holds settings of its own."""
    return dataclasses.is_dataclass(hint)


def leaves(kind: type, where: str = "") -> Iterator[tuple[str, dataclasses.Field[Any]]]:
    """Dotted name and field of every setting of a config class, those of its sections included."""
    hints = type_hints(kind)
    for field in dataclasses.fields(kind):
        if is_section(hints[field.name]):
            yield from leaves(hints[field.name], f"{where}{field.name}.")
        else:
            yield where + field.name, field


@functools.cache
def changing(kind: type, *what: Changes) -> frozenset[str]:
    """Dotted names of the settings whose change means one of `what`."""
    return frozenset(name for name, field in leaves(kind) if field.metadata["changes"] in what)


@functools.cache
def on_resume(kind: type, section: OnResume | None = None) -> dict[str, OnResume]:
    """Dotted name of every setting -> whether a resumed run may change it. `section`: what holds for all of `kind`."""
    told: dict[str, OnResume] = {}
    for field in dataclasses.fields(kind):
        own: OnResume | None = section or field.metadata.get("resume")
        inner = type_hints(kind)[field.name]
        if is_section(inner):
            told |= {f"{field.name}.{name}": value for name, value in on_resume(inner, own).items()}
        else:
            told[field.name] = own or ("refused" if field.metadata["changes"] == "numbers" else "free")
    return told


def present_name(kind: type, name: str) -> str:
    """The present name of a dotted setting of an older config; names of today are returned as they are."""
    first, dot, rest = name.partition(".")
    for field in dataclasses.fields(kind):
        if first and first in (field.name, field.metadata.get("formerly")):
            inner = type_hints(kind)[field.name]
            return field.name + dot + (present_name(inner, rest) if is_section(inner) else rest)
    return name


def unknown(name: str, known: list[str]) -> UsageError:
    """The error for a setting that does not exist, with the nearest known name."""
    near = nearest(name, known)
    hint = (
        f"did you mean '{near}'?" if near else "--help lists all" if len(known) > 20 else f"known: {', '.join(known)}"
    )
    return UsageError(f"unknown setting {shortened(name)}; {hint}")


def nearest(word: str, known: list[str]) -> str | None:
    """The known dotted name that a mistyped one most likely means."""
    last = word.rsplit(".", 1)[-1]
    near = [name for name in known if name.rsplit(".", 1)[-1] == last]  # right name, wrong or no section
    near = near or difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    near = near or [n for n in known if difflib.get_close_matches(last, [n.rsplit(".", 1)[-1]], cutoff=0.7)]
    return near[0] if near and near[0] != word else None


def did_you_mean(word: str, known: list[str]) -> str:
    """` (did you mean 'train.lr'?)`, or nothing."""
    near = nearest(word, known)
    return f" (did you mean '{near}'?)" if near else ""


def shortened(value: Any) -> str:
    """A value as one short line of printable characters, however large it is."""
    brief = reprlib.Repr()
    brief.maxstring = brief.maxother = brief.maxlong = 80
    brief.maxlevel = 2
    return shown(brief.repr(value))


def wanted(field: dataclasses.Field[Any], hint: Any) -> str:
    """What a field takes, in words: "a whole number of at least 1, or none"."""
    about = field.metadata
    if about.get("image_size"):
        optional = ", or none" if types.NoneType in typing.get_args(hint) else ""
        return (FIXED if about["image_size"] == "fixed" else ANY) + optional
    if alternatives(hint) != (hint,):
        told = [wanted(field, kind) for kind in alternatives(hint)]
        return ", or ".join(told + ["none"] * (types.NoneType in typing.get_args(hint)))
    if typing.get_origin(hint) is tuple:
        many = "a list, each " if about.get("may_be_empty", True) else "a list of at least one, each "
        return many + wanted(field, typing.get_args(hint)[0])
    if typing.get_origin(hint) is dict:
        return "names, each with " + wanted(field, typing.get_args(hint)[1])
    if typing.get_origin(hint) is Literal:
        return "one of " + ", ".join(map(str, typing.get_args(hint)))
    if hint is bool:
        return "true or false"
    if hint is str:
        if about.get("file_name"):
            return "a plain file name of at most 200 bytes, without / and not beginning with a point"
        return f"a text of at most {LONGEST} characters without control characters" + (
            "" if about.get("may_be_empty", True) else ", not empty"
        )
    words = {"at_least": "at least", "above": "above", "at_most": "at most", "below": "below"}
    bounds = [f"{word} {about[key]:,}" for key, word in words.items() if about.get(key) is not None]
    number = "a whole number" if hint is int else "a number" if bounds else "a finite number"
    return number + (", " + " and ".join(bounds) if bounds else "")


def _fitting(about: Any, hint: Any, value: Any) -> Any:
    """Raises ValueError where `value` is not of the type `hint` or outside the range in `about`."""
    if about.get("image_size") and value is not None:
        return parsed(value, about["image_size"] == "fixed").setting
    if alternatives(hint) != (hint,):
        if value is None and types.NoneType in typing.get_args(hint):
            return None
        for kind in alternatives(hint):
            with contextlib.suppress(ValueError):
                return _fitting(about, kind, value)
        raise ValueError
    if typing.get_origin(hint) is tuple:
        if not isinstance(value, (tuple, list)) or not (value or about.get("may_be_empty", True)):
            raise ValueError
        items = tuple(_fitting({**about, "may_be_empty": False}, typing.get_args(hint)[0], item) for item in value)
        return items
    if typing.get_origin(hint) is dict:
        keys, values = typing.get_args(hint)
        if not isinstance(value, dict):
            raise ValueError
        return {_fitting({}, keys, key): _fitting(about, values, inner) for key, inner in value.items()}
    if typing.get_origin(hint) is Literal:
        right = any(type(value) is type(choice) and value == choice for choice in typing.get_args(hint))
    elif hint is str:
        right = isinstance(value, str) and _text(value, about)
    elif hint is float and type(value) is int and abs(value) < 2**53:
        return _fitting(about, hint, float(value))
    elif hint in (int, float):
        right = type(value) is hint and abs(value) < 2**63 and math.isfinite(value) and _within(about, value)
    else:
        right = isinstance(value, hint)
    if not right:
        raise ValueError
    return value


def _within(about: Any, value: float) -> bool:
    low, high, above, below = (about.get(key) for key in ("at_least", "at_most", "above", "below"))
    return not (
        (low is not None and value < low)
        or (high is not None and value > high)
        or (above is not None and value <= above)
        or (below is not None and value >= below)
    )


def _text(value: str, about: Any) -> bool:
    if len(value) > LONGEST or any(ord(c) < 32 or 0x7F <= ord(c) < 0xA0 or 0xD800 <= ord(c) < 0xE000 for c in value):
        return False
    if about.get("file_name"):
        return bool(value) and not set(value) & set("/\\") and value[0] != "." and len(value.encode()) <= 200
    # each part of a path has at most 255 bytes
    return bool(value or about.get("may_be_empty", True)) and all(len(p.encode()) < 256 for p in value.split("/"))


def alternatives(hint: Any) -> tuple[Any, ...]:
    """The types that a setting takes, None left out."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return tuple(kind for kind in typing.get_args(hint) if kind is not types.NoneType)
    return (hint,)
