"""jaxouter learns an outer loop: it sees the reference r and the output y, and chooses the modified reference r~.

run = jaxouter.learn("pitch", seed=0)
run.plot()
run.export("controller.c")
jaxouter.load(run.path).policy
"""

import importlib
import os
import sys
from typing import TYPE_CHECKING, Any

from jaxouter import versions

if sys.version_info < (3, 12):  # jaxlib 0.10 logs errors about its own compilation cache (jax issue 38445)
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

versions.warn()

if TYPE_CHECKING:
    from jaxouter.agents import Agent
    from jaxouter.api import Run, learn, load, resume
    from jaxouter.loop.environment import make
    from jaxouter.loop.policy import Policy
    from jaxouter.plants import Plant

__version__ = "0.3.0"
_MODULES = {
    "Agent": "agents",
    "Plant": "plants",
    "Policy": "loop.policy",
    "Run": "api",
    "learn": "api",
    "load": "api",
    "make": "loop.environment",
    "resume": "api",
}
__all__ = ["Agent", "Plant", "Policy", "Run", "__version__", "learn", "load", "make", "resume"]


def __getattr__(name: str) -> Any:
    """Import a name on first use, so that an exported controller does not import JAX."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name == "make":
        importlib.import_module(f"{__name__}.identification")  # for plants log:FILE
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return __all__


if sys.modules.get("gymnasium.envs.registration"):  # else not imported for this: it takes 0.2 s, and few need it
    from jaxouter.runtime.registration import register as _register

    _register()
