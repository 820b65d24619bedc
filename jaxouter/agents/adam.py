"""Adam with the bias corrections folded into the step size: one division per weight where optax takes three."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax


class AdamState(NamedTuple):
    """State of `adam`."""

    steps: jax.Array  # int32, steps so far
    mean: Any  # of the gradients, like the parameters
    square: Any  # mean of their squares, like the parameters


def adam(
    rate: float | optax.Schedule, b1: float = 0.9, b2: float = 0.999, eps: float = 1e-8
) -> optax.GradientTransformation:
    """Adam, equal to `optax.adam` up to rounding.

    Args:
        rate: learning rate, or a schedule of it over the steps so far.
        b1, b2: decay of the means of gradient and squared gradient.
        eps: added to the root of the (corrected) mean square.

    Source: Kingma & Ba 2015, end of section 2.
    """

    def init(params: Any) -> AdamState:
        zeros = jax.tree.map(jnp.zeros_like, params)
        return AdamState(jnp.zeros((), jnp.int32), zeros, jax.tree.map(jnp.copy, zeros))

    def update(updates: Any, state: Any, params: Any = None) -> tuple[Any, AdamState]:
        del params
        mean = jax.tree.map(lambda m, g: b1 * m + (1.0 - b1) * g, state.mean, updates)
        square = jax.tree.map(lambda v, g: b2 * v + (1.0 - b2) * g**2, state.square, updates)
        steps = state.steps + 1
        t = steps.astype(float)
        root = jnp.sqrt(1.0 - b2**t)
        size = -jnp.asarray(rate(state.steps) if callable(rate) else rate) * root / (1.0 - b1**t)
        step = jax.tree.map(lambda m, v: size * m / (jnp.sqrt(v) + eps * root), mean, square)
        return step, AdamState(steps, mean, square)

    return optax.GradientTransformation(init, update)


def descend(optimiser: optax.GradientTransformation, gradient: Any, state: Any, params: Any) -> tuple[Any, Any]:
    """Parameters and optimiser state after one step."""
    with jax.numpy_dtype_promotion("standard"):  # optax's schedules divide integers by floats
        step, state = optimiser.update(gradient, state, params)
    return optax.apply_updates(params, step), state
