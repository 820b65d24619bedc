"""The reward R = G(e) + H(r~) + B(y), composed of scalar functions (paper eq. 1).

What is trained on may have other weights, and terms that the plant declares (`RewardConfig`, `Plant.reward_terms`).
What is reported as `return` is always the paper's.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import struct

from jaxouter.plants import Plant

Term = Callable[[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array], jax.Array]
"""`term(r, y, y_before, r_tilde, r_tilde_before) -> reward`, scalars; arguments as for `reward`."""


@dataclass(frozen=True)
class RewardConfig:
    """Weights of the reward R = G + H + B that is trained on; its negative is the cost of the pretraining.

    The defaults are the paper's. The reported return always has the paper's weights.
    """

    alpha_g: float = 0.3
    """G: price of the error |r - y|."""
    beta_h: float = 0.1
    """H: price of a move of r~."""
    rho_h: float | None = None
    """H: smallest move of r~ that is charged, in the unit of y; None: the plant's."""
    beta_b: float = 0.1
    """B: price of a move of y."""
    rho_b: float | None = None
    """B: smallest move of y that is charged, in the unit of y; None: the plant's."""
    delta_b: float = 1.0
    """B: price of leaving the limits on y and on its rate."""
    divergence: float = -50.0
    """Reward at the end of an episode that diverged, in error scales of the plant."""
    huber: float = 0.0
    """G: errors below this share of the set-point range count by their square, larger ones less half of it; 0: none.
    Without it |r - y| has a kink at rest, about which the loop swings."""
    rest: float = 0.0
    """H: least price of a move d while r rests: of d from rho_h on, of d^2 / rho_h below; 0: none."""
    rest_after: int = 30
    """H: control steps after which an unchanged r rests."""
    terms: float = 1.0
    """Weight of the terms that the plant declares."""

    def check(self) -> None:
        """Raises ValueError if a weight is wrong; names the field, its value and what is allowed."""
        for name, value in dataclasses.asdict(self).items():
            if name == "divergence" and value > 0:
                raise ValueError(f"reward.{name} is {value}; it must not be positive")
            if name != "divergence" and value is not None and value < 0:
                raise ValueError(f"reward.{name} is {value}; it must not be negative")


PAPER = RewardConfig()


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
    huber: jax.Array | None  # width about zero in which the error is squared
    rest: jax.Array | None  # least price of moves of r~ while r rests
    rest_after: jax.Array  # control steps after which it does
    terms: jax.Array  # weight of the plant's own terms


def params(plant: Plant, config: RewardConfig = PAPER) -> RewardParams:
    """The configured constants, with the plant's declared thresholds and limits."""
    low, high = plant.setpoint_range

    def declared(value: float | None) -> jax.Array:
        return jnp.asarray(jnp.inf if value is None else value, float)

    return RewardParams(
        alpha_g=declared(config.alpha_g),
        beta_h=declared(config.beta_h),
        rho_h=declared(plant.move_threshold if config.rho_h is None else config.rho_h),
        beta_b=declared(config.beta_b),
        rho_b=declared(plant.move_threshold if config.rho_b is None else config.rho_b),
        delta_b=declared(config.delta_b),
        output_limit=declared(plant.output_limit),
        rate_limit=declared(plant.rate_limit),
        divergence=declared(config.divergence * plant.error_scale),
        huber=declared(config.huber * (high - low)) if config.huber else None,
        rest=declared(config.rest) if config.rest else None,
        rest_after=declared(config.rest_after),
        terms=declared(config.terms),
    )


def tracking(e: jax.Array, alpha: jax.Array) -> jax.Array:
    """G: the error e >= 0, priced linearly."""
    return -alpha * e


def rounded(e: jax.Array, width: jax.Array) -> jax.Array:
    """Huber's function of the error e >= 0, less half of the width above it (Huber 1964)."""
    small = jnp.minimum(e, width)
    return small * (e - small / 2) / width


def at_rest(delta: jax.Array, beta: jax.Array, rho: jax.Array) -> jax.Array:
    """A move delta >= 0 while r rests: priced by its square below rho, and linearly from there on."""
    return -beta * delta * jnp.where(delta < rho, delta / jnp.where(rho > 0.0, rho, 1.0), 1.0)


def moves(delta: jax.Array, beta: jax.Array, rho: jax.Array) -> jax.Array:
    """H, and the first part of B: a move delta >= 0, charged if it is at least rho."""
    return jnp.where(delta >= rho, -beta * delta, 0.0)


def excess(value: jax.Array, limit: jax.Array, delta: jax.Array) -> jax.Array:
    """The second part of B: the excess of `value` over `limit`."""
    return -delta * jnp.maximum(0.0, value - limit)


def reward(
    p: RewardParams,
    r: jax.Array,
    y: jax.Array,
    y_before: jax.Array,
    r_tilde: jax.Array,
    r_tilde_before: jax.Array,
    terms: tuple[Term, ...] = (),
    held: jax.Array | float = 0.0,
) -> jax.Array:
    """R of one control step, scalar.

    Args:
        p: constants.
        r: reference at t_k.
        y, y_before: outputs at t_(k+1) and t_k.
        r_tilde, r_tilde_before: modified references at t_k and t_(k-1).
        terms: functions to add, of the same signals.
        held: control steps since r last changed, at t_k.

    Source: paper eq. 1 and 7, B of sections III and IV.
    """
    e, delta, delta_y = jnp.abs(r - y), jnp.abs(r_tilde - r_tilde_before), jnp.abs(y - y_before)
    of_paper = (
        tracking(e if p.huber is None else rounded(e, p.huber), p.alpha_g)
        + moves(delta, p.beta_h, p.rho_h)
        + moves(delta_y, p.beta_b, p.rho_b)
        + excess(jnp.abs(y), p.output_limit, p.delta_b)
        + excess(delta_y, p.rate_limit, p.delta_b)
    )
    own = [p.terms * term(r, y, y_before, r_tilde, r_tilde_before) for term in terms]
    if p.rest is not None:
        more = jnp.minimum(at_rest(delta, p.rest, p.rho_h) - moves(delta, p.beta_h, p.rho_h), 0.0)
        own.append(jnp.where(held >= p.rest_after, more, 0.0))
    return sum(own, of_paper)
