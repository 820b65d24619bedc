"""jaxouter learns an outer loop: it sees the reference r and the output y, and chooses the modified reference r~."""

import os
import sys
from typing import TYPE_CHECKING, Any

if sys.version_info < (3, 12):  # jaxlib 0.10 logs errors about its own compilation cache (jax issue 38445)
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

if TYPE_CHECKING:
    from jaxouter.loop.environment import make

__all__ = ["__version__", "make"]
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """Import `make` on first use, so that an exported controller does not import JAX."""
    if name != "make":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from jaxouter.loop.environment import make

    return make


if sys.modules.get("gymnasium.envs.registration"):  # else not imported for this: it takes 0.2 s, and few need it
    from jaxouter.runtime.registration import register as _register

    _register()
