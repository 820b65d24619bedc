"""What tuning a baseline takes: the episodes and the reward that the learner is trained on, and searches."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxouter.evaluation.metrics import trained_return
from jaxouter.evaluation.rollout import rollout
from jaxouter.evaluation.scenarios import Scenario
from jaxouter.loop import sensor
from jaxouter.loop.disturbances import UNDISTURBED, Disturbances
from jaxouter.loop.episodes import TrainingEpisodes
from jaxouter.loop.policy import Policy
from jaxouter.loop.references import redrawn
from jaxouter.plants import Plant
from jaxouter.training.config import TrainConfig, preset

EPISODES = 16
DISTURBED = 1  # folded into a key
Report = Callable[[str, float], None]
"""Told now and then what was done, and which share of the work that is, at least."""


def learner(plant: Plant) -> TrainConfig:
    """The plant's default preset, whose noise, loads and reward the baselines are tuned on."""
    return preset(plant.name)


def training_episodes(
    plant: Plant,
    params: Any,
    key: chex.PRNGKey,
    episodes: int = EPISODES,
    disturbances: Disturbances = UNDISTURBED,
) -> Scenario:
    """Episodes of the training distribution as a scenario: starts of training, set-points of the plant's range.

    Args:
        plant, params, key: of the episodes.
        episodes: how many.
        disturbances: of each.
    """
    key_r, key_draw, key_run = jax.random.split(key, 3)
    disturbed = TrainingEpisodes(plant, disturbances)
    key_level, *keys_load = jax.random.split(jax.random.fold_in(key, DISTURBED), 1 + episodes)
    levels = jax.vmap(disturbed.level)(jax.random.split(key_level, episodes))
    loads = jax.vmap(lambda key: disturbed.loads(key, plant.episode_steps))(jnp.stack(keys_load))
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
        sensor=replace(sensor.params(), noise=levels) if disturbances.noise else sensor.params(),
        load=loads if disturbances.load else None,
    )


def learners_episodes(plant: Plant, params: Any, key: chex.PRNGKey) -> Scenario:
    """Training episodes with the noise and the loads of the learner."""
    return training_episodes(plant, params, key, disturbances=learner(plant).disturbances)


def score(policy: Policy, params: Any, episodes: Scenario) -> float:
    """Mean return in the reward that the learner is trained on, of which each policy seeks the greatest.

    It is -inf where y is not finite.
    """
    found = trained_return(rollout(policy, params, episodes), episodes.plant, learner(episodes.plant).reward)
    return -np.inf if found is None else found


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
