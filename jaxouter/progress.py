"""Progress of a command: phase, share done and time left; live on a terminal, plain lines elsewhere."""

from __future__ import annotations

import importlib.util
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import jax
from rich import progress as bars
from rich.console import Console, Group
from rich.live import Live
from rich.table import Column
from rich.text import Text

from jaxouter.terminal import console

LINE_SECONDS = 5.0  # between two plain lines, at most
FIRST = 0.1  # a first piece smaller than this share of the work is mostly compilation and does not give the pace
FIRST_PHASE = "preparing"  # whose line comes late, as a mistake may be all there is to say
NARROW = 30  # columns; on narrower terminals the percentage is left out


class TimeLeft:
    """Time left, from the pace so far."""

    def __init__(self, total: float, now: float, done: float = 0.0) -> None:
        """Args: total: all work, in any unit; now: time, s; done: work done before."""
        self.total, self.done = total, done
        self._from: tuple[float, float] | None = (now, done)  # time and work at which the pace measurement starts
        self._last: float | None = None  # time of the last piece
        self._pace: float | None = None  # seconds per unit of work

    def reach(self, done: float, now: float) -> None:
        """Set the work that is done."""
        early = self._last is None and self._pace is None and done - self.done < FIRST * self.total
        if self._from is None or early:
            self._from = now, done
        elif done > self._from[1]:
            self._pace = (now - self._from[0]) / (done - self._from[1])
        self.done, self._last = min(done, self.total), now

    def pause(self) -> None:
        """Leave out the time until the next piece is done: something else is going on."""
        self._from = self._last = None

    def left(self, now: float) -> float | None:
        """Seconds left; None if unknown so far."""
        if self._pace is None:
            return None
        return max(0.0, self._pace * (self.total - self.done) - (now - (self._last or now)))


@contextmanager
def showing(progress: bool | Progress) -> Iterator[Progress]:
    """Progress on the console (True), none (False), or that which is shown already."""
    if isinstance(progress, Progress):
        yield progress
        return
    jax.devices()  # a missing platform is reported before anything else
    with Progress(console, progress) as begun:
        yield begun


class Progress:
    """The current phase of a command, and a bar with the time left.

    Narrow terminals wrap the text and shorten the bar.
    """

    def __init__(self, console: Console, shown: bool = True, clock: Callable[[], float] = time.monotonic) -> None:
        """Args: console: to print on; shown: False prints nothing (in all processes but the first); clock: s."""
        self._console, self._shown, self._clock = console, shown, clock
        notebook = console.is_jupyter and importlib.util.find_spec("ipywidgets") is not None
        self._live = (console.is_terminal and not console.is_dumb_terminal) or notebook
        self._what, self._notes, self._since, self._printed = FIRST_PHASE, dict[str, str](), clock(), clock()
        self._work: TimeLeft | None = None
        self._counter: Callable[[], float] | None = None
        self._counted, self._before = 0.0, 0.0  # the counter, and the work done, at the last piece
        self._ended = threading.Event()
        share = [bars.TaskProgressColumn()] if console.width >= NARROW else []
        self._bar = bars.Progress(bars.BarColumn(None), *share, _Time(self), expand=True)
        self._task = self._bar.add_task("", total=None, start=False)
        self._display = Live(
            get_renderable=self._render,
            console=console,
            refresh_per_second=4,
            transient=True,
            redirect_stderr=sys.stderr is not None and sys.stderr.isatty(),  # not if stderr goes to a file
        )

    def __enter__(self) -> Progress:
        if not self._shown:
            return self
        if self._live:
            self._display.start()
        else:
            threading.Thread(target=self._tick, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._display.stop()

    @property
    def done(self) -> float:
        """Work that is done."""
        return 0.0 if self._work is None else self._before

    def phase(
        self, what: str, total: float | None = None, done: float = 0.0, counter: Callable[[], float] | None = None
    ) -> None:
        """Begin a phase.

        Args:
            what: its name, in a few words.
            total: work of a new bar, 0 if unknown; None: keep the bar, and leave out the time until it moves.
            done: part of the total that is already done.
            counter: counts work from any origin; asked now and then, to move the bar within long pieces.
        """
        now = self._clock()
        if total is not None:
            self._work, self._notes, self._before = TimeLeft(total, now, done) if total else None, {}, done
            self._bar.remove_task(self._task)
            self._task = self._bar.add_task("", total=total or None, completed=int(done), start=done > 0)
        elif self._work is not None:
            self._work.pause()
        self._what, self._since, self._counter = what, now, counter
        self._counted = 0.0 if counter is None else counter()
        if not self._live:
            self._line()

    def advance(self, work: float = 1.0, **notes: str) -> None:
        """Add a finished piece of work; see `say` for the notes."""
        self.reach(self._before + work, **notes)

    def reach(self, done: float, **notes: str) -> None:
        """Set the work that is done; see `say` for the notes."""
        self.say(**notes)
        self._before = done
        if self._counter is not None:
            self._counted = self._counter()
        self._move(done)

    def say(self, **notes: str) -> None:
        """Show notes next to the phase until the next bar; a note replaces one of the same name, '' removes it."""
        self._notes = {name: text for name, text in {**self._notes, **notes}.items() if text}

    def print(self, text: str) -> None:
        """Print a line that stays."""
        if self._shown:
            self._console.print(text, markup=False, highlight=False, emoji=False, soft_wrap=not self._live)

    @property
    def line(self) -> str:
        """Everything in one line."""
        parts = [self._what, *self._notes.values()]
        if self._work is not None and self._work.done:
            parts.append(f"{100 * self._work.done / self._work.total:.0f} %")
        begins = not self._notes and self._clock() - self._since < 1.0
        return "  ".join(parts if begins else [*parts, self.time])

    @property
    def time(self) -> str:
        """Time left or, if unknown so far, elapsed in this phase."""
        now = self._clock()
        left = None if self._work is None else self._work.left(now)
        if left is not None:
            return f"{clock(left)} left"
        return f"{clock(now - self._since)} elapsed"

    def _move(self, done: float) -> None:
        if self._work is not None and done > self._work.done:
            self._work.reach(done, self._clock())
            if not self._bar.tasks[0].started:
                self._bar.start_task(self._task)
            self._bar.update(self._task, completed=self._work.done)

    def _count(self) -> None:
        if self._counter is not None:
            self._move(self._before + self._counter() - self._counted)

    def _render(self) -> Group:
        self._count()
        text = Text("  ".join(self._notes.values()))
        return Group(Text.assemble((self._what, "bold"), "  " if text else "", text), self._bar)

    def _tick(self) -> None:
        """Print a line now and then, until the end."""
        while not self._ended.wait(LINE_SECONDS / 10):
            if self._clock() - self._printed >= 0.9 * LINE_SECONDS:
                self._line()

    def _line(self) -> None:
        self._count()
        self._printed = self._clock()
        self.print(self.line)


class _Time(bars.ProgressColumn):
    """Time left, or elapsed."""

    def __init__(self, progress: Progress) -> None:
        super().__init__(Column(no_wrap=True))
        self._progress = progress

    def render(self, task: bars.Task) -> Text:
        return Text(self._progress.time, justify="right")


def clock(seconds: float) -> str:
    """0:07, 12:34 or 1:02:03."""
    minutes, whole = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{whole:02d}" if hours else f"{minutes}:{whole:02d}"
