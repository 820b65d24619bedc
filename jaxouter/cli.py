"""What the commands share: errors for people, the compilation cache, progress, tables."""

from __future__ import annotations

import glob
import re
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

import jax
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from jaxouter import plants
from jaxouter.evaluation import cache, scenarios, sweeps
from jaxouter.evaluation.metrics import significant
from jaxouter.evaluation.rivals import NAMES
from jaxouter.plants.sources import FORMS, Source, add, own_errors
from jaxouter.training.config import OWN, PRESETS, TrainConfig
from jaxouter.training.run import RunWarning

console = Console(width=None if sys.stdout.isatty() else 140)  # a file is not cut to 80 columns
LINE_SECONDS = 5.0  # between two plain lines of progress
DEBUG = "--debug"


@contextmanager
def user_errors(arguments: Sequence[str] | None = None) -> Iterator[None]:
    """A ValueError in here is the user's mistake, or a plant's: one message, exit status 2.

    Args:
        arguments: of the command; None: those of the program. With `--debug` among them the trace is shown too.
    """
    warnings.simplefilter("always", RunWarning)
    warnings.showwarning = show
    try:
        with own_errors():
            yield
    except ValueError as error:
        if DEBUG in (sys.argv[1:] if arguments is None else arguments):
            traceback.print_exception(error)
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


class TrainingProgress:
    """A live bar for each seed on a terminal, plain lines elsewhere."""

    def __init__(self, config: TrainConfig, unit: str) -> None:
        self._config, self._unit = config, unit
        self._bars = Progress(
            TextColumn("seed {task.fields[seed]}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TextColumn("{task.fields[text]}"),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self._tasks: dict[int, Any] = {}
        self._begin = self._last = time.monotonic()
        self._first: int | None = None

    def __enter__(self) -> TrainingProgress:
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def __call__(self, seed: int, row: Mapping[str, Any]) -> None:
        """Show the row of an epoch."""
        cfg, epoch, now = self._config, row["epoch"], time.monotonic()
        if epoch == 0:
            return self._show(seed, f"pretrained  MAE {number(row['mae'])} {self._unit}")
        text = (
            f"{row['steps']:,} steps ({row['steps_per_second']:,.0f}/s)  "
            f"{row['updates']:,} updates ({row['updates_per_second']:,.0f}/s)  MAE {number(row['mae'])} {self._unit}"
        )
        if row.get("skipped", 0) or row.get("no_action", 0):
            text += f"  {row['skipped']:.1%} of the updates skipped, {row['no_action']:.1%} of the actions not finite"
        if console.is_terminal:
            if seed not in self._tasks:
                self._tasks[seed] = self._bars.add_task("", total=cfg.epochs, seed=seed, text="")
            self._bars.update(self._tasks[seed], completed=epoch, text=text)
        elif epoch == cfg.epochs or now - self._last >= LINE_SECONDS:
            self._first = epoch - 1 if self._first is None else self._first
            left = (now - self._begin) / max(1, epoch - self._first) * (cfg.epochs - epoch)
            print(f"seed {seed}  epoch {epoch}/{cfg.epochs}  {text}  {left:.0f} s left", flush=True)
            self._last = now

    def pretrained(self, seed: int, done: int) -> None:
        """Show how many gradient steps of the start are done."""
        now = time.monotonic()
        if console.is_terminal or now - self._last >= LINE_SECONDS:
            self._show(seed, f"pretraining: {done:,} of {self._config.pretraining.gradient_steps:,} gradient steps")
            self._last = now

    def _show(self, seed: int, text: str) -> None:
        if not console.is_terminal:
            print(f"seed {seed}  {text}", flush=True)
            return
        if seed not in self._tasks:
            self._tasks[seed] = self._bars.add_task("", total=self._config.epochs, seed=seed, text="")
        self._bars.update(self._tasks[seed], text=text)


class JobProgress:
    """A live bar over many jobs on a terminal, plain lines elsewhere; on both what a long one says meanwhile."""

    def __init__(self, total: int) -> None:
        self._bar = Progress(
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.description}"),
            console=console,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("", total=total)
        self._done, self._total, self._last = 0, total, time.monotonic()

    def __enter__(self) -> JobProgress:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def say(self, text: str) -> None:
        """What one of the jobs is at."""
        self._bar.update(self._task, description=text)
        if not console.is_terminal and time.monotonic() - self._last >= LINE_SECONDS:
            print(f"{self._done}/{self._total} jobs  {text}", flush=True)
            self._last = time.monotonic()

    def advance(self, text: str) -> None:
        """One more is done."""
        self._done += 1
        self._bar.advance(self._task)
        self.say(text)


class Ticker:
    """What goes on, in one line: live on a terminal, now and then elsewhere."""

    def __init__(self) -> None:
        self._status = console.status("")
        self._seconds = 0.5 if console.is_terminal else LINE_SECONDS
        self._last = time.monotonic()

    def __enter__(self) -> Ticker:
        if console.is_terminal:
            self._status.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._status.stop()

    @property
    def due(self) -> bool:
        """Whether it is time to say something."""
        return time.monotonic() - self._last >= self._seconds

    def __call__(self, text: str) -> None:
        """Say it."""
        self._last = time.monotonic()
        if console.is_terminal:
            self._status.update(text)
        else:
            print(text, flush=True)


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table; the first column to the left, the others to the right; narrow output is not cut."""
    out = Table(title=title, title_justify="left", header_style="bold")
    for i, column in enumerate(columns):
        out.add_column(column, justify="left" if i == 0 else "right", no_wrap=i == 0)
    for row in rows:
        out.add_row(*row)
    console.print(out)


def number(value: float | None, digits: int = 4) -> str:
    """A figure for a table, with so many significant digits whatever its unit; a dash where it is not defined."""
    return "-" if value is None else significant(value, digits)
