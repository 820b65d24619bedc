"""Identification of a plant through its own input and output; no parameter of the plant is read."""

from __future__ import annotations

from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxouter.loop.policy import Affine, AffineParams
from jaxouter.plants import Plant, simulate

LEVELS = 8


class DcGain(NamedTuple):
    """y = offset + gain * r~ in steady state."""

    gain: jax.Array
    offset: jax.Array


def dc_gain(plant: Plant, params: Any, key: chex.PRNGKey) -> DcGain:
    """The affine DC gain from constant-r~ episodes, one at each of 8 levels of r~ (8 episodes of environment steps).

    Each starts like a training episode; a line is fitted through the last tenth of each.

    Raises:
        ValueError: y did not depend on r~, or was not finite.
    """
    low, high = plant.r_tilde_bounds
    levels = low + (high - low) * (jnp.arange(LEVELS, dtype=float) + 0.5) / LEVELS

    def episode(level: jax.Array, key: chex.PRNGKey) -> jax.Array:
        key_start, key_run = jax.random.split(key)
        state = plant.training_start(key_start, params)
        y = simulate(plant, params, jnp.full(plant.episode_steps, level), key_run, state)
        return jnp.mean(y[-max(1, plant.episode_steps // 10) :])

    y = jax.vmap(episode)(levels, jax.random.split(key, LEVELS))
    centred = levels - jnp.mean(levels)
    gain = jnp.sum(centred * y) / jnp.sum(centred**2)
    if not jnp.isfinite(gain) or abs(gain) < 1e-6:
        raise ValueError(f"the DC gain of {plant.name} came out as {gain}: no r~ in {(low, high)} moves its output")
    return DcGain(gain, jnp.mean(y) - gain * jnp.mean(levels))


def static(plant: Plant, params: Any, key: chex.PRNGKey) -> tuple[Affine, AffineParams]:
    """The static prefilter: the inverse of the identified affine DC gain, r~ = (r - offset) / gain."""
    identified = dc_gain(plant, params, key)
    return Affine(plant.r_tilde_bounds), AffineParams(1.0 / identified.gain, -identified.offset / identified.gain)
