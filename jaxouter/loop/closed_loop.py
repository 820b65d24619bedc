"""One control step of the closed loop: policy, plant, sensor, reward. Every roll-out uses this code.

At t_k the policy sees r_k and the measured y_k and chooses r~_k, which is held until t_(k+1). Callers pass in what
differs: how y is measured (`Measure`), and how an output that is not finite is treated (`Treat`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxouter.loop import rewards
from jaxouter.loop.policy import Policy
from jaxouter.loop.rewards import RewardParams, Term
from jaxouter.plants import Plant

Measure = Callable[[jax.Array, jax.Array], jax.Array]
"""`measure(y, last) -> y_seen`: what the sensor reads, given the true y and its last reading."""
Treat = Callable[[jax.Array, jax.Array], tuple[jax.Array, Any]]
"""`treat(r_tilde, y) -> y, found`: the output to go on with after r~, and any result for the caller."""


class LoopState(NamedTuple):
    """State of the loop at t_k, without the policy's."""

    plant: Any
    y: jax.Array  # true output
    y_seen: jax.Array  # measured output
    r_tilde: jax.Array  # r~_(k-1)


def exactly(y: jax.Array, last: jax.Array) -> jax.Array:
    """A perfect sensor."""
    del last
    return y


def as_it_is(r_tilde: jax.Array, y: jax.Array) -> tuple[jax.Array, tuple[()]]:
    """The plant's output, unchanged."""
    del r_tilde
    return y, ()


def begin(plant: Plant, params: Any, state: Any, measure: Measure = exactly) -> LoopState:
    """The loop at t_0, from the plant's parameters and state; r~_(-1) is y_0 clipped to the bounds of r~."""
    y = plant.output(params, state)
    return LoopState(state, y, measure(y, y), jnp.clip(y, *plant.r_tilde_bounds))


def advance(
    plant: Plant,
    params: Any,
    price: RewardParams,
    state: LoopState,
    r: jax.Array,
    r_tilde: jax.Array,
    key: chex.PRNGKey,
    measure: Measure = exactly,
    treat: Treat = as_it_is,
    load: jax.Array | float = 0.0,
    terms: tuple[Term, ...] = (),
    held: jax.Array | float = 0.0,
) -> tuple[LoopState, jax.Array, Any]:
    """One control step under r~ (scalar), clipped to its bounds.

    Args:
        plant, params: the plant and its parameters, unbatched.
        price: constants of the reward.
        state: at t_k.
        r, r_tilde: r_k and r~_k.
        key: randomness of the plant.
        measure, treat: see `Measure` and `Treat`.
        load: disturbance that is added to r~ at the plant; neither reward nor observation sees it.
        terms: of the reward, beside the paper's.
        held: control steps since r last changed, which the reward may depend on.

    Returns:
        The state at t_(k+1), the reward on the true outputs, and the result of `treat`.
    """
    r_tilde = jnp.clip(r_tilde, *plant.r_tilde_bounds)
    plant_state = plant.step(params, state.plant, r_tilde + load, key)
    y, found = treat(r_tilde, plant.output(params, plant_state))
    reward = rewards.reward(price, r, y, state.y, r_tilde, state.r_tilde, terms, held)
    return LoopState(plant_state, y, measure(y, state.y_seen), r_tilde), reward, found


def step(
    plant: Plant,
    params: Any,
    price: RewardParams,
    policy: Policy,
    policy_params: Any,
    state: LoopState,
    memory: Any,
    r: jax.Array,
    key: chex.PRNGKey,
    key_policy: chex.PRNGKey | None = None,
    measure: Measure = exactly,
    treat: Treat = as_it_is,
    load: jax.Array | float = 0.0,
    terms: tuple[Term, ...] = (),
    held: jax.Array | float = 0.0,
) -> tuple[LoopState, Any, jax.Array, Any]:
    """One control step under a JAX policy with its memory (carry); otherwise like `advance`.

    Returns:
        The state at t_(k+1), the memory, the reward, and the result of `treat`.
    """
    memory, r_tilde = policy.act(policy_params, memory, r, state.y_seen, key_policy)
    state, reward, found = advance(plant, params, price, state, r, r_tilde, key, measure, treat, load, terms, held)
    return state, memory, reward, found
