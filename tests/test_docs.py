"""What the documents show a person exists: their commands parse, their links and files are there."""

from __future__ import annotations

import importlib
import re
import shlex
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def commands() -> list[tuple[str, str]]:
    """(page, command) of every `-m jobs.X` in a code block or a code span."""
    found = []
    for page in PAGES:
        text = page.read_text().replace("\\\n", " ")
        blocks = re.findall(r"```(?:sh|bash|console)?\n(.*?)```", text, re.DOTALL)
        lines = [line.removeprefix("$ ") for block in blocks for line in block.splitlines()]
        lines += re.findall(r"(?<!`)`([^`\n]+)`(?!`)", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
        found += [(page.name, line.split(" #")[0].strip()) for line in lines if re.search(r"-m jobs\.\w+", line)]
    return sorted(set(found))


class Parsed(Exception):
    """The command line was accepted; the job itself is not run here."""


@pytest.mark.parametrize(("page", "command"), commands(), ids=lambda value: str(value)[:60])
def test_every_shown_command_parses(page: str, command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    words = shlex.split(command)
    at = words.index("-m") + 1
    name, arguments = words[at], [w for w in words[at + 1 :] if w not in ("...", "[overrides]")]
    for stop in ("|", "&&", ";", ">", "&"):
        arguments = arguments[: arguments.index(stop)] if stop in arguments else arguments
    module = importlib.import_module(name)
    entry = "parse_part" if hasattr(module, "parse_part") else "parse"
    real = getattr(module, entry)

    def parse(*given: Any, **named: Any) -> Any:
        real(*given, **named)
        raise Parsed

    monkeypatch.chdir(ROOT)
    monkeypatch.setattr("sys.argv", [name, *arguments])
    monkeypatch.setattr(module, entry, parse)
    if "--help" in arguments:
        with pytest.raises(SystemExit):
            module.main()
    else:
        with pytest.raises(Parsed):
            module.main()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_named_files_exist(page: Path) -> None:
    text = page.read_text()
    for target in re.findall(r"\]\((?!https?:|#)([^)#]+)", text):
        assert (page.parent / target).exists(), f"{page.name} links to {target}"
    for named in re.findall(r"`((?:jobs|tests|docs|pipeline|shards)/[\w/.-]+\.(?:py|yaml|md|sbatch))(?:::\w+)?`", text):
        assert (ROOT / named).exists(), f"{page.name} names {named}"


def test_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text()
    for page in PAGES:
        for target in re.findall(r"(?:`|^)make ([a-z][a-z-]+)", page.read_text(), re.MULTILINE):
            assert re.search(rf"^{target}:", makefile, re.MULTILINE), f"{page.name} shows make {target}"
