"""The house's one-way streets: which package may import which, read from the source itself."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# a module may import from rooms on its own floor's list; the longest matching prefix of its name decides
ALLOWED = {
    "shards": {"shards"},
    "pipeline.config": {"shards", "pipeline.config"},
    "pipeline.distributed": {"shards"},
    "pipeline.data": {"shards", "pipeline.config", "pipeline.distributed", "pipeline.data"},
    "pipeline.model": {"shards", "pipeline.config", "pipeline.distributed", "pipeline.data", "pipeline.model"},
    "pipeline.evaluation": {
        "shards", "pipeline.config", "pipeline.distributed", "pipeline.data", "pipeline.model", "pipeline.evaluation",
    },
    "pipeline.training": {"shards", "pipeline"},
    "pipeline.benchmark": {"shards", "pipeline"},
    "pipeline.paper": {"shards", "pipeline"},
    "pipeline": set(),
    "jobs": {"shards", "pipeline", "jobs"},
}  # fmt: skip
SOURCES = sorted(p for top in ("shards", "pipeline", "jobs") for p in (ROOT / top).rglob("*.py"))
# packages that only evaluation, tracking or figures need: importing the trainer must not load them
LATE = ("faiss", "mlflow", "matplotlib", "transformers", "deepspeed", "sklearn", "pandas", "scipy")


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


def test_shards_import_no_torch() -> None:
    for path in (ROOT / "shards").rglob("*.py"):
        assert not any(inside(i, "torch") for i in imported(ast.parse(path.read_text()))), path


@pytest.mark.parametrize("path", SOURCES, ids=module_name)
def test_heavy_packages_are_imported_where_used(path: Path) -> None:
    """At module level none of them; `import mlflow` inside the function that records is right."""
    tree = ast.parse(path.read_text())
    top_level = [n for n in tree.body if isinstance(n, ast.Import | ast.ImportFrom)]
    names = {i for node in top_level for i in imported(ast.Module(body=[node], type_ignores=[]))}
    if "model" in path.parts and path.name == "backbone.py":
        names = {n for n in names if not inside(n, "transformers")}
    wrong = {n for n in names if any(inside(n, late) for late in LATE)}
    assert not wrong, f"{module_name(path)} imports {sorted(wrong)} at module level"


@pytest.mark.parametrize("path", SOURCES, ids=module_name)
def test_a_file_is_a_room_not_a_hall(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 350, f"{module_name(path)} is over 350 lines: split it by its nouns"
