"""One way to start a job: typed dataclass -> YAML file + command-line overrides, errors as one line, exit codes.

jsonargparse was chosen over tyro after trying both on `RunConfig`: both show `--help` in about 0.25 s, but
jsonargparse reads `--config FILE` and then overrides in order, with the file's keys checked against the types,
where tyro needs the file parsed and turned into a default first.

Exit codes: 0 done, 2 usage or configuration, 3 data, 4 diverged, 75 preempted and saved (`pipeline.common.errors`).
"""

from __future__ import annotations

import difflib
import json
import os
import re
import sys
import typing
from collections.abc import Callable, Sequence
from typing import Any, NoReturn, TypeVar

from pipeline.common.errors import UsageError, UserError

Config = TypeVar("Config")


def parse(kind: type[Config], description: str, argv: Sequence[str] | None = None, config_file: bool = True) -> Config:
    """Parses the command line into the frozen dataclass `kind`.

    Args:
        kind: the dataclass; nested dataclasses become dotted options.
        description: first lines of `--help`.
        argv: arguments, `sys.argv[1:]` by default. Dashes in option names are underscores; a bool field is a
            switch; a tuple may be given as `a,b`.
        config_file: whether `--config FILE` (YAML) is accepted; later options override it.

    Raises:
        UsageError: an unknown key (with the nearest known one), a value of the wrong type, a missing file.
    """
    from jsonargparse import ArgumentParser, set_parsing_settings

    set_parsing_settings(docstring_parse_attribute_docstrings=True)

    class Parser(ArgumentParser):
        def error(self, message: str, ex: Exception | None = None) -> NoReturn:
            raise UsageError(_readable(message, known))

    parser = Parser(description=description, prog=_program(), default_env=False)
    if config_file:
        parser.add_argument("--config", action="config", help="YAML file; options after it override its values")
    parser.add_class_arguments(kind, as_group=True)
    known = [o[2:] for action in parser._actions for o in action.option_strings if o.startswith("--")]
    values = parser.parse_args(_normalise(sys.argv[1:] if argv is None else argv, parser))
    built = parser.instantiate(values)
    return kind(**{key: value for key, value in vars(built).items() if key != "config"})


def run_job(main: Callable[[], Any]) -> NoReturn:
    """Runs a job's main; turns a `UserError` into one line on stderr and its exit code."""
    try:
        main()
        code = 0
    except UserError as error:
        print(f"{_program()}: {error}", file=sys.stderr)
        code = error.exit_code
    except KeyboardInterrupt:
        print(f"{_program()}: interrupted", file=sys.stderr)
        code = 130
    except BrokenPipeError:  # the reader (head, less) has left; that is not our failure
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    sys.exit(code)


def _program() -> str:
    spec = getattr(sys.modules.get("__main__"), "__spec__", None)
    return spec.name if spec is not None else sys.argv[0]


def _normalise(argv: Sequence[str], parser: Any) -> list[str]:
    """`--max-bad` for `--max_bad`; a switch without a value, `--dry-run`; `--sets a,b` for `--sets '["a", "b"]'`."""
    hints = {option: getattr(a, "_typehint", None) for a in parser._actions for option in a.option_strings}
    words: list[str] = []
    for word in argv:
        if word.startswith("--"):
            if words and hints.get(words[-1]) is bool:
                words.append("true")
            name, equals, value = word.partition("=")
            name = "--" + name[2:].replace("-", "_")
            words += [name, value] if equals else [name]
        else:
            words.append(word)
        if len(words) > 1 and typing.get_origin(hints.get(words[-2])) is tuple and not words[-1].startswith("["):
            kinds = typing.get_args(hints[words[-2]])
            items = [i for i in words[-1].split(",") if i]
            words[-1] = "[" + ", ".join(items if int in kinds else map(json.dumps, items)) + "]"
    if words and hints.get(words[-1]) is bool:
        words.append("true")
    return words


def _readable(message: str, known: list[str]) -> str:
    """One line of the parser's message, with the nearest known name where a key is unknown."""
    line = " ".join(message.split())
    unknown = re.search(r"(?:unrecognized arguments: --|[Kk]ey '|option ')([\w.-]+)", line)
    if unknown:
        word = unknown.group(1)
        last = word.rsplit(".", 1)[-1]
        near = [name for name in known if name.rsplit(".", 1)[-1] == last]  # right name, wrong or no section
        near = near or difflib.get_close_matches(word, known, n=1, cutoff=0.5)
        near = near or [n for n in known if difflib.get_close_matches(last, [n.rsplit(".", 1)[-1]], cutoff=0.7)]
        if near and near[0] != word:
            line += f" (did you mean '{near[0]}'?)"
    return line
