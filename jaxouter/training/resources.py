"""Resources of a training run, estimated before it starts: shapes, memory and arithmetic. Nothing is compiled."""

from __future__ import annotations

import math
import os
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxouter.identification import counterfactual
from jaxouter.identification.counterfactual import CounterfactualParams
from jaxouter.loop.environment import EnvParams
from jaxouter.loop.episodes import TrainingEpisodes
from jaxouter.training.config import TrainConfig
from jaxouter.training.environments import TrainState
from jaxouter.training.off_policy import OffPolicyDriver
from jaxouter.training.pretraining import DifferentiableRollout
from jaxouter.training.trainer import Trainer, build


class Resources(NamedTuple):
    """Resources of a run."""

    lines: list[tuple[str, str]]
    """(quantity, value) as text."""
    memory: int
    """Approximate bytes, without JAX itself and compiled functions."""

    def check(self) -> None:
        """Raises ValueError if the machine has less memory."""
        there = _there()
        if self.memory > there:
            raise ValueError(
                f"this run needs about {_bytes(self.memory)} of memory and the machine has {_bytes(there)}; take fewer "
                "seeds or environments, a smaller replay or networks (--dry-run shows what takes how much)"
            )


def resources(config: TrainConfig) -> Resources:
    """Resources of a run with this configuration.

    Raises:
        ValueError: the configuration is inconsistent.
    """
    trainer, params = build(config)
    observer, start = trainer.policy.observer, config.pretraining
    state = jax.eval_shape(trainer.fresh, jax.random.key(0), params)
    of_bank = f", which of {observer.laws} laws acts" if observer.laws else ""
    widths = " - ".join(map(str, (observer.size, *config.agent.hidden, 1)))
    parts = {"agent": _size(state.agent), "data": _size((state.data, state.pairs))}
    parts |= {"environments": _size((state.env, state.obs, state.noise))}
    whole = _size(state)
    lines = [
        (
            "observation",
            f"{observer.size} numbers: r, r - y, integral, {observer.history} past y, as many past r~{of_bank}",
        ),
        ("actor", f"{widths}, {_count(jax.eval_shape(trainer.agent.actor, state.agent)):,} parameters"),
        ("agent", f"{_count(state.agent):,} numbers: networks, targets, optimisers"),
    ]
    if isinstance(trainer.driver, OffPolicyDriver):
        fields = len(trainer.driver.replay.fields)
        lines += [("replay", f"{state.data.rows.shape} float32: environments, steps, {fields} signals")]
    lines += [
        (
            "control steps",
            f"{config.environment_steps:,} per seed, {config.identification_steps:,} of them recorded first",
        ),
        ("updates", f"{config.total_updates:,} per seed in {config.epochs:,} epochs"),
        *((f"memory, {name}", _bytes(size)) for name, size in parts.items()),
        ("memory per seed, and per checkpoint", _bytes(whole)),
    ]
    here = -(-config.seeds // jax.process_count())
    # Random numbers of an epoch are drawn before it; off-policy learners hold those for drawing batches twice.
    data, rounds = config.agent.data, config.epoch // config.environments
    drawn = 16 * rounds * getattr(data, "updates", 1) * getattr(data, "batch_size", 1)
    memory = (here + 1) * whole + (drawn if config.agent_epochs else 0)  # one more while it is being saved
    if start.gradient_steps:
        steps = start.episode_steps or trainer.env.plant.episode_steps
        # Back-propagation keeps activations of the whole episode; XLA was seen to allocate two thirds of them.
        activations = observer.size + 2 * sum(config.agent.hidden) + 4 * (start.lags or observer.history)
        kept = 4 * start.batch_size * steps * activations
        memory += kept
        lines += [
            ("pretraining", f"{start.gradient_steps:,} gradient steps on {start.batch_size} episodes of {steps} steps"),
            ("memory, pretraining, about", _bytes(kept)),
        ]
    lines.append((f"memory in all, {config.seeds} seeds, about", _bytes(memory)))
    return Resources(lines, memory)


def arithmetic(config: TrainConfig) -> tuple[float, float]:
    """FLOP per gradient step of the pretraining and per update, as the compiler counts them; nan if there are none."""
    trainer, params = build(config)
    state = jax.eval_shape(trainer.fresh, jax.random.key(0), params)
    update = math.nan
    if config.agent_epochs:
        batch = jax.eval_shape(trainer.driver.batch_of, state, params)
        update = _flop(trainer.agent.update, state.agent, batch, state.key)
    return _gradient_step(trainer, params, state) if config.pretraining.gradient_steps else math.nan, update


def arithmetic_lines(config: TrainConfig) -> list[tuple[str, str]]:
    """The same as text."""
    counts = config.pretraining.gradient_steps, config.total_updates
    named = zip(("pretraining", "updates"), arithmetic(config), counts, strict=True)
    return [
        (f"arithmetic, {name}", f"{flop / 1e6:,.0f} MFLOP each, {flop * count:.2g} FLOP per seed")
        for name, flop, count in named
        if math.isfinite(flop)
    ]


def _gradient_step(trainer: Trainer, params: EnvParams, state: TrainState) -> float:
    """FLOP of back-propagation through a batch of episodes: those of one control step times the number of steps."""
    start, plant, model = trainer.config.pretraining, trainer.env.plant, params.plant
    steps = start.episode_steps or plant.episode_steps
    if not plant.identified:
        lags = start.lags or trainer.env.observer.history
        plant = counterfactual.plant(plant, lags)
        shapes = (lags,), (lags,), (steps,), (steps + 1,), (steps + 1,)
        leaves: Any = [jax.ShapeDtypeStruct((1, *shape), state.obs.dtype) for shape in shapes]
        model = CounterfactualParams(*leaves)
    one_step = TrainingEpisodes(replace(plant, episode_steps=1), trainer.config.disturbances)
    rollout = DifferentiableRollout.of(start, one_step, trainer.policy, 1)
    learned = trainer.policy_params(state)

    def reward(learned: Any, model: Any, key: Any) -> jax.Array:
        return rollout.mean_reward(learned, model, key)

    return start.batch_size * steps * _flop(jax.value_and_grad(reward), learned, model, state.key)


def _flop(function: Any, *shapes: Any) -> float:
    """FLOP of a call, by the compiler's cost analysis before compilation."""
    found = jax.jit(function).lower(*shapes).cost_analysis()
    return float((found or {}).get("flops", math.nan))


def _there() -> float:
    """Bytes of memory of the machine, or of the container if that has less; inf if unknown."""
    limits = [math.inf]
    with suppress(AttributeError, OSError, ValueError):  # Windows has no sysconf
        limits.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    for path in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with suppress(OSError, ValueError):  # there is none, or it is "max"
            limits.append(int(Path(path).read_text()))
    return min(limit for limit in limits if limit > 0)


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
