"""What tuning a rival takes: episodes of the training distribution, the return on them, and searches."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxouter.evaluation.rollout import rollout
from jaxouter.evaluation.scenarios import Scenario
from jaxouter.loop import sensor
from jaxouter.loop.policy import Policy
from jaxouter.loop.references import telegraph
from jaxouter.plants import Plant

EPISODES = 16
Report = Callable[[str], None]


class Tuned(NamedTuple):
    """What identification and tuning found: plain values, from which the policy is built, and what that cost."""

    settings: dict[str, Any]  # as JSON
    arrays: dict[str, np.ndarray]
    steps: int  # environment steps


def set_points(key: chex.PRNGKey, plant: Plant, steps: int) -> jax.Array:
    """Reference of a training episode, (steps,): one set-point in half of them, else redrawn at random times.

    The probability of a redraw is log-uniform from one to twenty an episode.
    """
    key_rate, key_one, key_run = jax.random.split(key, 3)
    rate = jnp.exp(jax.random.uniform(key_rate, (), float, 0.0, jnp.log(20.0))) / plant.episode_steps
    one = jax.random.bernoulli(key_one)
    return telegraph(key_run, steps, *plant.setpoint_range, jnp.where(one, 0.0, rate))


def training_episodes(plant: Plant, params: Any, key: chex.PRNGKey, episodes: int = EPISODES) -> Scenario:
    """Episodes of the training distribution (spec section 5) as a scenario."""
    key_r, key_draw, key_run = jax.random.split(key, 3)
    r = jax.vmap(lambda key: set_points(key, plant, plant.episode_steps))(jax.random.split(key_r, episodes))
    draw = plant.draw or (lambda key, params: params)
    return Scenario(
        id=f"{plant.name}/training",
        plant=replace(plant, init=plant.training_start),
        params=jax.vmap(draw, (0, None), axis_size=episodes)(jax.random.split(key_draw, episodes), params),
        r=r,
        keys=jax.random.split(key_run, episodes),
        sensor=sensor.params(),
    )


def score(policy: Policy, params: Any, episodes: Scenario) -> float:
    """Mean return, of which each policy seeks the greatest; -inf where y is not finite."""
    reward = rollout(policy, params, episodes).reward
    return float(np.mean(reward.sum(1))) if np.all(np.isfinite(reward)) else -np.inf


def coordinate_search(
    score: Callable[[dict[str, Any]], float],
    grid: Mapping[str, Sequence[Any]],
    start: Mapping[str, Any],
    report: Report = lambda text: None,
) -> tuple[dict[str, Any], float, int]:
    """The best settings found by changing one at a time to its neighbours on the grid, until no change helps.

    Returns:
        Settings, their score, and the number of evaluations.
    """
    known: dict[tuple[Any, ...], float] = {}

    def value(settings: dict[str, Any]) -> float:
        key = tuple(settings.values())
        if key not in known:
            known[key] = score(settings)
            report(f"{len(known)} tried")
        return known[key]

    best = dict(start)
    while True:
        before = value(best)
        for name, values in grid.items():
            while True:
                i = list(values).index(best[name])
                around = [{**best, name: values[j]} for j in (i - 1, i + 1) if 0 <= j < len(values)]
                better = max(around, key=value)
                if value(better) <= value(best):
                    break
                best = better
        if value(best) <= before:
            return best, before, len(known)
