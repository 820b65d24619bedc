"""Exploration noise."""

from __future__ import annotations

import jax


def ornstein_uhlenbeck(x: jax.Array, normal: jax.Array, theta: float, sigma: jax.Array | float) -> jax.Array:
    """The next x of an Ornstein-Uhlenbeck process with mean 0 and unit time step; theta = 1 is white noise.

    Args:
        x: current value, any shape.
        normal: standard normal of the same shape.
        theta, sigma: mean reversion rate and volatility (paper: 0.15, 0.2).

    Source: Lillicrap et al. 2015, supplement; paper section III-A.
    """
    return x - theta * x + sigma * normal
