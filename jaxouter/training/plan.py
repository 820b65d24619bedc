"""What a training run will be, before any of it: shapes, memory and arithmetic. Nothing is compiled."""

from __future__ import annotations

import math
import os
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxouter.agents.ddpg import DDPGConfig
from jaxouter.training.config import TrainConfig
from jaxouter.training.trainer import FIELDS, build

OPTIMISER_FLOP = 24  # a parameter: Adam, weight decay and Polyak averaging


class Plan(NamedTuple):
    """What a run takes."""

    lines: list[tuple[str, str]]
    """Quantity and value, for people."""
    memory: int
    """Bytes, about, without what JAX and compiled functions take."""
    flop: tuple[float, float]
    """Of a gradient step of the pretraining, and of an update."""

    def check(self) -> None:
        """Raises ValueError where the machine has less memory."""
        there = _there()
        if self.memory > there:
            raise ValueError(
                f"this run needs about {_bytes(self.memory)} of memory and the machine has {_bytes(there)}; take fewer "
                "seeds or environments, a smaller replay or networks (--dry-run shows what takes how much)"
            )


def plan(config: TrainConfig) -> Plan:
    """The plan of a configuration.

    Raises:
        ValueError: the configuration does not fit together.
    """
    trainer, params = build(config)
    observer, start = trainer.env.observer, config.pretraining
    state = jax.eval_shape(trainer.fresh, jax.random.key(0), params)
    hidden = " - ".join(map(str, config.ddpg.hidden))
    networks = {name: _count(getattr(state.learner, name)) for name in ("actor", "critics")}
    parts = {
        "networks, targets, optimisers": _size(state.learner),
        "replay": _size(state.replay),
        "environments": _size((state.env, state.obs, state.noise)),
    }
    whole = _size(state)
    lines = [
        ("observation", f"{observer.size} numbers: r, r - y, integral, {observer.history} past y, as many past r~"),
        ("actor", f"{observer.size} - {hidden} - 1, {networks['actor']:,} parameters"),
        ("critics", f"{config.ddpg.critics} of {observer.size} - {hidden} - 1, {networks['critics']:,} parameters"),
        ("replay", f"{state.replay.rows.shape} float32: environments, steps, {len(FIELDS)} signals"),
        (
            "control steps",
            f"{config.environment_steps:,} a seed, {config.identification_steps:,} of them recorded first",
        ),
        ("updates", f"{config.total_updates:,} a seed in {config.epochs:,} epochs, batch {config.ddpg.batch_size}"),
        *((f"memory, {name}", _bytes(size)) for name, size in parts.items()),
        ("memory of a seed, and a checkpoint", _bytes(whole)),
    ]
    flop = 1e6 * update_mflop(config.ddpg, observer.size)
    lines.append(
        ("arithmetic, updates", f"{flop / 1e6:,.0f} MFLOP each, {flop * config.total_updates:.2g} FLOP a seed")
    )
    here = -(-config.seeds // jax.process_count())
    # Bits by which the batches of an epoch are drawn, twice.
    drawn = 16 * config.epoch // config.environments * config.updates * config.ddpg.batch_size
    memory = (here + 1) * whole + (drawn if config.epochs else 0)  # one more on its way to the disk
    step = 0.0
    if start.gradient_steps:
        steps = start.episode_steps or trainer.env.plant.episode_steps
        lags = start.lags or observer.history
        # Of the activations that back-propagation through an episode keeps, XLA was seen to allocate two thirds.
        activations = observer.size + 2 * sum(config.ddpg.hidden) + 4 * lags
        kept = 4 * start.batch_size * steps * activations
        memory += kept
        widths = (observer.size, *config.ddpg.hidden, 1)
        step = 6 * start.batch_size * steps * (sum(a * b for a, b in pairwise(widths)) + 2 * lags)
        lines += [
            ("pretraining", f"{start.gradient_steps:,} gradient steps on {start.batch_size} episodes of {steps} steps"),
            ("memory, pretraining, about", _bytes(kept)),
            ("arithmetic, pretraining", f"{step / 1e6:,.0f} MFLOP each, {step * start.gradient_steps:.2g} FLOP a seed"),
        ]
    lines.append((f"memory in all, {config.seeds} seeds, about", _bytes(memory)))
    return Plan(lines, memory, (step, flop))


def _there() -> float:
    """Bytes of memory of the machine, or of the container where that has less; inf where nothing tells it."""
    limits = [math.inf]
    with suppress(AttributeError, OSError, ValueError):  # Windows has no sysconf
        limits.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    for path in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with suppress(OSError, ValueError):  # there is none, or it is "max"
            limits.append(int(Path(path).read_text()))
    return min(limit for limit in limits if limit > 0)


def update_mflop(config: DDPGConfig, observations: int) -> int:
    """FLOP that an update needs, in millions, rounded: its matrix products and the optimiser; paper on pitch: 157.

    Forward: target actor and target critics, critics, actor, and a critic once more for the actor's gradient. Backward:
    gradients of all weights of actor and critics, of the inputs of all their layers but the first, and of the action.
    One action.
    """
    hidden, critics = config.hidden, config.critics
    inner = sum(a * b for a, b in pairwise(hidden)) + hidden[-1]
    actor = observations * hidden[0] + inner
    critic = actor + hidden[1]
    to_action = hidden[1] + hidden[-1]
    products = 3 * actor + (3 * critics + 1) * critic + (1 + critics) * inner + to_action
    parameters = actor + critics * critic + (1 + critics) * (sum(hidden) + 1)
    return round((2 * config.batch_size * products + OPTIMISER_FLOP * parameters) / 1e6)


def _count(tree: Any) -> int:
    return sum(int(np.prod(leaf.shape, dtype=object)) for leaf in jax.tree.leaves(tree))


def _size(tree: Any) -> int:
    return sum(int(np.prod(leaf.shape, dtype=object)) * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def _bytes(n: float) -> str:
    for unit in ("B", "KiB", "MiB"):
        if n < 1024:
            return f"{n:.3g} {unit}"
        n /= 1024
    return f"{n:,.3g} GiB"
