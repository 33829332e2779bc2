"""One way to start a job: typed dataclass -> YAML file + command-line overrides, errors as one line, exit codes.

The list of options and `--help` are made from the dataclass alone. An option's name is its YAML key,
`--data.places_per_batch`; dashes are read as underscores. A word means the same in a file and as an option: the
setting's own type reads it (`pipeline.config.words`), and its range is checked when the dataclass is built.

Exit codes: 0 done, 2 usage or configuration, 3 data, 4 diverged, 75 preempted and saved (`pipeline.common.errors`),
130 interrupted.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import inspect
import os
import shutil
import sys
import textwrap
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NoReturn, TypeVar

from pipeline.common.errors import UsageError, tell_launcher, told
from pipeline.common.text import shown
from pipeline.config import RunConfig, from_dict, nested
from pipeline.config.setting import alternatives, did_you_mean, present_name
from pipeline.config.words import file_settings, from_text

Config = TypeVar("Config")


@dataclasses.dataclass(frozen=True)
class Option:
    """One option of a job.

    Attributes:
        name: `data.places_per_batch`, without the two dashes.
        hint: its type.
        default: its value where neither file nor command line gives one.
        doc: what it means.
        group: the heading that it stands under in `--help`.
    """

    name: str
    hint: Any
    default: Any
    doc: str
    group: str


def parse(
    kind: type[Config],
    description: str,
    argv: Sequence[str] | None = None,
    config_file: bool = True,
    program: str | None = None,
) -> Config:
    """Parses the command line into the frozen dataclass `kind`.

    Args:
        kind: the dataclass; nested dataclasses become dotted options.
        description: first lines of `--help`; indented lines are examples and stay as they are.
        argv: arguments, `sys.argv[1:]` by default. A bool field is a switch; a tuple may be given as `a,b`;
            `none` is None.
        config_file: whether `--config FILE` (YAML) is accepted; later options override it.
        program: name in the usage line; none: that of the job.

    Raises:
        UsageError: an unknown key (with the nearest known one), a value outside its type or range, a missing file.
        SystemExit: after `--help`.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    known = options(kind)
    if "-h" in words or "--help" in words:
        print(help_text(program or program_name(), description, known, config_file))
        raise SystemExit(0)
    hints = {o.name: o.hint for o in known} | ({"config": str} if config_file else {})
    values: dict[str, Any] = {}
    for name, text in _pairs(kind, words, hints):
        for setting, value in file_settings(kind, text) if name == "config" else [(name, from_text(hints[name], text))]:
            values[setting] = value
    built: Config = from_dict(kind, nested(values))
    return built


def parse_part(parts: Mapping[str, type], description: str, argv: Sequence[str] | None = None) -> tuple[str, Any]:
    """The first word, which is one of `parts`, and the rest of the command line parsed as that part's dataclass.

    Raises:
        UsageError: no such part, or as `parse`; SystemExit: after `--help`.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    if not words or words[0] in ("-h", "--help"):
        told = "\n".join(f"  {name:<12}{(kind.__doc__ or '').splitlines()[0]}" for name, kind in parts.items())
        print(f"usage: {_command(program_name())} PART [options]\n\n{description.strip()}\n\nparts:\n{told}")
        print(f"\n{_command(program_name())} PART --help tells a part's options")
        raise SystemExit(0 if words else 2)
    name = words[0]
    if name not in parts:
        near = difflib.get_close_matches(name, parts, n=1)
        raise UsageError(
            f"no part '{name}'" + (f" (did you mean '{near[0]}'?)" if near else "") + f"; parts are {', '.join(parts)}"
        )
    kind = parts[name]
    return name, parse(
        kind, inspect.getdoc(kind) or "", words[1:], issubclass(kind, RunConfig), f"{program_name()} {name}"
    )


def run_job(main: Callable[[], Any]) -> NoReturn:
    """Runs a job's main; turns what a user can mend (`errors.told`) into one line on stderr and its exit code.

    Of the processes of a machine the first tells what all raise; a launcher shows it again, after its own traceback.
    """
    try:
        main()
        code = 0
    except KeyboardInterrupt:
        print(f"{program_name()}: interrupted", file=sys.stderr)
        code = 130
    except BrokenPipeError:  # the reader (head, less) has left; that is not our failure
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except Exception as error:
        if (mended := told(error)) is None:
            raise
        line = f"{program_name()}: {mended}"
        if mended is not error or os.environ.get("LOCAL_RANK", "0") == "0":
            print(line, file=sys.stderr)
        tell_launcher(line)
        code = mended.exit_code
    sys.exit(code)


def options(kind: type, values: Any = None, prefix: str = "", group: str = "") -> list[Option]:
    """The options of a dataclass as `--help` orders them: the job's own, the inherited, those of nested dataclasses."""
    values = kind() if values is None else values
    hints = typing.get_type_hints(kind)
    documented: dict[str, str] = {}
    classes: dict[str, type] = {}
    for base in reversed(kind.__mro__):
        if dataclasses.is_dataclass(base):
            documented |= _docs(base)
            classes |= dict.fromkeys(vars(base).get("__annotations__", {}), base)
    own: list[Option] = []
    inherited: list[Option] = []
    nested: list[Option] = []
    for field in dataclasses.fields(kind):
        value, doc = getattr(values, field.name), documented.get(field.name, "")
        name = prefix + field.name
        if dataclasses.is_dataclass(hints[field.name]):
            nested += options(hints[field.name], value, f"{name}.", f"{name}: {doc}")
        elif classes[field.name] is kind or prefix:
            own.append(Option(name, hints[field.name], value, doc, group))
        else:
            heading = (classes[field.name].__doc__ or "").split(". ")[0].split(".\n")[0].strip().rstrip(".")
            inherited.append(Option(name, hints[field.name], value, doc, heading))
    return own + inherited + nested


