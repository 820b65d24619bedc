"""Versions of jaxlib that must not be used; the requirements exclude them, but an environment may still have one."""

from __future__ import annotations

import warnings
from importlib.metadata import PackageNotFoundError, version

FAULTS = {
    "0.10.2": "computes wrongly on a CPU, without a word (jax issue 39103)",
    "0.11.0": "is not supported: it precedes the repairs of 0.11.2 (jax issues 39103, 40101)",
    "0.11.1": "copies the whole replay at each write (jax issue 40101)",
}


CURE = "install another: python -m pip install --upgrade jaxouter"


def warn() -> None:
    """Warn if the installed jaxlib is one of `FAULTS`. A loop that runs an exported controller has none."""
    try:
        installed = version("jaxlib")
    except PackageNotFoundError:
        return
    if installed in FAULTS:
        warnings.warn(
            f"jaxlib {installed} {FAULTS[installed]}; {CURE}",
            stacklevel=3,  # who imports jaxouter
        )
