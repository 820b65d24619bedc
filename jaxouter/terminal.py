"""The terminal: the console, warnings in one line, output streams that may fail, Ctrl-C."""

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
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

import jax
from rich.console import Console

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
def optional(what: str) -> Iterator[None]:
    """Turn an error in here into a warning that there is no `what`."""
    try:
        yield
    except Exception as error:  # whatever a library raises
        print(f"warning: no {what}: {type(error).__name__}: {str(error).partition(chr(10))[0]}", file=sys.stderr)


def show(message: Warning | str, *_: object) -> None:
    """Print a warning in one line, but for those of `mended`."""
    if not mended(str(message)):
        print(f"warning: {message}", file=sys.stderr)


def mended(text: str) -> bool:
    """Whether a warning is of JAX's compilation cache, and needs no more words.

    An incomplete entry was left by a killed process, or is being written now. JAX compiles, but never overwrites the
    entry, so it is removed here; otherwise later processes would compile too.
    """
    folder = jax.config.values["jax_compilation_cache_dir"]
    half = re.match("Error reading persistent compilation cache entry for '(.+?)'", text)
    if half is not None:
        with suppress(OSError):
            for entry in Path(folder).glob(f"{glob.escape(half[1])}-*-cache"):
                entry.unlink(missing_ok=True)
        return True
    if text.startswith("Error writing persistent compilation cache entry"):
        _not_kept(folder)
        return True
    return False


def mend_cache() -> None:
    """Treat warnings of the compilation cache as `show` does, and leave all others to whoever shows them now."""
    before = warnings.showwarning
    if before is not show and not getattr(before, "mends", False):

        def shown(message: Warning | str, *rest: Any, **more: Any) -> None:
            if not mended(str(message)):
                before(message, *rest, **more)

        shown.mends = True  # type: ignore[attr-defined]
        warnings.showwarning = shown


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
