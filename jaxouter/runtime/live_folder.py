"""The folder of a real-time loop: its declaration, its state, one row per control step, a summary."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import msgspec
import numpy as np

from jaxouter.exports.spec import ControllerSpec
from jaxouter.identification.columns import read
from jaxouter.loop.references import FAMILIES
from jaxouter.plants.simulators import PlantOptions
from jaxouter.runtime.online import Live, LiveState, declared
from jaxouter.runtime.realtime import Loop, Row
from jaxouter.training import checkpoint
from jaxouter.training.policy import LearnedParams
from jaxouter.training.run import lock, open_run, write_json

FORMAT = 2
EPISODES = 64  # random references of a family, which then repeat
PARTS = {"first quarter": slice(0, 1), "last quarter": slice(3, 4)}  # quarters of the rows
SIGNALS = ("y", "y_passed", "y_kept", "y_learned")


@dataclass(frozen=True)
class Declaration:
    """Settings of a live folder; a trained run knows the rest."""

    dt: float
    """Period, s."""
    seed: int = 0
    """Seed of networks, exploration and references."""
    episode_steps: int = 400
    """Control steps of one random reference."""
    takeover: int = 2_000
    """Updates before the learned policy may act."""
    r_tilde_bounds: tuple[float, float] | None = None
    """Without a trained run: least and greatest r~ that the plant may get."""
    setpoint_range: tuple[float, float] | None = None
    """Without a trained run: usual range of r; scales the observation and random references."""

    def check(self) -> None:
        """Raises ValueError if an option is wrong; names the option, its value and what is allowed."""
        if not 0.0 < self.dt < math.inf:
            raise ValueError(f"--dt is {self.dt}; it must be a positive number of seconds")
        for name in ("episode_steps", "takeover"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name.replace('_', '-')} is {getattr(self, name)}; it must be at least 1")
        if not 0 <= self.seed < 2**32:
            raise ValueError(f"--seed is {self.seed}; it must lie in [0, 2^32)")


@dataclass(frozen=True)
class LiveFolder:
    """RUN/live."""

    run: Path
    declaration: Declaration

    @property
    def path(self) -> Path:
        """The folder that everything is written to."""
        return self.run / "live"

    @property
    def trained(self) -> bool:
        """Whether it belongs to a trained run."""
        return is_run(self.run)

    @property
    def state_file(self) -> Path:
        """The saved state, from which the loop resumes."""
        return self.path / "state.npz"

    @property
    def rows_file(self) -> Path:
        """One row per control step."""
        return self.path / "steps.csv"

    def begin(self) -> tuple[Live, LiveState]:
        """The policy and learner: resumed, or from the trained run, or new.

        Raises:
            ValueError: the run or the state is not readable, or a range is wrong.
        """
        own, key = self.declaration, jax.random.key(self.declaration.seed)
        if self.trained:
            run, seed, _ = open_run(self.run)
            trainer, _ = run.trainer
            learned, _ = run.load(seed)
            live = Live.of(trainer.config, trainer.env, own.takeover, "trained")
            state = live.trained(key, learned, trainer.policy_params(learned).actor)
        else:
            options = PlantOptions(r_tilde_bounds=own.r_tilde_bounds, setpoint_range=own.setpoint_range)
            live = Live.of(*declared(own.dt, own.episode_steps, options), own.takeover, "static")
            state = live.fresh(key)
        return live, checkpoint.load(self.state_file, state)[0] if self.state_file.exists() else state

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Make the folder if needed, and lock it for this process.

        Raises:
            ValueError: it can't be made, or another process has locked it.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ValueError(f"the folder {self.path} can't be made: {error.strerror}") from None
        with lock(self.path):
            write_json(self.path / "config.json", {"format": FORMAT, "live": asdict(self.declaration)})
            yield

    @contextmanager
    def rows(self) -> Iterator[Any]:
        """Writer of rows; each is flushed at once."""
        before = self.rows_file.read_bytes()[-1:] if self.rows_file.exists() else b""
        with self.rows_file.open("a", newline="", buffering=1) as file:
            writer = csv.writer(file, lineterminator="\n")
            if not before:
                writer.writerow(Row._fields)
            elif before != b"\n":  # a kill cut the last row
                file.write("\n")
            yield writer

    def columns(self) -> dict[str, np.ndarray]:
        """All rows, by column; nan for missing values."""
        if not self.rows_file.exists():
            return {}
        with self.rows_file.open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if None not in row.values()]  # a kill may cut the last one
        return {
            name: np.array([row[name] for row in rows])
            if name == "why"
            else np.array([float(row[name] or math.nan) for row in rows])
            for name in Row._fields
        }

    def save(self, loop: Loop) -> None:
        """Save the state, and the controller that acts now.

        Raises:
            OSError: they can't be written; the previous files are intact.
        """
        state = loop.state
        checkpoint.save(self.state_file, state)
        if state.begun:
            live = loop.live
            actor = state.incumbent if state.leads else state.kept
            policy, params = live.policy.trimmed(LearnedParams(actor, state.base))
            spec = ControllerSpec.of(policy, params, live.env.plant)
            spec.save(self.path / "controller.npz")


def is_run(path: Path) -> bool:
    """Whether the folder is a run, or the folder of one of its seeds."""
    return (path / "config.json").exists() or (path.name.startswith("seed-") and (path / "../config.json").exists())


def open_folder(run: Path, given: Declaration, learn: bool) -> LiveFolder:
    """The live folder of a run; its declaration must not have changed.

    Raises:
        ValueError: the declaration has changed, or there is no policy to run and `learn` is False.
    """
    given.check()
    folder, file = LiveFolder(run, given), run / "live" / "config.json"
    if folder.trained:
        if given.r_tilde_bounds or given.setpoint_range:
            raise ValueError(f"{run} already has ranges of r~ and set-points; leave out these two options")
    elif not file.exists():
        if run.exists() and (not run.is_dir() or any(run.iterdir())):
            raise ValueError(f"{run} is not a run folder: it has no readable config.json")
        if not learn:
            raise ValueError(f"there is no run {run}; train one, or start without one by --learn")
        if given.r_tilde_bounds is None or given.setpoint_range is None:
            raise ValueError("a loop without a trained run needs --r-tilde-bounds LOW HIGH --setpoint-range LOW HIGH")
    if not file.exists():
        return folder
    was = _read(file)
    for name, value in asdict(given).items():
        if value != getattr(was, name) and (name == "dt" or value != getattr(Declaration(given.dt), name)):
            raise ValueError(f"{name} is {value}; {folder.path} was made with {getattr(was, name)}")
    return LiveFolder(run, was)


def _read(path: Path) -> Declaration:
    try:
        content = json.loads(path.read_text())
        if content["format"] != FORMAT:
            raise ValueError(f"it is not of format {FORMAT}")
        return msgspec.convert(content["live"], Declaration)
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise ValueError(f"{path} is not readable: {error}") from None


def reference(text: str, setpoint_range: tuple[float, float], steps: int, seed: int) -> np.ndarray:
    """A cycle of references: a number, the column r of a CSV file, or 64 random references of a family.

    Raises:
        ValueError: `text` is none of these.
    """
    if text in FAMILIES:
        keys = jax.random.split(jax.random.key(seed), EPISODES)
        drawn = jax.vmap(lambda key: FAMILIES[text](key, steps, *setpoint_range))(keys)
        return np.asarray(drawn, np.float64).ravel()
    cycle = _column(Path(text)) if text.lower().endswith(".csv") else _number(text)
    if not len(cycle) or not np.isfinite(cycle).all():
        raise ValueError(f"--reference is {text!r}; it must be finite numbers")
    return cycle


def _number(text: str) -> np.ndarray:
    try:
        return np.array([float(text)])
    except ValueError:
        forms = f"a number, a CSV file with a column r, or one of {', '.join(FAMILIES)}"
        raise ValueError(f"--reference is {text!r}; it must be {forms}") from None


def _column(path: Path) -> np.ndarray:
    try:
        return read(path, ("r",))[0]
    except ValueError as error:
        raise ValueError(f"--reference: {error}") from None


def summary(loop: Loop, columns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Results of the loop so far; needs at least one step.

    The MAE is given for the loop itself and, on the same steps, for the compared policies as predicted from the record.
    `act_us`, `accepted`, `refused` and `sent_back` are since the start of this process.
    """
    p50, p99 = np.percentile(1e6 * np.asarray(loop.act_seconds), (50, 99)).tolist()
    law = loop.state.base
    return {
        "format": FORMAT,
        "steps": loop.steps,
        "missed_deadlines": loop.counts["late"],
        "counts": loop.counts,
        "updates": loop.updates,
        "accepted": loop.accepted,
        "refused": loop.refused,
        "sent_back": loop.sent_back,
        "act_us": {"p50": p50, "p99": p99},
        "base": {name: np.asarray(value).tolist() for name, value in law._asdict().items()},
        "mae": {part: maes(columns, quarters) for part, quarters in PARTS.items()},
    }


def maes(columns: Mapping[str, np.ndarray], quarters: slice) -> dict[str, float | None]:
    """Mean of |r_k - y_(k+1)| over some quarters of the rows; None if it is not known for half of them."""
    edges = [i * max(0, len(columns["r"]) - 1) // 4 for i in range(5)]
    k = np.arange(edges[quarters.start], edges[quarters.stop])
    follows = k[columns["step"][k + 1] == columns["step"][k] + 1]
    out: dict[str, float | None] = {}
    for name in SIGNALS:
        e = np.abs(columns["r"][follows] - columns[name][follows + 1])
        out[name] = float(np.nanmean(e)) if np.isfinite(e).sum() > len(e) / 2 else None
    return out
