"""The sensor that measures y. Metrics and rewards use the true y."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
from flax import struct

SENSOR = 2  # folded into the key


@struct.dataclass
class SensorParams:
    """Traced; the default is a perfect sensor."""

    noise: jax.Array  # standard deviation, in the unit of y
    bias: jax.Array  # in the unit of y
    missing: jax.Array  # probability that a sample is lost; the last one is then repeated


def params(noise: float = 0.0, bias: float = 0.0, missing: float = 0.0) -> SensorParams:
    """Sensor parameters from plain numbers.

    Raises:
        ValueError: noise is negative or missing is not a probability.
    """
    if noise < 0 or not 0 <= missing <= 1:
        raise ValueError(f"noise is {noise} and missing is {missing}; noise must be >= 0, missing in [0, 1]")
    return SensorParams(*(jnp.asarray(value, float) for value in (noise, bias, missing)))


def measure(p: SensorParams, key: chex.PRNGKey, y: jax.Array, last: jax.Array) -> jax.Array:
    """The measured y (scalar); a lost sample repeats `last`. The key may be the one of the plant's noise."""

    def disturbed(key: chex.PRNGKey) -> jax.Array:
        # A single draw, as each one takes time to compile.
        noise, chance = jax.random.normal(jax.random.fold_in(key, SENSOR), (2,), y.dtype)
        lost = jax.scipy.special.ndtr(chance) < p.missing
        return jnp.where(lost, last, y + p.bias + p.noise * noise)

    # Nothing is drawn for a sensor without noise or losses (unless it is vmapped: then `cond` runs both branches).
    return jax.lax.cond((p.noise > 0) | (p.missing > 0), disturbed, lambda key: y + p.bias, key)
