"""Episodes of the training distribution under a JAX policy: what pretraining and the choice of a base law run."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxouter.loop import closed_loop, rewards
from jaxouter.loop.disturbances import UNDISTURBED, Disturbances
from jaxouter.loop.policy import Policy
from jaxouter.loop.references import held, redrawn
from jaxouter.loop.rewards import RewardConfig
from jaxouter.plants import Plant


class Episode(NamedTuple):
    """One episode; each (T, ...)."""

    reward: jax.Array
    r: jax.Array
    y_seen: jax.Array  # measured at t_k
    y: jax.Array  # true, at t_(k+1)
    memory: Any  # the policy's carry before each step


@dataclass(frozen=True)
class TrainingEpisodes:
    """Random starts, set-points, noise and loads. Static and hashable.

    Half of the episodes have measurement noise, half a load, and half a plant without its own disturbance.
    """

    plant: Plant
    disturbances: Disturbances = UNDISTURBED
    reward: RewardConfig = rewards.PAPER
    """Weights of the reward."""

    def run(self, policy: Policy, policy_params: Any, plant_params: Any, key: chex.PRNGKey) -> Episode:
        """One episode of the plant's own length."""
        plant, steps = self.plant, self.plant.episode_steps
        key_draw, key_start, key_r, key_run, key_smooth, key_noise, key_load = jax.random.split(key, 7)
        plant_params = plant_params if plant.draw is None else plant.draw(key_draw, plant_params)
        smooth = jax.random.bernoulli(key_smooth)
        plant_params = jax.tree.map(partial(jnp.where, smooth), plant.noise_free(plant_params), plant_params)
        price = rewards.params(plant, self.reward)
        r = redrawn(key_r, steps, *plant.setpoint_range)
        load, noise = self.loads(key_load, steps), self.noises(key_noise, steps)
        begun = closed_loop.begin(plant, plant_params, plant.training_start(key_start, plant_params))

        def step(carry: Any, x: Any) -> Any:
            loop, memory = carry
            r_k, held_k, noise_k, load_k, key = x
            loop = loop._replace(y_seen=loop.y + noise_k)
            after, remembered, reward, _ = closed_loop.step(
                plant,
                plant_params,
                price,
                policy,
                policy_params,
                loop,
                memory,
                r_k,
                key,
                load=load_k,
                terms=plant.reward_terms,
                held=held_k,
            )
            return (after, remembered), Episode(reward, r_k, loop.y_seen, after.y, memory)

        begin = begun, policy.init(policy_params, r[0], begun.y + noise[0])
        return jax.lax.scan(step, begin, (r, held(r).astype(r.dtype), noise, load, jax.random.split(key_run, steps)))[1]

    def level(self, key: chex.PRNGKey) -> jax.Array:
        """Standard deviation of an episode's measurement noise."""
        return self.disturbances.noise_level(self.plant, key)

    def noises(self, key: chex.PRNGKey, steps: int) -> jax.Array:
        """Measurement noise (steps,)."""
        key_level, key_run = jax.random.split(key)
        return self.level(key_level) * jax.random.normal(key_run, (steps,), float)

    def loads(self, key: chex.PRNGKey, steps: int) -> jax.Array:
        """Load on r~ (steps,): zero, then constant from a random time on."""
        return self.disturbances.load_of(self.plant, key, steps).at(jnp.arange(steps))
