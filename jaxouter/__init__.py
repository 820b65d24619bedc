"""jaxouter learns an outer loop: it sees the reference r and the output y, and chooses the modified reference r~."""

from jaxouter.loop.environment import make

__all__ = ["__version__", "make"]
__version__ = "0.1.0"
