"""What an update is made of, whichever learner it belongs to."""

from __future__ import annotations

from typing import Any, Literal

import jax
import jax.numpy as jnp
import optax

RateDecay = Literal["constant", "cosine"]
"""Schedule of a learning rate over the training; cosine ends at zero."""


def where(condition: jax.Array, tree: Any, other: Any) -> Any:
    """`tree` if the condition holds, else `other`, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), tree, other)


def averaged(tree: Any, axis: str | None) -> Any:
    """The mean over the members of the mapped axis, each of which has its part of the batch; None: there is but one."""
    return tree if axis is None else jax.lax.pmean(tree, axis)


def of_batch(found: tuple[jax.Array, Any], axis: str | None) -> tuple[jax.Array, Any, jax.Array]:
    """Loss (0 if not finite) and gradient, averaged over all parts of the batch, and whether the loss is finite."""
    loss, gradient = averaged(found, axis)
    finite = jnp.isfinite(loss)
    return jnp.where(finite, loss, 0.0), gradient, finite


def scheduled(rate: float, decay: RateDecay, total_updates: int) -> float | optax.Schedule:
    """A learning rate over `total_updates` updates."""
    return optax.cosine_decay_schedule(rate, max(1, total_updates)) if decay == "cosine" else rate
