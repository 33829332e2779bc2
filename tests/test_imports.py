"""The house's one-way streets: which package may import which, read from the source itself."""

from __future__ import annotations

import ast
import graphlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# a module may import from rooms on its own floor's list; the longest matching prefix of its name decides
ALLOWED = {
    "pipeline.common": {"pipeline.common"},
    "pipeline.config": {"pipeline.common", "pipeline.config"},
    "pipeline.distributed": {"pipeline.common"},
    "shards": {"pipeline.common", "shards"},
    "pipeline.data": {"pipeline.common", "pipeline.config", "pipeline.distributed", "shards", "pipeline.data"},
    "pipeline.model": {
        "pipeline.common", "pipeline.config", "pipeline.distributed", "shards", "pipeline.data", "pipeline.model",
    },
    "pipeline.evaluation": {
        "pipeline.common", "pipeline.config", "pipeline.distributed", "shards", "pipeline.data", "pipeline.model",
        "pipeline.evaluation",
    },
    "pipeline.training": {
        "pipeline.common", "pipeline.config", "pipeline.distributed", "shards", "pipeline.data", "pipeline.model",
        "pipeline.evaluation", "pipeline.training",
    },
    "pipeline.locate": {
        "pipeline.common", "pipeline.config", "pipeline.distributed", "shards", "pipeline.data", "pipeline.model",
        "pipeline.evaluation", "pipeline.locate",
    },
    "pipeline.paper": {"shards", "pipeline"},
    "pipeline.benchmark": {"shards", "pipeline"},
    "pipeline.api": {"shards", "pipeline"},
    "pipeline": {"pipeline.api"},
    "jobs": {"shards", "pipeline", "jobs"},
}  # fmt: skip
SOURCES = sorted(p for top in ("shards", "pipeline", "jobs") for p in (ROOT / top).rglob("*.py"))
# packages that only evaluation, tracking or figures need: importing the trainer must not load them
LATE = (
    "faiss",
    "mlflow",
    "matplotlib",
    "transformers",
    "deepspeed",
    "sklearn",
    "pandas",
    "scipy",
    "pyproj",
    "rich",
    "jinja2",
    "flask",
    "werkzeug",
)


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(tree: ast.AST) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
            names |= {f"{node.module}.{alias.name}" for alias in node.names if node.module == "pipeline"}
    return names


def inside(name: str, room: str) -> bool:
    return name == room or name.startswith(room + ".")


@pytest.mark.parametrize("path", SOURCES, ids=module_name)
def test_imports_run_one_way(path: Path) -> None:
    name = module_name(path)
    room = max((room for room in ALLOWED if inside(name, room)), key=len)
    ours = {i for i in imported(ast.parse(path.read_text())) if i.split(".")[0] in ("shards", "pipeline", "jobs")}
    wrong = {i for i in ours if i != "pipeline" and not any(inside(i, allowed) for allowed in ALLOWED[room])}
    assert not wrong, f"{name} may not import {sorted(wrong)}"


def test_common_and_shards_import_no_torch() -> None:
    for path in (*(ROOT / "shards").rglob("*.py"), *(ROOT / "pipeline" / "common").rglob("*.py")):
        assert not any(inside(i, "torch") for i in imported(ast.parse(path.read_text()))), path


@pytest.mark.parametrize("path", SOURCES, ids=module_name)
def test_heavy_packages_are_imported_where_used(path: Path) -> None:
    """At module level none of them; `import mlflow` inside the function that records is right."""
    tree = ast.parse(path.read_text())
    top_level = [n for n in tree.body if isinstance(n, ast.Import | ast.ImportFrom)]
    names = {i for node in top_level for i in imported(ast.Module(body=[node], type_ignores=[]))}
    if path.name == "transformer.py":
        names = {n for n in names if not inside(n, "transformers")}
    wrong = {n for n in names if any(inside(n, late) for late in LATE)}
    assert not wrong, f"{module_name(path)} imports {sorted(wrong)} at module level"


def test_no_two_files_import_each_other() -> None:
    """Not by a longer way round either: the imports of the files, wherever in a file they stand, have no circle."""
    known = {module_name(path) for path in SOURCES}
    imports: dict[str, set[str]] = {}
    for path in SOURCES:
        found: set[str] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                inner = {f"{node.module}.{alias.name}" for alias in node.names}
                found |= (inner & known) or {node.module}
        imports[module_name(path)] = (found & known) - {module_name(path)}
    try:
        tuple(graphlib.TopologicalSorter(imports).static_order())
    except graphlib.CycleError as error:
        pytest.fail(f"these files import each other: {' -> '.join(error.args[1])}")
