"""`python -m jaxouter.live`: run an outer loop in real time, and learn online."""

from __future__ import annotations

import importlib
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from jaxouter import cli
from jaxouter.evaluation import figures
from jaxouter.evaluation.cache import use_compilation_cache
from jaxouter.evaluation.metrics import number
from jaxouter.plants.errors import Raised
from jaxouter.plants.registry import attribute
from jaxouter.progress import Progress, showing
from jaxouter.runtime.live_folder import SIGNALS, Declaration, LiveFolder, open_folder, reference, summary
from jaxouter.runtime.realtime import Loop, Row, StepError, Timing, run
from jaxouter.terminal import Interrupt, optional
from jaxouter.training.run import add_agent, add_plant, write_json

KEPT = {"static": "static inverse", "lq": "LQ law", "trained": "as trained"}


@dataclass(frozen=True)
class Options:
    """Run an outer loop around your function step(r~) -> y, once every DT seconds, and optionally learn online.

    If RUN is a trained run, its policy acts. Otherwise --learn starts without one: r passes through while a record is
    made, then the static inverse acts, later an LQ law. What is learned takes over only where it is predicted to be
    better on the same steps, and is sent back if it turns out worse. If a deadline is missed, r passes through for that
    step.

    State, one row per step, a summary and a figure are written to RUN/live. Ctrl-C stops and saves; the same command
    resumes.
    """

    step: Annotated[str, tyro.conf.Positional]
    """FILE.py:NAME or MODULE:NAME of a function that applies r~ and returns the measured y, or None if missing."""
    run: Path
    """Run folder, or the folder of one seed in it; with --learn it need not exist yet."""
    declaration: Annotated[Declaration, tyro.conf.arg(name="")]
    learn: bool = False
    """Learn online, in the spare time of each period; r~ then explores a little."""
    steps: int | None = None
    """Control steps; default: until Ctrl-C."""
    reference: str = "staircase"
    """r: a number, a CSV file with a column r (one row per period, repeated), or a family of random references.
    The families are steps, staircase, ramps, sines, doublets, days."""
    record: int = 500
    """Control steps to record before the response is identified."""
    updates: int = 8
    """Most updates per period."""
    plant: str | None = None
    """The run's plant, if your own: FILE.py:NAME, gym:ID, fmu:FILE, log:FILE."""
    agent: str | None = None
    """The run's agent, if your own: FILE.py:CLASS."""
    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Also show the traceback of an error."""


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    with cli.user_errors(arguments), ExitStack() as stack:
        options = tyro.cli(Options, prog=cli.program("live"), args=arguments)
        plant = check(options)
        add_agent(options.agent)
        if options.plant is not None:
            add_plant(options.plant, options.run)
        folder = open_folder(options.run, options.declaration, options.learn)
        use_compilation_cache()
        live, state = folder.begin()
        own, declared = folder.declaration, live.env.plant
        r = reference(options.reference, declared.setpoint_range, own.episode_steps, own.seed)
        stack.enter_context(folder.lock())
        settings = Timing(own.dt, options.learn, options.record, options.updates)
        before = folder.columns().get("time", np.zeros(0))
        begin = float(before[-1]) + 2 * own.dt if len(before) else 0.0  # a gap where it was stopped
        loop = Loop(live, state, plant, lambda k: float(r[k % len(r)]), settings, begin)
        if (declared.control_step, declared.time_unit) != (own.dt, "s"):
            trained = f"{declared.control_step:g} {declared.time_unit}"
            print(f"warning: the period is {own.dt:g} s; the policy was trained for {trained}", file=sys.stderr)
        print(f"{options.step}, every {own.dt:g} s -> {folder.path}; r~ in {list(live.observer.r_tilde_bounds)}")
        try:
            stopped = go(folder, loop, options.steps)
            report(folder, loop)
        except OSError as error:
            raise SystemExit(f"error: {error}; what was saved before is intact") from None
    if stopped is not None:
        print(f"{stopped}; saved, resume with the same command", file=sys.stderr)
        raise SystemExit(130 if stopped == "stopped" else 1)


def check(options: Options) -> Callable[[float], Any]:
    """Check the options; returns the user's function.

    Raises:
        ValueError: there is no such function, or a number is out of range.
    """
    for name, value in (("steps", options.steps), ("record", options.record), ("updates", options.updates)):
        if value is not None and value < 1:
            raise ValueError(f"--{name} is {value}; it must be at least 1")
    file, colon, name = options.step.rpartition(":")
    if not colon or not file:
        raise ValueError(f"the function is {options.step!r}; it is named FILE.py:NAME or MODULE:NAME")
    if file.endswith(".py"):
        found = attribute(Path(file), name, "the function")
    else:
        try:
            found = getattr(importlib.import_module(file), name)
        except Raised as error:  # the module's code may raise anything
            raise ValueError(f"{options.step} can't be imported: {error}") from None
    if not callable(found):
        raise ValueError(f"{options.step} is {found!r}; it must be a function of r~ that gives y")
    return found


def go(folder: LiveFolder, loop: Loop, steps: int | None) -> str | None:
    """Run with progress, then save; returns why it ended early, or None."""
    stopped = None
    with Interrupt("everything is saved") as interrupt, showing(True) as progress, folder.rows() as rows:
        progress.phase("running", steps or 0)
        tell = Telling(loop, progress)

        def record(row: Row) -> None:
            rows.writerow(row)
            tell(row)

        try:
            run(loop, steps, lambda: interrupt.requested, record)
        except (StepError, OSError) as error:
            stopped = f"error: {error}"
        folder.save(loop)
    return "stopped" if interrupt.requested else stopped


class Telling:
    """Shows the state of the loop, and prints each change of stage."""

    SECONDS = 0.5  # between two updates of the display

    def __init__(self, loop: Loop, progress: Progress) -> None:
        self._loop, self._progress, self._last = loop, progress, time.monotonic()
        self._begun = loop.steps
        self._stage: str | None = None
        self._errors: deque[float] = deque(maxlen=500)
        self._r: float | None = None

    def __call__(self, row: Row) -> None:
        """After each step."""
        loop = self._loop
        if row.y is not None and self._r is not None:
            self._errors.append(abs(self._r - row.y))
        self._r = row.r
        if loop.stage != self._stage:
            self._stage = loop.stage
            self._progress.print(f"step {row.step:,}: {self._stage}")
        if time.monotonic() - self._last >= self.SECONDS and self._errors:
            self._last = time.monotonic()
            self._progress.reach(
                loop.steps - self._begun,
                error=f"|r - y| {np.mean(self._errors):.3g}",
                stage=loop.stage,
                steps=f"{loop.steps:,} steps",
                updates=f"{loop.updates:,} updates",
                late=f"{loop.counts['late']:,} missed deadlines",
                trouble=loop.trouble or "",
            )


def report(folder: LiveFolder, loop: Loop) -> None:
    """Write the summary and the figure, print the table."""
    if not loop.act_seconds:
        return
    columns = folder.columns()
    found = summary(loop, columns)
    write_json(folder.path / "summary.json", found)
    unit = loop.live.env.plant.y_unit
    cli.table(
        "MAE: measured, and predicted for other policies on the same steps",
        ["", "measured", "r~ = r", KEPT[loop.fallback], "learned"],
        [[part, *(number(values[name]) for name in SIGNALS)] for part, values in found["mae"].items()],
    )
    passed = ", ".join(f"{number:,} {why}" for why, number in found["counts"].items() if number)
    act = found["act_us"]
    print(
        f"{found['steps']:,} steps ({passed}); {found['missed_deadlines']:,} missed deadlines; {found['updates']:,} "
        f"updates; act takes {act['p50']:.0f} us (p50), {act['p99']:.0f} us (p99)"
    )
    if found["updates"]:
        accepted, refused, back = (found[name] for name in ("accepted", "refused", "sent_back"))
        print(f"learned policies: {accepted:,} accepted, {refused:,} refused, {back:,} sent back")
    with optional("figure"):
        print(f"figure: {figures.save(figures.live(columns, unit), folder.path / 'live.png')}")
    print(f"summary, steps.csv and controller.npz: {folder.path}")


if __name__ == "__main__":
    cli.run(main)
