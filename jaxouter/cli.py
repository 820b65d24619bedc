"""What the commands share: errors for people, the compilation cache, progress, tables."""

from __future__ import annotations

import glob
import re
import signal
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

import jax
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from jaxouter import plants
from jaxouter.evaluation import cache, scenarios, sweeps
from jaxouter.evaluation.metrics import significant
from jaxouter.evaluation.rivals import NAMES
from jaxouter.plants.sources import FORMS, Source, add
from jaxouter.progress import Progress
from jaxouter.training.config import OWN, PRESETS
from jaxouter.training.run import RunWarning

console = Console(width=None if sys.stdout.isatty() else 140)  # a file is not cut to 80 columns


@contextmanager
def user_errors() -> Iterator[None]:
    """A ValueError in here is the user's mistake: one message, exit status 2."""
    warnings.simplefilter("always", RunWarning)
    warnings.showwarning = show
    try:
        yield
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


def show(message: Warning | str, *_: object) -> None:
    """A warning in one line; none of half an entry of the compilation cache, left by a kill or being written now.

    JAX compiles then, but writes no entry where there is one: it is removed, else later processes would compile too.
    """
    half = re.match("Error reading persistent compilation cache entry for '(.+?)'", str(message))
    if half is None:
        print(f"warning: {message}", file=sys.stderr)
    else:
        for entry in Path(jax.config.values["jax_compilation_cache_dir"]).glob(f"{glob.escape(half[1])}-*-cache"):
            entry.unlink(missing_ok=True)


def run(main: Callable[[], None]) -> None:
    """The command as a program: Ctrl-C, where nothing else handles it, ends it quietly with status 130."""
    try:
        main()
    except KeyboardInterrupt:
        raise SystemExit(130) from None


def use_compilation_cache() -> None:
    """Keep compiled functions in the user's cache folder, unless JAX is told otherwise."""
    if not jax.config.values["jax_compilation_cache_dir"]:
        jax.config.update("jax_compilation_cache_dir", str(cache.folder() / "xla"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)  # there are many small ones
    warnings.showwarning = show


def use_plants(sources: Iterable[Source]) -> None:
    """What a process of its own begins with: the plants that its parent knows, and the compilation cache."""
    for source in sources:
        add(source.reference, source.options)
    use_compilation_cache()


def print_lists() -> None:
    """Plants, presets, scenarios, sweeps and policies."""
    for name in plants.REGISTRY:
        console.print(f"[bold]{name}[/bold]")
        console.print("  presets:   " + ", ".join(PRESETS.get(name, OWN)))
        console.print("  scenarios: " + ", ".join(scenarios.catalogue(name)))
        console.print("  sweeps:    " + ", ".join(sweeps.catalogue(name)))
    console.print("plants of your own: " + FORMS)
    console.print("policies: a run folder, " + ", ".join(NAMES))


def progress(shown: bool = True) -> Progress:
    """Progress on the console of the commands; not shown in processes but the first."""
    return Progress(console, shown)


class Interrupt:
    """Turns the first Ctrl-C or SIGTERM into a flag, so that a run can save itself; the second one ends it at once."""

    def __init__(self, first: str = "the epoch of all seeds ends, then everything is saved") -> None:
        """Args: first: what happens before it ends."""
        self.requested, self._first = False, first

    def __enter__(self) -> Interrupt:
        self._before: dict[int, Any] = {}
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._handle)
        return self

    def _handle(self, number: int, frame: Any) -> None:
        del frame
        self.requested = True
        print(f"\nstopping: {self._first}; once more: at once", file=sys.stderr)
        signal.signal(number, self._before[number])

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table; the first column to the left, the others to the right.

    Narrow output is not cut: a table that is too wide has no box and, if need be, is printed in parts.
    """
    plain = [[Text.from_markup(row[i]).plain for row in (columns, *rows)] for i in range(len(columns))]
    least = [
        max(map(len, plain[0])),
        *(max((len(word) for cell in cells for word in cell.split()), default=1) for cells in plain[1:]),
    ]
    room, rest = console.width, [*range(1, len(columns))]
    boxed = sum(least) + 3 * len(least) + 1 <= room
    style: dict[str, Any] = {} if boxed else dict(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    least = [min(width, room // 2 - 2) for width in least]
    while rest:
        shown, free = [0], room - 1 - 3 - least[0] if boxed else room - 2 - least[0]
        while rest and (len(shown) == 1 or least[rest[0]] + 3 <= free):
            free -= least[rest[0]] + (3 if boxed else 2)
            shown.append(rest.pop(0))
        out = Table(title=title, title_justify="left", header_style="bold", **style)
        for i in shown:
            wider = min(max(map(len, plain[i])) - least[i], max(0, free))
            free -= wider
            justify = "right" if i else "left"
            out.add_column(columns[i], justify=justify, overflow="fold", width=least[i] + max(0, wider))
        for row in rows:
            out.add_row(*(row[i] for i in shown))
        console.print(out)


def number(value: float | None, digits: int = 4) -> str:
    """A figure for a table, with so many significant digits whatever its unit; a dash where it is not defined."""
    return "-" if value is None else significant(value, digits)
