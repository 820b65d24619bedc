"""The reward R = G(e) + H(r~) + B(y), composed of scalar functions (paper eq. 1)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from jaxouter.plants import Plant


@struct.dataclass
class RewardParams:
    """Constants of the reward, all traced. A limit or threshold that the plant does not have is infinite."""

    alpha_g: jax.Array  # price of the error
    beta_h: jax.Array  # price of a move of r~
    rho_h: jax.Array  # smallest move of r~ that is charged
    beta_b: jax.Array  # price of a move of y
    rho_b: jax.Array  # smallest move of y that is charged
    delta_b: jax.Array  # price of leaving the limits
    output_limit: jax.Array  # on |y|
    rate_limit: jax.Array  # on a move of y
    divergence: jax.Array  # added when an episode ends by divergence


def params(plant: Plant, divergence: float = -50.0) -> RewardParams:
    """The paper's constants, with the plant's declared thresholds and limits; `divergence` in error scales."""

    def declared(value: float | None) -> jax.Array:
        return jnp.asarray(jnp.inf if value is None else value, float)

    return RewardParams(
        alpha_g=declared(0.3),
        beta_h=declared(0.1),
        rho_h=declared(plant.move_threshold),
        beta_b=declared(0.1),
        rho_b=declared(plant.move_threshold),
        delta_b=declared(1.0),
        output_limit=declared(plant.output_limit),
        rate_limit=declared(plant.rate_limit),
        divergence=declared(divergence * plant.error_scale),
    )


def tracking(e: jax.Array, alpha: jax.Array) -> jax.Array:
    """G: the error e >= 0, priced linearly."""
    return -alpha * e


def moves(delta: jax.Array, beta: jax.Array, rho: jax.Array) -> jax.Array:
    """H, and the first part of B: a move delta >= 0, charged if it is at least rho."""
    return jnp.where(delta >= rho, -beta * delta, 0.0)


def excess(value: jax.Array, limit: jax.Array, delta: jax.Array) -> jax.Array:
    """The second part of B: the excess of `value` over `limit`."""
    return -delta * jnp.maximum(0.0, value - limit)


def reward(
    p: RewardParams, r: jax.Array, y: jax.Array, y_before: jax.Array, r_tilde: jax.Array, r_tilde_before: jax.Array
) -> jax.Array:
    """R of one control step, scalar.

    Args:
        p: constants.
        r: reference at t_k.
        y, y_before: outputs at t_(k+1) and t_k.
        r_tilde, r_tilde_before: modified references at t_k and t_(k-1).

    Source: paper eq. 1 and 7, B of sections III and IV.
    """
    delta_y = jnp.abs(y - y_before)
    return (
        tracking(jnp.abs(r - y), p.alpha_g)
        + moves(jnp.abs(r_tilde - r_tilde_before), p.beta_h, p.rho_h)
        + moves(delta_y, p.beta_b, p.rho_b)
        + excess(jnp.abs(y), p.output_limit, p.delta_b)
        + excess(delta_y, p.rate_limit, p.delta_b)
    )
