"""The ids in Gymnasium: by the entry point, by `import jaxouter`, and by a module before the id."""

from __future__ import annotations

import subprocess
import sys
import tomllib

import gymnasium
import pytest

from jaxouter import plants
from jaxouter.runtime import registration
from tests.load import ROOT

IDS = ["jaxouter/Pitch-v0", "jaxouter/Heaters-v0"]
SHOW = "import sys; print([name for name in gymnasium.registry if 'jaxouter' in name], 'jax' in sys.modules)"
SHOWN = f"{IDS} False\n"
# What the loader of Gymnasium 0.29 does with an entry point; later ones load none.
LOADER = """
import importlib.metadata
import gymnasium
from gymnasium.envs.registration import namespace
plugin = importlib.metadata.EntryPoint({name!r}, {value!r}, "gymnasium.envs")
assert plugin.attr is not None
with namespace(plugin.name):
    plugin.load()()
"""


def output(code: str) -> str:
    """What a fresh process prints; warnings are errors, and Gymnasium's go to stderr."""
    run = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert (run.stderr, run.returncode) == ("", 0)
    return run.stdout


def test_there_is_an_id_for_each_plant() -> None:
    assert {f"jaxouter/{name.capitalize()}-v0": name for name in plants.REGISTRY} == registration.IDS


def test_the_entry_point_registers_as_gymnasium_loads_it() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    ((name, value),) = project["entry-points"]["gymnasium.envs"].items()
    assert name == "jaxouter"  # the namespace of the ids
    assert output(LOADER.format(name=name, value=value) + SHOW) == SHOWN


def test_an_import_after_gymnasiums_registers_without_jax() -> None:
    assert output("import gymnasium, jaxouter\n" + SHOW) == SHOWN


def test_an_import_before_gymnasiums_imports_neither_it_nor_jax() -> None:
    code = "import jaxouter, sys; print(sorted({'gymnasium', 'jax', 'numpy'} & set(sys.modules)))"
    assert output(code) == "[]\n"


def test_an_import_without_gymnasium() -> None:
    code = "import sys; sys.modules['gymnasium'] = None; import jaxouter; print(jaxouter.__version__)"
    assert output(code).count(".") == 2


@pytest.mark.parametrize(
    ("first", "name"),
    [("", "jaxouter:jaxouter/Heaters-v0"), ("import jaxouter", "jaxouter.runtime.gymnasium:jaxouter/Heaters-v0")],
    ids=["nothing", "jaxouter"],
)
def test_an_id_with_the_module_needs_no_other_import(first: str, name: str) -> None:
    code = f"{first}\nimport gymnasium\nprint(gymnasium.make({name!r}).spec.id)"
    assert output(code) == "jaxouter/Heaters-v0\n"


def test_registering_again_changes_nothing() -> None:
    registration.register()
    before = {name: gymnasium.registry[name] for name in IDS}
    registration.register()
    assert all(gymnasium.registry[name] is before[name] for name in IDS)
