"""Actor and critic of the paper (section III-A; Lillicrap et al. 2015, supplement)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp


def dense(features: int, fan_in: int, limit: float | None = None, **rest: Any) -> nn.Dense:
    """A dense layer; weights and biases uniform within +- `limit` (None: 1/sqrt(fan_in)); `rest` goes to flax."""
    bound = fan_in**-0.5 if limit is None else limit

    def uniform(key: jax.Array, shape: Sequence[int], dtype: Any = float) -> jax.Array:
        return jax.random.uniform(key, shape, dtype, -bound, bound)

    return nn.Dense(features, kernel_init=uniform, bias_init=uniform, param_dtype=float, **rest)


class Actor(nn.Module):
    """The policy mu(s) without its final tanh."""

    hidden: tuple[int, ...]
    actions: int

    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        """Obs (..., n) -> pre-activation (..., actions); the action is its tanh."""
        x = obs
        for features in self.hidden:
            x = nn.relu(dense(features, x.shape[-1])(x))
        return dense(self.actions, x.shape[-1], 3e-3)(x)


def before_tanh(hidden: tuple[int, ...], actor: Any, obs: jax.Array) -> jax.Array:
    """Output of an actor with one action, before its tanh: obs (..., n) -> (..., 1)."""
    return cast(jax.Array, Actor(hidden, 1).apply(actor, obs))


def act(hidden: tuple[int, ...], actor: Any, obs: jax.Array) -> jax.Array:
    """Action of an actor with one action: obs (..., n) -> (..., 1) in [-1, 1]."""
    return jnp.tanh(before_tanh(hidden, actor, obs))


class QuadraticCritic(nn.Module):
    """Q(s, a) = V(s) - 0.1 softplus(P(s)) (10 a - m(s))^2: concave in the action, so no actor runs away from it."""

    hidden: tuple[int, ...]

    @nn.compact
    def __call__(self, obs: jax.Array, action: jax.Array) -> jax.Array:
        """Obs (..., n), action (..., actions) -> Q (...)."""
        x, actions = obs, action.shape[-1]
        for features in self.hidden:
            x = nn.silu(dense(features, x.shape[-1])(x))
        x = dense(1 + 2 * actions, x.shape[-1], 3e-3)(x)
        value, middle, curvature = jnp.split(x, [1, 1 + actions], -1)
        return value[..., 0] - jnp.sum(0.1 * nn.softplus(curvature) * (10.0 * action - middle) ** 2, -1)


class Value(nn.Module):
    """V(s)."""

    hidden: tuple[int, ...]

    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        """Obs (..., n) -> V (...)."""
        x = obs
        for features in self.hidden:
            x = nn.silu(dense(features, x.shape[-1])(x))
        return dense(1, x.shape[-1], 3e-3)(x)[..., 0]


class AdvantageCritic(nn.Module):
    """Gain of a change d of the policy's action, g(s) d - softplus(p(s)) d^2: zero at no change, and concave."""

    hidden: tuple[int, ...]

    @nn.compact
    def __call__(self, obs: jax.Array, change: jax.Array) -> jax.Array:
        """Obs (..., n), change (...) -> gain (...)."""
        x = obs
        for features in self.hidden:
            x = nn.silu(dense(features, x.shape[-1])(x))
        x = dense(2, x.shape[-1], 3e-3)(x)
        return x[..., 0] * change - nn.softplus(x[..., 1]) * change**2


class Critic(nn.Module):
    """Q(s, a); the action enters at the second layer."""

    hidden: tuple[int, ...]
    layer_norm: bool

    @nn.compact
    def __call__(self, obs: jax.Array, action: jax.Array) -> jax.Array:
        """Obs (..., n), action (..., actions) -> Q (...)."""
        x = obs
        for i, features in enumerate(self.hidden):
            if i == 1:  # separate weights: the gradient in the action then skips the first layer
                fan_in = x.shape[-1] + action.shape[-1]
                x = dense(features, fan_in)(x) + dense(features, fan_in, use_bias=False, name="action")(action)
            else:
                x = dense(features, x.shape[-1])(x)
            x = nn.LayerNorm(param_dtype=float, force_float32_reductions=False)(x) if self.layer_norm else x
            x = nn.relu(x)
        return dense(1, x.shape[-1], 3e-3)(x)[..., 0]
