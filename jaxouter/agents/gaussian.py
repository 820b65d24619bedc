"""What PPO and TRPO share: a random policy, u = mu(s) + sigma n, of which the action is tanh u.

u and not the action is kept: ratios of its probabilities are those of the action's, and nothing is lost where the
action is at its bounds. sigma is a parameter of its own, the same in all states.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxouter.agents.networks import Actor, Value


class GaussianPolicy(NamedTuple):
    """Parameters of the random policy."""

    actor: Any  # of the network that gives mu(s)
    log_sigma: jax.Array  # (m,)


class Sample(NamedTuple):
    """What was drawn, (..., m) and (...)."""

    u: jax.Array  # before the tanh
    log_probability: jax.Array  # density of u, then


def initial(
    hidden: tuple[int, ...], sigma: float, obs_size: int, action_size: int, key: chex.PRNGKey
) -> tuple[GaussianPolicy, Any]:
    """A random policy with this standard deviation, and a random critic."""
    key_actor, key_critic = jax.random.split(key)
    actor = Actor(hidden, action_size).init(key_actor, jnp.zeros(obs_size))
    critic = Value(hidden).init(key_critic, jnp.zeros(obs_size))
    return GaussianPolicy(actor, jnp.full(action_size, jnp.log(sigma))), critic


def mean(hidden: tuple[int, ...], policy: GaussianPolicy, obs: jax.Array) -> jax.Array:
    """mu(s): obs (..., n) -> (..., m)."""
    found = Actor(hidden, policy.log_sigma.shape[-1]).apply(policy.actor, obs)
    assert isinstance(found, jax.Array)
    return found


def log_probability(u: jax.Array, mu: jax.Array, log_sigma: jax.Array) -> jax.Array:
    """Log-density of u (..., m) under N(mu, sigma^2); log_sigma (m,) or (..., m); (...)."""
    log_sigma = jnp.broadcast_to(log_sigma, mu.shape)
    scaled = (u - mu) * jnp.exp(-log_sigma)
    return -jnp.sum(0.5 * scaled**2 + log_sigma + 0.5 * jnp.log(2.0 * jnp.pi), -1)


def divergence(mu: jax.Array, log_sigma: jax.Array, other: jax.Array, log_other: jax.Array) -> jax.Array:
    """KL(N(mu, sigma^2) || N(other, other sigma^2)); means (..., m), logarithms (m,); (...)."""
    of_sigmas = log_other - log_sigma + 0.5 * jnp.expm1(2.0 * (log_sigma - log_other))
    scaled = (mu - other) * jnp.exp(-jnp.broadcast_to(log_other, other.shape))
    return jnp.sum(0.5 * scaled**2, -1) + jnp.sum(of_sigmas)


def draw(
    hidden: tuple[int, ...], policy: GaussianPolicy, obs: jax.Array, normal: jax.Array
) -> tuple[jax.Array, Sample]:
    """An action (m,) in [-1, 1] and what was drawn, given obs (n,) and standard normal numbers (m,)."""
    mu = mean(hidden, policy, obs)
    u = mu + jnp.exp(policy.log_sigma) * normal
    return jnp.tanh(u), Sample(u, log_probability(u, mu, policy.log_sigma))


def normalised(advantage: jax.Array, axis: str | None) -> jax.Array:
    """Advantages with mean 0 and standard deviation 1 over the whole batch, all members of the axis included."""
    moments = jnp.mean(advantage), jnp.mean(advantage**2)
    first, second = moments if axis is None else jax.lax.pmean(moments, axis)
    return (advantage - first) / jnp.sqrt(jnp.maximum(second - first**2, 1e-12))


def check_on_policy(config: Any, positive: tuple[str, ...], not_negative: tuple[str, ...]) -> None:
    """Check the settings that PPO and TRPO share, and others by name.

    Raises:
        ValueError: names the field, its value and what is allowed.
    """
    for field in ("unroll", "epochs", "minibatches", "sigma", "critic_rate", *positive):
        if not getattr(config, field) > 0:
            raise ValueError(f"agent.{field} is {getattr(config, field)}; it must be positive")
    for field in ("whiten", "prefill", *not_negative):
        if not getattr(config, field) >= 0:
            raise ValueError(f"agent.{field} is {getattr(config, field)}; it must not be negative")
    if bool(config.whiten) != bool(config.prefill):
        raise ValueError(
            f"agent.whiten is {config.whiten} and agent.prefill is {config.prefill}; both must be positive, or 0"
        )
    if not 0 <= config.discount < 1 or not 0 <= config.gae_lambda <= 1:
        raise ValueError(
            f"agent.discount is {config.discount} and agent.gae_lambda is {config.gae_lambda}; "
            "they must lie in [0, 1) and in [0, 1]"
        )
    if not config.hidden or min(config.hidden) < 1:
        raise ValueError(f"agent.hidden is {config.hidden}; it must be positive widths")
