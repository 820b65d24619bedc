"""Training as plain Python around the jitted epochs: resume, progress, metrics, checkpoints."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, TypeVar

import jax
import numpy as np

from jaxouter.training import devices
from jaxouter.training.environments import TrainState
from jaxouter.training.pretraining import PretrainingState, Say
from jaxouter.training.run import Run
from jaxouter.training.trainer import Trainer

T = TypeVar("T")
Row = dict[str, Any]
OnEpoch = Callable[[Trainer, TrainState], Row]
Report = Callable[[int, Row], None]
Pretrained = Callable[[int, PretrainingState, Callable[[], Row]], None]


class _StoppedError(Exception):
    """Asked to end early during the start."""


class NotFiniteError(Exception):
    """What was learned has become useless: numbers that are not finite."""


class Pace:
    """How often to do something: so that it takes no more than a share of the time."""

    SHARE = 0.02

    def __init__(self, least: float = 0.0) -> None:
        """Args: least: seconds between two times, at least; then what the first one takes, compilation, is let pass."""
        self._least, self._took, self._ended, self._times = least, 0.0, -math.inf, 0

    def due(self) -> bool:
        """Whether enough time has passed since the last one."""
        return time.monotonic() - self._ended >= max(self._least, self._took / self.SHARE)

    def do(self, what: Callable[[], T]) -> T:
        """Do it, and take the time."""
        begun, self._times = time.monotonic(), self._times + 1
        found = what()
        self._ended = time.monotonic()
        self._took = 0.0 if self._least and self._times == 1 else self._ended - begun
        return found


def train(
    run: Run,
    on_epoch: OnEpoch = lambda trainer, state: {},
    report: Report = lambda seed, row: None,
    stop: Callable[[], bool] = lambda: False,
    pretrained: Pretrained = lambda seed, at, look: None,
    say: Say = lambda what, done, of: None,
) -> dict[int, TrainState] | None:
    """Train every seed of a run to the end, from the newest epoch of which all have a checkpoint, or from the start.

    Each epoch is run for all seeds, as many at a time as the devices take, before the next one. Called in every
    process; the first one alone reads and writes the folder, and calls `on_epoch` and `report`. Everything is saved at
    the end, where it ends early, and as often in between as `Pace` allows.

    Args:
        run: folder; metrics and checkpoints go there.
        on_epoch: called with trainer and state after each epoch; what it returns joins the row (evaluation).
        report: called with seed and row after each epoch (progress).
        stop: asked after each epoch of all seeds whether to end early. All processes end if one does.
        pretrained: called as the actor is pretrained with seed, how far that is, and what gives `on_epoch` of it
            (progress).
        say: called with what is going on before (progress).

    Returns:
        The final state of each seed, on the host; None where it ended early.

    Raises:
        ValueError: a checkpoint is not readable, the identification failed, or there are too few devices.
        OSError: something can't be written; what was saved before is whole.
        NotFiniteError: parameters are not finite any more; what was saved before is.
    """
    cfg, fleet, (trainer, params) = run.config, run.fleet, run.trainer
    done = int(devices.text_from_first(lambda: str(run.common_epoch())))
    rounds = [run.seeds[i : i + cfg.side_by_side] for i in range(0, cfg.seeds, cfg.side_by_side)]
    pace = Pace()

    def heard(seed: int, at: PretrainingState, state: Callable[[], TrainState]) -> None:
        stopping = jax.process_count() == 1 and stop()
        if stopping or int(at.done) == cfg.pretraining.gradient_steps or pace.due():
            pace.do(lambda: run.save_pretraining(seed, at))
        if stopping:
            raise _StoppedError
        pretrained(seed, at, lambda: on_epoch(trainer, state()))

    def begins(what: str, done_of_it: int, of: int) -> None:
        if done_of_it and jax.process_count() == 1 and stop():
            raise _StoppedError
        say(what, done_of_it, of)

    begun = time.perf_counter()
    try:
        states = {seeds: _begin(run, seeds, done, heard, begins) for seeds in rounds}
    except _StoppedError:
        return None

    def every_seed() -> Iterator[tuple[int, TrainState]]:
        for seeds in rounds:
            yield from zip(seeds, fleet.take(states[seeds]), strict=True)

    def save(epoch: int) -> None:
        for seed, state in every_seed():
            devices.in_first(partial(run.save, seed, epoch, state))
        devices.in_first(run.forget_pretraining)  # now that every seed has a checkpoint

    def keep(seed: int, state: TrainState, epoch: int, metrics: Row, rates: Row) -> None:
        if epoch == 0 and run.rows(seed):
            return  # from before a kill
        row: Row = {"epoch": epoch, "steps": int(state.steps), "updates": trainer.updates(state), **metrics}
        if epoch > 0:
            row |= {name: float(value) for name, value in trainer.diagnose(state, params).items()}
        row |= on_epoch(trainer, state) | rates
        run.append(seed, row)
        report(seed, row)

    if cfg.pretraining.gradient_steps and not done:
        rates = {"seconds": (time.perf_counter() - begun) / cfg.seeds}
        for seed, state in every_seed():  # what the start gave is the row of epoch 0
            _check(seed, 0, state)
            devices.in_first(partial(keep, seed, state, 0, {}, rates))
        pace.do(partial(save, 0))
    for epoch in range(done, cfg.epochs):
        if epoch == done:
            say("compiling", 0, 0)
        steps = min(cfg.epoch, cfg.steps - cfg.agent.data.before - epoch * cfg.epoch)
        for seeds in rounds:
            begun = time.perf_counter()
            states[seeds], metrics = fleet.epoch(states[seeds], params, steps)
            metrics = devices.get(metrics)  # waits for the epoch to end
            seconds = time.perf_counter() - begun
            rates = {
                "seconds": seconds,
                "steps_per_second": steps / seconds,
                "updates_per_second": cfg.total_updates / (cfg.steps - cfg.agent.data.before) * steps / seconds,
            }
            for i, (seed, state) in enumerate(zip(seeds, fleet.take(states[seeds]), strict=True)):
                _check(seed, epoch + 1, state)
                found = {name: float(value[i]) for name, value in metrics.items()}
                devices.in_first(partial(keep, seed, state, epoch + 1, found, rates))
        stopping = devices.any_process(stop())
        if devices.any_process(stopping or epoch + 1 == cfg.epochs or (devices.is_first() and pace.due())):
            pace.do(partial(save, epoch + 1))
        if stopping:
            return None
    return {seed: state for seeds in rounds for seed, state in zip(seeds, fleet.take(states[seeds]), strict=True)}


def _check(seed: int, epoch: int, state: TrainState) -> None:
    """Raises NotFiniteError, naming what is not finite."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(state.agent):
        if not np.isfinite(leaf).all():
            name = str(getattr(path[0], "name", "agent")).replace("_", " ")
            raise NotFiniteError(f"seed {seed}, epoch {epoch}: {name} is not finite any more")


def _begin(
    run: Run,
    seeds: range,
    done: int,
    heard: Callable[[int, PretrainingState, Callable[[], TrainState]], None],
    say: Say,
) -> TrainState:
    """States of some seeds after so many epochs: from their checkpoints, or started and prefilled."""
    trainer, params = run.trainer
    like = jax.eval_shape(trainer.fresh, jax.random.key(0), params)
    kept = [seed for seed in seeds if done in run.whole(seed)] if devices.is_first() else []
    loads = devices.any_process(len(kept) == len(seeds))

    def whole(seed: int) -> TrainState:
        run.forget(seed, done if loads else -1)
        if loads:
            return run.load(seed, done)[0]
        each = run.config.devices // jax.process_count()
        return trainer.start(seed, params, partial(heard, seed), run.load_pretraining(seed), each, say)

    states = run.fleet.put([devices.state_from_first(lambda seed=seed: whole(seed), like) for seed in seeds])
    if loads or not run.config.epochs:
        return states
    say("prefill", 0, 0)
    return run.fleet.prefill(states, params)
