"""Shared by the commands: readable errors, the compilation cache, progress, tables."""

from __future__ import annotations

import errno
import functools
import glob
import os
import re
import shutil
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

import jax
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from jaxouter import agents, plants, tasks
from jaxouter.evaluation import cache, scenarios, sweeps
from jaxouter.evaluation.baselines import NAMES
from jaxouter.evaluation.metrics import significant
from jaxouter.identification.steady_state import IdentificationWarning
from jaxouter.plants.registry import FORMS, Registration, add, own_errors
from jaxouter.progress import Progress
from jaxouter.training.run import RunWarning, add_agent

DEBUG = "--debug"
NARROWEST = 20  # columns


def on_terminal() -> bool:
    """Whether standard output is a terminal; it may also be missing or of another type."""
    try:
        return sys.stdout.isatty()
    except (AttributeError, ValueError):
        return False


def set_columns() -> None:
    """Assume at least 20 columns: rich prints nothing with 0, and tyro's help never ends with 1."""
    columns = shutil.get_terminal_size().columns
    if "COLUMNS" in os.environ or columns < NARROWEST:
        os.environ["COLUMNS"] = str(max(columns, NARROWEST))


set_columns()
console = Console(
    width=None if on_terminal() else 140,  # rich would cut lines in a file to 80 columns
    force_terminal=False if os.environ.get("TERM") in ("dumb", "unknown") else None,  # plain lines, no bars
)


@contextmanager
def user_errors(arguments: Sequence[str] | None = None) -> Iterator[None]:
    """Report a ValueError, a mistake of the user or of a plant, as one message with exit status 2.

    Args:
        arguments: of the command; None: those of the program. With `--debug` the traceback is shown too.
    """
    warnings.simplefilter("always", RunWarning)
    warnings.simplefilter("once", IdentificationWarning)
    warnings.showwarning = show
    try:
        with own_errors():
            yield
    except Exception as error:
        message = missing_backend() or (str(error) if isinstance(error, ValueError) else None)
        if message is None:
            raise
        if DEBUG in (sys.argv[1:] if arguments is None else arguments):
            traceback.print_exception(error)
        print(f"error: {message}", file=sys.stderr)
        raise SystemExit(2) from None


def missing_backend() -> str | None:
    """Message if JAX is told to use a platform that it does not find (it then raises all kinds of errors); or None."""
    for variable in ("JAX_PLATFORMS", "JAX_PLATFORM_NAME"):
        asked = jax.config.values[variable.lower()]
        if asked and asked != "cpu":
            try:
                for name in asked.split(","):
                    jax.devices(name)
            except Exception:
                jax.config.update(variable.lower(), None)
                there = ",".join(sorted({device.platform for device in jax.devices()}))
                return f"{variable} is {asked!r}, but JAX finds only {there}: unset it, or set {variable}={there}"
    return None


@contextmanager
def optional(what: str) -> Iterator[None]:
    """Turn an error in here into a warning that there is no `what`."""
    try:
        yield
    except Exception as error:  # whatever a library raises
        print(f"warning: no {what}: {type(error).__name__}: {str(error).partition(chr(10))[0]}", file=sys.stderr)


def show(message: Warning | str, *_: object) -> None:
    """Print a warning in one line, except for incomplete entries of the compilation cache.

    Such an entry was left by a killed process, or is being written now. JAX compiles, but never overwrites the entry,
    so it is removed here; otherwise later processes would compile too.
    """
    text, folder = str(message), jax.config.values["jax_compilation_cache_dir"]
    half = re.match("Error reading persistent compilation cache entry for '(.+?)'", text)
    if text.startswith("Error writing persistent compilation cache entry"):
        _not_kept(folder)
    elif half is None:
        print(f"warning: {text}", file=sys.stderr)
    else:
        with suppress(OSError):
            for entry in Path(folder).glob(f"{glob.escape(half[1])}-*-cache"):
                entry.unlink(missing_ok=True)


