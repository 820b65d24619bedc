"""A plant told by numbers alone: a linear model, and an ensemble of others that it may as well be.

y_(k+1) = sum_i a_i y_(k-i) + sum_i b_i r~_(k-i) + c + e, i from 0, where a dead time is zeros at the beginning of b.
Episodes of training draw a member of the ensemble each; undrawn, the parameters are the nominal ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxouter.plants.base import Plant


class Model(NamedTuple):
    """One model, of JAX or NumPy numbers; each with a leading axis in an ensemble."""

    a: Any  # (n,)
    b: Any  # (m,)
    c: Any
    sigma: Any  # standard deviation of e


class ARXParams(NamedTuple):
    """Parameters of the plant; every array is traced."""

    model: Model  # that acts
    ensemble: Model  # each (members, ...), of which `draw` takes one as the model that acts
    held: jax.Array  # (2,), r~ that hold the ends of the range of set-points by the nominal model


class ARXState(NamedTuple):
    """What came last, the newest first."""

    y: jax.Array  # (n,)
    r_tilde: jax.Array  # (m,)


def make(nominal: Model, members: Sequence[Model], **declared: Any) -> tuple[Plant, ARXParams]:
    """The plant of these models and its parameters.

    Args:
        nominal: the model of the parameters that are not drawn.
        members: what may be drawn; each of the shapes of the nominal one.
        **declared: fields of `Plant`.
    """
    plant = Plant(
        init=init, step=step, output=output, start=start, draw=draw, noise_free=noise_free, identified=True, **declared
    )
    gain, offset = np.sum(nominal.b) / (1.0 - np.sum(nominal.a)), nominal.c / (1.0 - np.sum(nominal.a))
    held = np.clip((np.array(plant.setpoint_range) - offset) / gain, *plant.r_tilde_bounds)
    model, *each = (jax.tree.map(lambda leaf: jnp.asarray(leaf, float), one) for one in (nominal, *members))
    ensemble = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
    return plant, ARXParams(model, ensemble, jnp.asarray(held, float))


def _rest(params: ARXParams, r_tilde: jax.Array) -> ARXState:
    """Where the model stays under this r~."""
    p = params.model
    y = (jnp.sum(p.b) * r_tilde + p.c) / (1.0 - jnp.sum(p.a))
    return ARXState(jnp.full(p.a.shape, y), jnp.full(p.b.shape, r_tilde))


def init(key: chex.PRNGKey, params: ARXParams) -> ARXState:
    """At rest in the middle of the set-points."""
    del key
    return _rest(params, jnp.mean(params.held))


def start(key: chex.PRNGKey, params: ARXParams) -> ARXState:
    """A training start: at rest at any of the set-points."""
    low, high = params.held
    return _rest(params, low + (high - low) * jax.random.uniform(key, (), low.dtype))


def draw(key: chex.PRNGKey, params: ARXParams) -> ARXParams:
    """One of the ensemble acts."""
    member = jax.random.randint(key, (), 0, params.ensemble.c.shape[0])
    return params._replace(model=jax.tree.map(lambda leaf: leaf[member], params.ensemble))


def output(params: ARXParams, state: ARXState) -> jax.Array:
    """Y, scalar."""
    del params
    return state.y[0]


def step(params: ARXParams, state: ARXState, r_tilde: jax.Array, key: chex.PRNGKey) -> ARXState:
    """One control step, with e drawn."""
    p = params.model
    r_tilde_past = jnp.concatenate([r_tilde[None], state.r_tilde[:-1]])
    e = p.sigma * jax.random.normal(key, (), p.c.dtype)
    y = jnp.dot(p.a, state.y) + jnp.dot(p.b, r_tilde_past) + p.c + e
    return ARXState(jnp.concatenate([y[None], state.y[:-1]]), r_tilde_past)


def noise_free(params: ARXParams) -> ARXParams:
    """The same models without e."""
    model, ensemble = (one._replace(sigma=jnp.zeros_like(one.sigma)) for one in (params.model, params.ensemble))
    return params._replace(model=model, ensemble=ensemble)
