"""Returns and advantages of consecutive steps of one environment."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp


def n_step_return(
    reward: jax.Array, terminated: jax.Array, truncated: jax.Array, discount: float
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return of up to n consecutive steps (n,), cut at the first termination or truncation.

    A truncated step is bootstrapped from its final observation. A terminated one is not, even if also truncated.

    Returns:
        The discounted sum of rewards, the discount of the bootstrapped value (0 where terminated), and the index of
        the last step used.
    """
    chex.assert_rank([reward, terminated, truncated], 1)
    done = terminated | truncated
    running = jnp.cumprod(jnp.concatenate([jnp.ones(1, bool), ~done[:-1]]).astype(reward.dtype))
    powers = discount ** jnp.arange(reward.shape[0], dtype=reward.dtype)
    last = jnp.sum(running).astype(jnp.int32) - 1
    bootstrap = powers[last] * discount * jnp.where(terminated[last], 0.0, 1.0)
    return jnp.sum(running * powers * reward), bootstrap, last


def generalised_advantage(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminated: jax.Array,
    done: jax.Array,
    discount: float,
    gae_lambda: float,
) -> jax.Array:
    """Generalised advantages (T,): A_k = delta_k + discount lambda A_(k+1); the sum stops where an episode ends.

    Args:
        reward: (T,).
        value, next_value: (T,), of the observation before each step, and of the one after it, before any reset.
        terminated, done: (T,), bool; a truncated step is bootstrapped, a terminated one is not.
        discount, gae_lambda: per control step.

    Source: Schulman et al., High-dimensional continuous control using generalised advantage estimation, 2016, eq. 16.
    """
    delta = reward + discount * jnp.where(terminated, 0.0, next_value) - value

    def step(after: jax.Array, x: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        delta_k, done_k = x
        advantage = delta_k + discount * gae_lambda * jnp.where(done_k, 0.0, after)
        return advantage, advantage

    return jax.lax.scan(step, jnp.zeros_like(delta[0]), (delta, done), reverse=True)[1]
