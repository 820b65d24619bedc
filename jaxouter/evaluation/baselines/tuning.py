"""What tuning a baseline takes: episodes of the training distribution, the return on them, and searches."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import chex
import jax
import numpy as np

from jaxouter.evaluation.rollout import rollout
from jaxouter.evaluation.scenarios import Scenario
from jaxouter.loop import sensor
from jaxouter.loop.policy import Policy
from jaxouter.loop.references import redrawn
from jaxouter.plants import Plant

EPISODES = 16
Report = Callable[[str, float], None]
"""Told now and then what was done, and which share of the work that is, at least."""


def training_episodes(plant: Plant, params: Any, key: chex.PRNGKey, episodes: int = EPISODES) -> Scenario:
    """Episodes of the training distribution as a scenario: starts of training, set-points of the plant's range."""
    key_r, key_draw, key_run = jax.random.split(key, 3)
    r = jax.vmap(lambda key: redrawn(key, plant.episode_steps, *plant.setpoint_range))(
        jax.random.split(key_r, episodes)
    )
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
    most: int,
    report: Report = lambda text, share: None,
) -> tuple[dict[str, Any], int]:
    """The best settings found by moving one at a time along its grid, until no move helps or `most` were tried.

    Returns:
        Settings, and the number of evaluations.
    """
    known: dict[tuple[Any, ...], float] = {}

    def value(settings: dict[str, Any]) -> float:
        key = tuple(settings.values())
        if key not in known and len(known) < most:
            known[key] = score(settings)
            report(f"{len(known)} of at most {most} settings", len(known) / most)
        return known.get(key, -np.inf)

    best = dict(start)
    while True:
        before = best
        for name, values in grid.items():
            for direction in (1, -1):
                ahead = list(values)[list(values).index(best[name]) :: direction][1:]
                for candidate in ({**best, name: other} for other in ahead):
                    if value(best) >= value(candidate):
                        break
                    best = candidate
        if best == before:
            return best, len(known)
