"""Imports point backwards along the way the data flows."""

import ast
from pathlib import Path

import pytest

import jaxouter

LEAVES = ["progress", "terminal"]  # that show something, and import nothing else
ORDER = [
    "plants",
    "loop",
    "identification",
    "agents",
    "tasks",
    "training",
    "evaluation",
    "exports",
    "runtime",
    "api",
]
PACKAGE = Path(jaxouter.__file__).parent
MODULES = sorted(path for path in PACKAGE.glob("*/**/*.py"))


def imported(path: Path) -> set[str]:
    """Modules of this package that a file imports."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return {name for name in names if name.startswith("jaxouter.")}


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_backwards(path):
    allowed = LEAVES + ORDER[: ORDER.index(path.relative_to(PACKAGE).parts[0]) + 1]
    for name in imported(path):
        assert name.split(".")[1] in allowed, f"{path} imports {name}"


def test_agents_know_nothing_of_plants():
    for path in (PACKAGE / "agents").glob("*.py"):
        assert all(name.split(".")[1] == "agents" for name in imported(path))
