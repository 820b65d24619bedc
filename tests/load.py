"""Scripts of folders that are no packages."""

import importlib.util
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]


def load(folder: str, name: str) -> Any:
    """The module of a script, such as that of `benchmarks/slower.py`."""
    if str(ROOT / folder) not in sys.path:
        sys.path.append(str(ROOT / folder))  # a script imports what lies next to it
    spec = importlib.util.spec_from_file_location(f"{folder}_{name}", ROOT / folder / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where its dataclasses look for their annotations
    spec.loader.exec_module(module)
    return module
