"""matplotlib wherever it is imported: where there is no home, and where MPLBACKEND names what is not there.

Figures are written to files, which takes no backend; that of a notebook stays what it is.
"""
# ruff: noqa: E402 - what an import needs is made before it

from __future__ import annotations

import atexit
import io
import os
import shutil
import sys
import tempfile
from contextlib import suppress
from pathlib import Path


def _fonts() -> None:
    """A folder for the list of fonts where there is no home, in which matplotlib would look for one and fail."""
    try:
        Path.home()
    except RuntimeError:
        folder = os.environ["MPLCONFIGDIR"] = tempfile.mkdtemp(prefix="matplotlib-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)


def _import() -> None:
    """Matplotlib with the backend that the environment names, if there is such a one."""
    backend = os.environ.pop("MPLBACKEND", None)
    import matplotlib

    if backend is not None:
        os.environ["MPLBACKEND"] = backend
        with suppress(ValueError):
            matplotlib.rcParams["backend"] = backend


if "matplotlib" not in sys.modules:
    if not os.environ.get("MPLCONFIGDIR"):
        _fonts()
    _import()

import matplotlib.figure
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import SubFigure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

__all__ = [
    "DPI",
    "Axes",
    "Figure",
    "FigureCanvasAgg",
    "Line2D",
    "LogLocator",
    "LogNorm",
    "NullFormatter",
    "SubFigure",
    "rc_context",
]

DPI = 130


class Figure(matplotlib.figure.Figure):
    """A figure that a notebook shows without pyplot, which would keep it in memory."""

    def _repr_png_(self) -> bytes:
        png = io.BytesIO()
        self.savefig(png, format="png", dpi=DPI)
        return png.getvalue()