@functools.cache
def _not_kept(folder: str) -> None:
    print(f"warning: {folder} can't be written: functions are compiled again at the next start", file=sys.stderr)


class Lasting:
    """An output stream that may fail without ending the program: a closed pipe, a full disk, a lost terminal."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write, or drop the text."""
        with self._lasting():
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush, or drop the text."""
        with self._lasting():
            self._stream.flush()

    @contextmanager
    def _lasting(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            with open(os.devnull, "wb") as nothing:
                os.dup2(nothing.fileno(), self._stream.fileno())  # discards the buffered text too
            if self is sys.stdout and error.errno != errno.EPIPE:  # no warning for a closed pipe
                print(f"warning: the output can't be written ({error.strerror}); going on without", file=sys.stderr)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def last() -> None:
    """Make stdout and stderr `Lasting`; characters that they can't encode become '?'."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name) or open(os.devnull, "w")  # noqa: SIM115 - as long as the process
        if not isinstance(stream, Lasting):
            stream.reconfigure(errors="replace")
            setattr(sys, name, Lasting(stream))


def run(main: Callable[[], None]) -> None:
    """Run a command as a program: Ctrl-C, if not handled elsewhere, ends it silently with status 130.

    A file that can't be read or written is reported in one line, with status 1.
    """
    last()
    try:
        main()
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    except OSError as error:
        raise SystemExit(f"error: {error}") from None


def use_compilation_cache() -> None:
    """Keep compiled functions in the user's cache folder, unless JAX is configured otherwise."""
    warnings.showwarning = show
    if not jax.config.values["jax_compilation_cache_dir"] and (folder := cache.usable()) is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder / "xla"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)  # there are many small ones


def use_own(registered: Iterable[Registration], own_agents: Iterable[str]) -> None:
    """Set up a child process: the plants and agents that its parent has registered, and the compilation cache."""
    last()
    for plant in registered:
        add(plant.reference, plant.options)
    for agent in own_agents:
        add_agent(agent)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the parent has already warned about the cache
        use_compilation_cache()
    warnings.showwarning = show


def print_lists() -> None:
    """Plants, presets, scenarios, sweeps, agents and policies."""
    for name in plants.REGISTRY:
        console.print(f"[bold]{name}[/bold]")
        console.print("  presets:   " + ", ".join(tasks.presets(name)))
        console.print("  scenarios: " + ", ".join(scenarios.catalogue(name)))
        console.print("  sweeps:    " + ", ".join(sweeps.catalogue(name)))
    console.print("plants of your own: " + FORMS)
    console.print("agents: " + ", ".join(agents.AGENTS) + ", FILE.py:CLASS")
    console.print("policies: a run folder, " + ", ".join(NAMES))


def progress(shown: bool = True) -> Progress:
    """Progress on the commands' console; shown in the first process only."""
    jax.devices()  # report a missing platform before anything else, see `missing_backend`
    return Progress(console, shown)


class Interrupt:
    """Turns the first Ctrl-C or SIGTERM into a flag, so that a run can be saved; the second one ends it at once."""

    def __init__(self, first: str = "the epoch of all seeds ends, then everything is saved") -> None:
        """Args: first: what happens before it ends."""
        self.requested, self._first = False, first

    def __enter__(self) -> Interrupt:
        self._before: dict[int, Any] = {}
        if threading.current_thread() is not threading.main_thread():
            return self  # Python delivers signals to the main thread only
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) != signal.SIG_IGN:  # a shell's background jobs ignore Ctrl-C
                self._before[number] = signal.signal(number, self._handle)
        return self

    def _handle(self, number: int, frame: Any) -> None:
        del frame
        self.requested = True
        print(f"\nstopping: {self._first}; a second signal stops at once", file=sys.stderr)
        signal.signal(number, self._before[number])

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table; the first column is left-aligned, the others right-aligned.

    Nothing is cut: a table that is too wide loses its box and, if need be, is printed in parts.
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
    """A number for a table, with so many significant digits; a dash for None."""
    return "-" if value is None else significant(value, digits)
