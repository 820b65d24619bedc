"""The training loop in plain Python around jitted epochs: resume, progress, metrics, checkpoints."""

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
from jaxouter.training.run import RunFolder
from jaxouter.training.trainer import Trainer

T = TypeVar("T")
Row = dict[str, Any]
OnEpoch = Callable[[Trainer, TrainState], Row]
Report = Callable[[int, Row], None]
Pretrained = Callable[[int, PretrainingState, Callable[[], Row]], None]


class _StoppedError(Exception):
    """Stopped during the pretraining."""


class NotFiniteError(Exception):
    """Learned parameters are no longer finite."""


class Pace:
    """Limits how often something is done, so that it takes no more than a share of the time."""

    SHARE = 0.02

    def __init__(self, least: float = 0.0) -> None:
        """Args: least: seconds between two times, at least; if positive, the first one (compilation) does not count."""
        self._least, self._took, self._ended, self._times = least, 0.0, -math.inf, 0

    def due(self) -> bool:
        """Whether enough time has passed since the last time."""
        return time.monotonic() - self._ended >= max(self._least, self._took / self.SHARE)

    def do(self, what: Callable[[], T]) -> T:
        """Do it, and measure how long it takes."""
        begun, self._times = time.monotonic(), self._times + 1
        found = what()
        self._ended = time.monotonic()
        self._took = 0.0 if self._least and self._times == 1 else self._ended - begun
        return found


def train(
    run: RunFolder,
    on_epoch: OnEpoch = lambda trainer, state: {},
    report: Report = lambda seed, row: None,
    stop: Callable[[], bool] = lambda: False,
    pretrained: Pretrained = lambda seed, at, look: None,
    say: Say = lambda what, done, of: None,
) -> dict[int, TrainState] | None:
    """Train every seed of a run to the end, from the newest epoch of which all have a checkpoint, or from the start.

    Each epoch runs for all seeds, as many at a time as fit on the devices, before the next one starts. Call it in every
    process; only the first one reads and writes the folder, and calls `on_epoch` and `report`. Everything is saved at
    the end, also of a run that is stopped, and in between as often as `Pace` allows.

    Args:
        run: run folder for metrics and checkpoints.
        on_epoch: called with trainer and state after each epoch; its result is added to the row (evaluation).
        report: called with seed and row after each epoch (progress).
        stop: asked after each epoch of all seeds whether to stop. All processes stop if one does.
        pretrained: called during pretraining with the seed, its state, and a function that gives `on_epoch` of it
            (progress).
        say: called with each phase before the epochs, see `Say` (progress).

    Returns:
        The final state of each seed, on the host; None if it was stopped.

    Raises:
        ValueError: a checkpoint is not readable, the identification failed, or there are too few devices.
        OSError: something can't be written; what was saved before is intact.
        NotFiniteError: parameters are no longer finite; those saved before are.
    """
    cfg, fleet, (trainer, params) = run.config, run.fleet, run.trainer
    done = int(devices.text_from_first(lambda: str(run.common_epoch())))
    rounds = [run.seeds[i : i + cfg.side_by_side] for i in range(0, cfg.seeds, cfg.side_by_side)]
    pace = Pace()

    def on_pretraining(seed: int, at: PretrainingState, state: Callable[[], TrainState]) -> None:
        stopping = jax.process_count() == 1 and stop()
        if stopping or int(at.done) == cfg.pretraining.gradient_steps or pace.due():
            pace.do(lambda: run.save_pretraining(seed, at))
        if stopping:
            raise _StoppedError
        pretrained(seed, at, lambda: on_epoch(trainer, state()))

    def on_phase(what: str, done_of_it: int, of: int) -> None:
        if done_of_it and jax.process_count() == 1 and stop():
            raise _StoppedError
        say(what, done_of_it, of)

    begun = time.perf_counter()
    try:
        states = {seeds: _begin(run, seeds, done, on_pretraining, on_phase) for seeds in rounds}
    except _StoppedError:
        return None

    def every_seed() -> Iterator[tuple[int, TrainState]]:
        for seeds in rounds:
            yield from zip(seeds, fleet.take(states[seeds]), strict=True)

    def of_seed(metrics: Row, i: int) -> Row:
        return {name: float(value[i]) for name, value in metrics.items()}

    def save(epoch: int) -> None:
        for seed, state in every_seed():
            devices.in_first(partial(run.save, seed, epoch, state))
        devices.in_first(run.forget_pretraining)  # now that every seed has a checkpoint

    def keep(seed: int, state: TrainState, epoch: int, metrics: Row, rates: Row) -> None:
        if epoch == 0 and run.rows(seed):
            return  # written before the run was killed
        steps, updates = cfg.done_by(epoch, trainer.env.plant.episode_steps)
        row: Row = {"epoch": epoch, "steps": steps, "updates": updates, **metrics}
        if 0 < epoch <= cfg.agent_epochs:
            row |= {name: float(value) for name, value in trainer.diagnose(state, params).items()}
        row |= on_epoch(trainer, state) | rates
        run.append(seed, row)
        report(seed, row)

    if cfg.pretraining.gradient_steps and not done:
        compared: dict[int, Row] = {}
        for seeds in rounds if cfg.gated else ():
            say("compiling", 0, 0)
            states[seeds], metrics = fleet.check(states[seeds], params, True)
            compared |= {seed: of_seed(devices.get(metrics), i) for i, seed in enumerate(seeds)}
        rates = {"seconds": (time.perf_counter() - begun) / cfg.seeds}
        for seed, state in every_seed():  # the result of pretraining is the row of epoch 0
            _check(seed, 0, state)
            devices.in_first(partial(keep, seed, state, 0, compared.get(seed, {}), rates))
        pace.do(partial(save, 0))
    for epoch in range(done, cfg.epochs):
        if epoch in (done, cfg.agent_epochs, cfg.agent_epochs + cfg.pairs.rounds):
            say("compiling", 0, 0)
        steps, updates = cfg.steps_of(epoch, trainer.env.plant.episode_steps)
        for seeds in rounds:
            begun = time.perf_counter()
            if epoch < cfg.agent_epochs:
                states[seeds], metrics = fleet.epoch(states[seeds], params, cfg.agent_steps(epoch))
                if cfg.compared:
                    states[seeds], found = fleet.check(states[seeds], params, False)
                    metrics |= found
            elif epoch < cfg.agent_epochs + cfg.pairs.rounds:
                states[seeds], metrics = fleet.improve(states[seeds], params)
            else:
                states[seeds], metrics = fleet.check(states[seeds], params, True)
            metrics = devices.get(metrics)  # waits for the epoch to end
            seconds = time.perf_counter() - begun
            rates = {
                "seconds": seconds,
                "steps_per_second": steps / seconds,
                "updates_per_second": updates / seconds,
            }
            for i, (seed, state) in enumerate(zip(seeds, fleet.take(states[seeds]), strict=True)):
                _check(seed, epoch + 1, state)
                devices.in_first(partial(keep, seed, state, epoch + 1, of_seed(metrics, i), rates))
        stopping = devices.any_process(stop())
        if devices.any_process(stopping or epoch + 1 == cfg.epochs or (devices.is_first() and pace.due())):
            pace.do(partial(save, epoch + 1))
        if stopping:
            return None
    return {seed: state for seeds in rounds for seed, state in zip(seeds, fleet.take(states[seeds]), strict=True)}


