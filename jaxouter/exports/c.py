"""The controller as C99: NAME.c with the weights, and NAME.h. It allocates no memory and has no global state."""

from __future__ import annotations

import re
import shutil
import subprocess
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from jaxouter.exports.spec import ControllerSpec

COMPILERS = ("cc", "gcc", "clang")
FLAGS = ("-std=c99", "-O2", "-shared", "-fPIC")


def prefix(spec: ControllerSpec) -> str:
    """Prefix of all symbols: a C identifier made from the plant's name."""
    name = re.sub(r"\W+", "_", spec.plant, flags=re.ASCII).strip("_")
    return f"{'plant_' if name[:1].isdigit() else ''}{name}_outer_loop".lstrip("_")


def header_and_source(spec: ControllerSpec, stem: str) -> tuple[str, str]:
    """Texts of the files `stem`.h and `stem`.c."""
    values = dict(spec=spec, name=prefix(spec), stem=stem, widths=spec.widths)
    return render("controller.h.j2", **values), render("controller.c.j2", **values)


def save(spec: ControllerSpec, path: Path) -> None:
    """Write the .c file, and the .h file next to it."""
    header, source = header_and_source(spec, path.stem)
    path.write_text(source, encoding="utf-8")
    path.with_suffix(".h").write_text(header, encoding="utf-8")


def compiler() -> str:
    """The system's C compiler.

    Raises:
        FileNotFoundError: there is none.
    """
    found = next(filter(None, map(shutil.which, COMPILERS)), None)
    if found is None:
        raise FileNotFoundError(
            f"there is no C compiler on the PATH; install one that is called {' or '.join(COMPILERS)}"
        )
    return found


def shared_library(sources: Sequence[Path], out: Path, *flags: str) -> None:
    """Compile the sources into a shared library.

    Raises:
        FileNotFoundError: there is no compiler.
        RuntimeError: the compiler fails; with its output.
    """
    command = [compiler(), *FLAGS, *flags, *map(str, sources), "-o", str(out), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr}")


def render(template: str, **values: Any) -> str:
    """Fill in a template of this folder; XML is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("jaxouter.exports", "."),
        autoescape=lambda name: name is not None and name.endswith(".xml.j2"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"comment": _comment, "float": _float, "macro": _macro}
    environment.filters |= {"floats": _floats, "interval": _interval}
    return environment.get_template(template).render(**values)


def _comment(text: str) -> str:
    """The text without anything that begins or ends a comment."""
    return re.sub(r"[\x00-\x1f\\]", " ", text).replace("*/", "* /").replace("/*", "/ *")


def _float(value: float) -> str:
    """The value as a float32 constant in C."""
    return f"{np.float32(value)!s}f"


def _macro(value: float) -> str:
    """The same, safe for a macro."""
    return f"({_float(value)})" if value < 0 else _float(value)


def _floats(array: np.ndarray) -> str:
    """The elements of an initialiser, row by row."""
    return textwrap.fill(", ".join(map(_float, array.ravel())), 120, initial_indent="    ", subsequent_indent="    ")


def _interval(bounds: tuple[float, float]) -> str:
    return f"[{bounds[0]:g}, {bounds[1]:g}]"
