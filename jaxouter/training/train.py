"""Training as plain Python around the jitted epochs: resume, progress, metrics, checkpoints."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from jaxouter.training.run import Run
from jaxouter.training.trainer import Trainer, TrainState

Row = dict[str, Any]
OnEpoch = Callable[[Trainer, TrainState], Row]
Report = Callable[[int, Row], None]


def begin(run: Run) -> dict[int, tuple[TrainState, int]]:
    """State and epochs done of every seed: from its newest checkpoint, or prefilled.

    Raises:
        ValueError: a checkpoint is not readable, or the identification failed.
    """
    trainer, params = run.trainer
    states = {}
    for seed in run.seeds:
        if run.checkpoints(seed):
            states[seed] = run.load(seed)
        else:
            states[seed] = trainer.prefill(trainer.start(seed, params), params), 0
    for seed, (_, done) in states.items():
        run.forget(seed, done)
    return states


def train(
    run: Run,
    states: dict[int, tuple[TrainState, int]],
    on_epoch: OnEpoch = lambda trainer, state: {},
    report: Report = lambda seed, row: None,
    stop: Callable[[], bool] = lambda: False,
) -> dict[int, TrainState] | None:
    """Train every seed of a run, side by side, to the end.

    Args:
        run: folder; metrics and checkpoints go there.
        states: as `begin` gives them; used up.
        on_epoch: called with trainer and state after each epoch; what it returns joins the row (evaluation).
        report: called with seed and row after each epoch (progress).
        stop: asked after each epoch whether to end early; everything is saved then.

    Returns:
        The final state of each seed; None where it ended early.
    """
    cfg, (trainer, params) = run.config, run.trainer
    for epoch in range(cfg.epochs):
        for seed, (state, done) in states.items():
            if epoch < done:
                continue
            begin = time.perf_counter()
            steps = min(cfg.epoch, cfg.steps - cfg.prefill - epoch * cfg.epoch)
            state, metrics = trainer.epoch(state, params, steps)
            states[seed] = state, epoch + 1
            row: Row = {name: float(value) for name, value in metrics.items()}  # waits for the epoch to end
            seconds = time.perf_counter() - begin
            updates = steps // cfg.environments * cfg.updates
            row = {
                "epoch": epoch + 1,
                "steps": int(state.steps),
                "updates": int(state.learner.updates),
                **row,
                **on_epoch(trainer, state),
                "seconds": seconds,
                "steps_per_second": steps / seconds,
                "updates_per_second": updates / seconds,
            }
            run.append(seed, row)
            run.save(seed, epoch + 1, state)
            report(seed, row)
            if stop():
                return None
    return {seed: state for seed, (state, _) in states.items()}
