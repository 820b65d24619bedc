"""Measurement noise and loads of training episodes: half of the episodes have each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxouter.plants import Plant


class Load(NamedTuple):
    """A step added to r~ at the plant, which neither reward nor observation sees."""

    since: jax.Array  # control steps; negative in an episode without a load
    size: jax.Array  # in the unit of r~; then zero

    def at(self, k: jax.Array) -> jax.Array:
        """The load at control step k of an episode; (...), as k."""
        return jnp.where(k.astype(self.size.dtype) >= self.since, self.size, 0.0)


@dataclass(frozen=True)
class Disturbances:
    """How much disturbs an episode at most. Static and hashable."""

    noise: float = 0.0
    """Largest standard deviation of measurement noise; 1 is half the set-point range."""
    load: float = 0.0
    """Largest load (unseen step added to r~ at a random time); 1 is half the r~ range."""

    def check(self) -> None:
        """Raises ValueError if a setting is wrong; names the field, its value and what is allowed."""
        for name, value in vars(self).items():
            if value < 0:
                raise ValueError(f"disturbances.{name} is {value}; it must not be negative")

    def noise_level(self, plant: Plant, key: chex.PRNGKey) -> jax.Array:
        """Standard deviation of an episode's measurement noise."""
        low, high = plant.setpoint_range
        return self.noise * (high - low) / 2 * jnp.maximum(0.0, jax.random.uniform(key, (), float, -1.0, 1.0))

    def load_of(self, plant: Plant, key: chex.PRNGKey, steps: int) -> Load:
        """The load of an episode of `steps` control steps."""
        low, high = plant.r_tilde_bounds
        since, size = jax.random.uniform(key, (2,), float, -1.0, 1.0)
        return Load(since * steps, self.load * (high - low) / 2 * jnp.where(since > 0, size, 0.0))


UNDISTURBED = Disturbances()