def help_text(program: str, description: str, known: Sequence[Option], config_file: bool) -> str:
    """The text of `--help`: what the job does, examples, then the options in groups, most wanted first."""
    lines = [f"usage: {_command(program)} {'[--config FILE] ' if config_file else ''}[options]", ""]
    lines += [description.strip(), "", "options:"]
    width = min(110, shutil.get_terminal_size((100, 24)).columns)
    if config_file:
        lines += _entry("--config FILE", "YAML file of these settings; options after it override its values.", width)
    group = ""
    for option in known:
        if option.group != group:
            group = option.group
            lines += ["", *textwrap.wrap(group, width)]
        default = _shown(option.default)
        value = _metavar(option.hint)
        doc = option.doc + ("" if default is None else f" (default: {default})")
        if len(value) > width - 30:
            value, doc = "NAME", f"{doc} One of {value.strip('{}').replace(',', ', ')}."
        lines += _entry(f"--{option.name} {value}".rstrip(), doc, width)
    return "\n".join(lines)


def program_name() -> str:
    """`jobs.train` under `python -m`, `vpr-train` as a console command."""
    spec = getattr(sys.modules.get("__main__"), "__spec__", None)
    return spec.name.removesuffix(".__main__") if spec is not None else Path(sys.argv[0]).name


def _command(program: str) -> str:
    return f"python -m {program}" if program.startswith("jobs.") else program


@functools.cache
def _docs(kind: type) -> dict[str, str]:
    """Field -> its docstring, of this class alone."""
    from docstring_parser import parse_from_object

    return {p.arg_name: " ".join((p.description or "").split()) for p in parse_from_object(kind).params}


def _entry(left: str, doc: str, width: int) -> list[str]:
    wrapped = textwrap.wrap(doc, width - 30) or [""]
    first = [f"  {left}"] if len(left) > 26 else [f"  {left:<27} {wrapped.pop(0)}"]
    return first + [" " * 30 + line for line in wrapped]


def _metavar(hint: Any) -> str:
    """What stands after an option in `--help`: nothing for a switch, N, X, TEXT, {a,b} or A,B,..."""
    hint = alternatives(hint)[0]
    if typing.get_origin(hint) is Literal:
        return "{" + ",".join(map(str, typing.get_args(hint))) + "}"
    if typing.get_origin(hint) is tuple:
        inner = _metavar(typing.get_args(hint)[0])
        return f"{inner},..."
    return {bool: "", int: "N", float: "X"}.get(hint, "TEXT")


def _shown(value: Any) -> str | None:
    """A default as it would be typed; None where there is nothing to say."""
    if value is None or value == "" or value == ():
        return None
    if isinstance(value, bool):
        return "on; off with 'false'" if value else None
    if isinstance(value, tuple):
        return ",".join(map(str, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def _pairs(kind: type, argv: Sequence[str], hints: Mapping[str, Any]) -> list[tuple[str, str]]:
    """(setting, text) of each option: `--max-bad 1` is max_bad, a switch is `true`, a former name is today's.

    Raises:
        UsageError: an option that does not exist, one without a value, or a value without an option.
    """
    pairs: list[tuple[str, str]] = []
    words = list(argv)
    while words:
        word = words.pop(0)
        if not word.startswith("--"):
            raise UsageError(f"'{shown(word)}' is not an option; write --NAME {shown(word)}")
        name, equals, value = word[2:].partition("=")
        name = present_name(kind, name.replace("-", "_"))
        if name not in hints:
            raise UsageError(f"there is no option --{shown(name)}{did_you_mean(name, list(hints))}")
        if not equals and words and not words[0].startswith("--"):
            value = words.pop(0)
        elif not equals and hints[name] is bool:
            value = "true"
        elif not equals:
            raise UsageError(f"--{name} needs a value")
        pairs.append((name, value))
    return pairs
