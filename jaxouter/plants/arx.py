"""A linear plant: a nominal ARX model, and an ensemble of models for domain randomisation.

y_(k+1) = sum_i a_i y_(k-i) + sum_i b_i r~_(k-i) + c + e, i from 0; a dead time is zeros at the beginning of b.
Each training episode draws a member of the ensemble; otherwise the nominal model is used.
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
    """One model, in JAX or NumPy numbers; an ensemble has a leading axis on each field."""

    a: Any  # (n,)
    b: Any  # (m,)
    c: Any
    sigma: Any  # standard deviation of e


class ARXParams(NamedTuple):
    """Parameters of the plant; every array is traced."""

    model: Model  # the model in use
    ensemble: Model  # each (members, ...); `draw` takes one as the model in use
    held: jax.Array  # (2,), r~ under which the nominal model stays at the ends of the set-point range


class ARXState(NamedTuple):
    """Past samples, newest first."""

    y: jax.Array  # (n,)
    r_tilde: jax.Array  # (m,)


def make(nominal: Model, members: Sequence[Model], **declared: Any) -> tuple[Plant, ARXParams]:
    """The plant of these models and its parameters.

    Args:
        nominal: the model in use unless one is drawn.
        members: models that may be drawn, with the shapes of the nominal one.
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
    """The steady state under this r~."""
    p = params.model
    y = (jnp.sum(p.b) * r_tilde + p.c) / (1.0 - jnp.sum(p.a))
    return ARXState(jnp.full(p.a.shape, y), jnp.full(p.b.shape, r_tilde))


def init(key: chex.PRNGKey, params: ARXParams) -> ARXState:
    """At rest in the middle of the set-points."""
    del key
    return _rest(params, jnp.mean(params.held))


def start(key: chex.PRNGKey, params: ARXParams) -> ARXState:
    """A training start: at rest at a random set-point."""
    low, high = params.held
    return _rest(params, low + (high - low) * jax.random.uniform(key, (), low.dtype))


def draw(key: chex.PRNGKey, params: ARXParams) -> ARXParams:
    """A random member of the ensemble becomes the model in use."""
    member = jax.random.randint(key, (), 0, params.ensemble.c.shape[0])
    return params._replace(model=jax.tree.map(lambda leaf: leaf[member], params.ensemble))


def output(params: ARXParams, state: ARXState) -> jax.Array:
    """Y, scalar."""
    del params
    return state.y[0]


def step(params: ARXParams, state: ARXState, r_tilde: jax.Array, key: chex.PRNGKey) -> ARXState:
    """One control step, with random e."""
    p = params.model
    r_tilde_past = jnp.concatenate([r_tilde[None], state.r_tilde[:-1]])
    e = p.sigma * jax.random.normal(key, (), p.c.dtype)
    y = jnp.dot(p.a, state.y) + jnp.dot(p.b, r_tilde_past) + p.c + e
    return ARXState(jnp.concatenate([y[None], state.y[:-1]]), r_tilde_past)


def noise_free(params: ARXParams) -> ARXParams:
    """The same models without e."""
    model, ensemble = (one._replace(sigma=jnp.zeros_like(one.sigma)) for one in (params.model, params.ensemble))
    return params._replace(model=model, ensemble=ensemble)
