"""Spaces of actions and observations, with gymnax's interface and without gymnax."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import chex
import jax
import jax.numpy as jnp

from jaxouter.loop.observation import Memory, Observer
from jaxouter.plants import Plant


@dataclass(frozen=True, eq=False)
class Box:
    """Arrays of one shape within bounds: attributes and results of `gymnax.environments.spaces.Box`."""

    low: jax.Array | float
    """Least values, of `shape` or one number."""
    high: jax.Array | float
    """Greatest values, likewise."""
    shape: tuple[int, ...]
    dtype: Any = jnp.float32

    def sample(self, key: chex.PRNGKey) -> jax.Array:
        """An array of the space, drawn uniformly."""
        return jax.random.uniform(key, self.shape, minval=self.low, maxval=self.high).astype(self.dtype)

    def contains(self, x: jax.Array) -> jax.Array:
        """Whether all of x is within the bounds, bool scalar. Like gymnax, it checks neither shape nor dtype."""
        return jnp.all(x >= self.low) & jnp.all(x <= self.high)


def observation_space(plant: Plant, observer: Observer) -> Box:
    """Observations (3 + 2H,) for r and y within the plant's `divergence_bounds`.

    An episode ends if y leaves them. The leaky integral is a running mean of r - y that starts at 0, so it has the
    bounds of r - y.
    """
    limits = jnp.asarray(plant.divergence_bounds, float)
    r_tilde = jnp.asarray(plant.r_tilde_bounds, float)
    shape = (observer.history,)

    def extreme(r: jax.Array, y: jax.Array, r_tilde: jax.Array) -> jax.Array:
        # Every feature is monotone: it rises with r, past y, past r~ and the integral, and falls with y.
        return observer.features(Memory(jnp.full(shape, r), jnp.full(shape, r_tilde), r - y), r, y)

    low, high = extreme(limits[0], limits[1], r_tilde[0]), extreme(limits[1], limits[0], r_tilde[1])
    return Box(low, high, (observer.size,), low.dtype)