def _check(seed: int, epoch: int, state: TrainState) -> None:
    """Raises NotFiniteError; names what is not finite."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(state.agent):
        if not np.isfinite(leaf).all():
            names = [str(key.name) for key in path if isinstance(key, jax.tree_util.GetAttrKey)]
            name = next((each for each in names if each != "learner"), "agent").replace("_", " ")
            raise NotFiniteError(f"seed {seed}, epoch {epoch}: {name} is not finite any more")


def _begin(
    run: RunFolder,
    seeds: range,
    done: int,
    report: Callable[[int, PretrainingState, Callable[[], TrainState]], None],
    say: Say,
) -> TrainState:
    """States of some seeds after `done` epochs: from their checkpoints, or pretrained and prefilled."""
    trainer, params = run.trainer
    like = jax.eval_shape(trainer.fresh, jax.random.key(0), params)
    kept = [seed for seed in seeds if done in run.whole(seed)] if devices.is_first() else []
    loads = devices.any_process(len(kept) == len(seeds))

    def whole(seed: int) -> TrainState:
        run.forget(seed, done if loads else -1)
        if loads:
            return run.load(seed, done)[0]
        each = run.config.devices // jax.process_count()
        return trainer.start(seed, params, partial(report, seed), run.load_pretraining(seed), each, say)

    states = run.fleet.put([devices.state_from_first(lambda seed=seed: whole(seed), like) for seed in seeds])
    if loads or not run.config.agent_epochs:
        return states
    say("prefill", 0, 0)
    return run.fleet.prefill(states, params)
