"""`lq-exact` and `mpc-exact`: the LQ law and MPC of the true plant. With `oracle` they are the limit.

Nothing about the plant is hidden when they are made: the model is that of the plant without noise, and they are tuned
on the plant itself, by the MAE; leaving the plant's limits more often than the static prefilter has a price. Where a
scenario has sensor noise they are tuned under that. In operation they see r and y alone, without preview.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxouter.evaluation.baselines import lq, mpc
from jaxouter.evaluation.baselines.tuning import Report, learner, training_episodes
from jaxouter.evaluation.cache import Tuned
from jaxouter.evaluation.metrics import mae, share_outside
from jaxouter.evaluation.rollout import rollout
from jaxouter.identification import dynamics, steady_state
from jaxouter.identification.lq import WITHIN, Choice, choose
from jaxouter.identification.records import record, within
from jaxouter.loop.disturbances import Disturbances
from jaxouter.plants import Plant

RECORD = 256  # episodes


@dataclass(frozen=True)
class KnownNoise(Disturbances):
    """Those of training, but that every episode has the same measurement noise."""

    @classmethod
    def of(cls, plant: Plant, noise: float) -> Disturbances:
        """With a standard deviation in the unit of y; 0: as in training."""
        own = learner(plant).disturbances
        return cls(2.0 * noise / float(np.ptp(plant.setpoint_range)), own.load) if noise else own

    def noise_level(self, plant: Plant, key: chex.PRNGKey) -> jax.Array:
        """Standard deviation of an episode's measurement noise."""
        del key
        low, high = plant.setpoint_range
        return jnp.asarray(self.noise * (high - low) / 2, float)


def law(plant: Plant, params: Any, key: chex.PRNGKey, noise: float = 0.0) -> tuple[Choice, int]:
    """The LQ law of the true plant that has the least MAE on it; and the history. 0: with a sensor without noise."""
    key_explore, key_static, key_record, key_choose = jax.random.split(key, 4)
    history, _ = dynamics.suitable_history(plant, params, key_explore)
    _, static = steady_state.static(plant, params, key_static)
    clean = within(record(plant, plant.noise_free(params), key_record, RECORD), plant.divergence_bounds)
    disturbed = KnownNoise.of(plant, noise) if noise else replace(learner(plant).disturbances, noise=0.0)
    return choose(plant, [clean], static, key_choose, history, disturbed, on=params), history


def tune_lq(plant: Plant, params: Any, key: chex.PRNGKey, budget: int, report: Report, noise: float = 0.0) -> Tuned:
    """`law`; `budget` is no bound."""
    del budget, report
    found, _ = law(plant, params, key, noise)
    return lq.kept(found, RECORD * plant.episode_steps)


def tune_mpc(plant: Plant, params: Any, key: chex.PRNGKey, budget: int, report: Report, noise: float = 0.0) -> Tuned:
    """As `mpc`, but for the model and the MAE; `budget` bounds the settings that are tried."""
    key_record, key_episodes, key_static = jax.random.split(key, 3)
    clean = within(record(plant, plant.noise_free(params), key_record, RECORD), plant.divergence_bounds)
    report("identifying its model", 0.0)
    episodes = training_episodes(plant, params, key_episodes, disturbances=KnownNoise.of(plant, noise))

    static = steady_state.static(plant, params, key_static)
    allowed = share_outside(rollout(*static, episodes), plant) + WITHIN

    def score(controller: mpc.MPC) -> float:
        traces = rollout(controller, (), episodes)
        more = max(0.0, share_outside(traces, plant) - allowed)
        cost = mae(traces) + more * float(np.ptp(plant.setpoint_range))
        return -cost if np.isfinite(cost) else -np.inf

    return mpc.tuned(plant, clean, score, budget, episodes.r.size, report)
