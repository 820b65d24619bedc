"""The gate: a new actor is kept only if it is better on fresh training episodes than the one before.

Both are evaluated on the same episodes: starts, set-points, noise, loads and the plant's own randomness. The mean gain
must be positive, and no stratum (set-points that stay, jump or move, with or without noise and load) may lose more than
the noise of its estimate: a gate on the mean alone would let a stratum decay.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxouter.loop.bank import BaseLaw
from jaxouter.loop.environment import Environment, EnvParams
from jaxouter.training.environments import step_with
from jaxouter.training.policy import LearnedPolicy

STRATA = 12
OFTEN = 0.25  # share of the steps in which r changes, above which it moves rather than jumps
LOSS = 1.0  # standard errors that a stratum may lose


class Comparison(NamedTuple):
    """Candidates beside the incumbent; each (C,)."""

    gain: jax.Array  # mean gain in reward per step
    error: jax.Array  # its standard error
    worst: jax.Array  # least mean gain of a stratum, in standard errors

    @property
    def better(self) -> jax.Array:
        """Whether the candidate takes over; (C,), bool."""
        return (self.gain > 0.0) & (self.worst > -LOSS)


def reward_of(
    env: Environment, policy: LearnedPolicy, actor: Any, base: BaseLaw, params: EnvParams, key: chex.PRNGKey
) -> tuple[jax.Array, jax.Array]:
    """Mean reward per step of one fresh training episode without exploration, and its stratum (int).

    An output that diverges stays at its bound to the end, at the price of a divergence in each step.
    """
    key_reset, key_run = jax.random.split(key)
    obs, state = env.reset(key_reset, params)

    def step(carry: Any, key: chex.PRNGKey) -> tuple[Any, tuple[jax.Array, jax.Array]]:
        obs, state = carry
        obs, state, reward, _ = step_with(env, policy, base, params, state, policy.action(actor, obs), key)
        return (obs, state), (reward, jnp.where(state.held == 0, 1.0, 0.0))

    keys = jax.random.split(key_run, env.plant.episode_steps)
    (_, last), (rewards, changes) = jax.lax.scan(step, (obs, state), keys)
    stratum = kind(jnp.mean(changes))
    if last.disturbance is not None:
        stratum += jnp.where(last.disturbance.noise > 0.0, 3, 0) + jnp.where(last.disturbance.load.size != 0.0, 6, 0)
    return jnp.mean(rewards), stratum


def kind(changed: jax.Array) -> jax.Array:
    """The kind of a reference, by the share of steps in which it changes: 0 if it stays, 1 if it jumps, else 2."""
    return jnp.where(changed > OFTEN, 2, jnp.where(changed > 0.0, 1, 0))


def compare(
    env: Environment,
    policy: LearnedPolicy,
    incumbent: Any,
    candidates: Any,
    base: BaseLaw,
    params: EnvParams,
    key: chex.PRNGKey,
    episodes: int,
) -> Comparison:
    """Compare actors on fresh episodes.

    Args:
        env, policy: the plant on the training distribution, and the policy.
        incumbent, candidates: parameters of actors; the leaves of the latter have a first axis (C,).
        base, params: base law, and parameters of the environment.
        key: of the episodes.
        episodes: how many.
    """
    actors = jax.tree.map(lambda one, more: jnp.concatenate([one[None], more]), incumbent, candidates)
    each = jax.vmap(lambda actor, key: reward_of(env, policy, actor, base, params, key), (None, 0))
    rewards, strata = jax.vmap(each, (0, None))(actors, jax.random.split(key, episodes))
    return judge(rewards[1:] - rewards[:1], strata[0])


def judge(gains: jax.Array, strata: jax.Array) -> Comparison:
    """What gains (C, episodes) say, given the stratum of each episode (episodes,)."""
    episodes = len(strata)
    member = jnp.where(strata[:, None] == jnp.arange(STRATA)[None], 1.0, 0.0)  # (episodes, strata)
    count = jnp.sum(member, 0)[None]
    mean = gains @ member / jnp.maximum(count, 1.0)  # (C, strata)
    variance = gains**2 @ member / jnp.maximum(count, 1.0) - mean**2
    error = jnp.sqrt(jnp.maximum(variance, 0.0) / jnp.maximum(count - 1.0, 1.0))
    worst = jnp.min(jnp.where(count > 1, mean / jnp.maximum(error, jnp.finfo(error.dtype).tiny), jnp.inf), 1)
    return Comparison(jnp.mean(gains, 1), jnp.std(gains, 1) / episodes**0.5, worst)
