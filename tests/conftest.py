"""Strict checks for the whole suite: no silent promotion of dtypes or ranks; slow tests with --all only."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from pathlib import Path

import jax
import matplotlib
import pytest

# Tests share compiled functions with each other and with the commands that they start, not with the user's own cache.
CACHE = Path(__file__).parents[1] / ".pytest_cache" / "xla"
os.environ["JAX_COMPILATION_CACHE_DIR"] = str(CACHE)
jax.config.update("jax_compilation_cache_dir", str(CACHE))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)  # modules share small ones too
gc.set_threshold(50_000, 20, 50)  # as the commands do
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

MAPPINGS = 20_000  # of the 65,530 that Linux gives a process, unless told otherwise
LONGEST = ("test_faults", "test_devices", "test_trainer", "test_pretraining", "test_commands", "test_compare")


@pytest.fixture(scope="session", autouse=True)
def results_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Results of baselines are made anew: their cache does not know of the plants in the tests."""
    os.environ["MPLCONFIGDIR"] = matplotlib.get_cachedir()  # else matplotlib would search all fonts again
    os.environ["XDG_CACHE_HOME"] = str(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module", autouse=True)
def few_executables() -> Iterator[None]:
    """Compiled functions go with a module where there are many: XLA crashes where Linux maps no more memory."""
    yield
    maps = Path("/proc/self/maps")
    if not maps.exists() or maps.read_bytes().count(b"\n") > MAPPINGS:
        jax.clear_caches()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--all", action="store_true", help="run the tests marked slow too")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    items.sort(key=_place)
    slow = [item for item in items if item.get_closest_marker("slow")]
    if slow and not config.getoption("--all"):
        config.hook.pytest_deselected(items=slow)
        items[:] = [item for item in items if item not in slow]


def _place(item: pytest.Item) -> int:
    """Long files early, so that no process is left with one at the end; after those that compile what they need too."""
    if item.path.stem == "test_presets":
        return 0
    if item.path.parent.name in ("plants", "loop", "agents"):
        return 1
    return 2 if item.path.stem in LONGEST else 3
