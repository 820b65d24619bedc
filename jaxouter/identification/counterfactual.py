"""A plant built from recorded episodes: it predicts what each would have been under another r~.

For a linear plant that is the recorded y plus the response to the difference between the new r~ and the recorded one.
The unknown start, load and noise of the episode are already in the recorded y. So a record of (r~, y) and a fitted
response make a plant on which any number of new episodes can be simulated.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from jaxouter.identification.records import Record
from jaxouter.plants import Plant
from jaxouter.plants.base import float_leaves, with_float_leaves


class CounterfactualParams(NamedTuple):
    """Recorded episodes (E, ...), and the response of each; without the axis E, one drawn episode."""

    a: jax.Array  # (E, n), dy_(k+1) = sum_i a_i dy_(k-i) + b_i dr~_(k-i) for the differences to the record
    b: jax.Array  # (E, n)
    r_tilde: jax.Array  # (E, T), recorded
    y: jax.Array  # (E, T + 1), recorded
    smoothed: jax.Array  # (E, T + 1), y with its disturbance smoothed over a quarter of an episode


class CounterfactualState(NamedTuple):
    """Differences to the recorded episode, newest first."""

    dy: jax.Array  # (n,)
    dr_tilde: jax.Array  # (n,)
    k: jax.Array  # int32, control steps since the start


def fit(data: Record, lags: int) -> CounterfactualParams:
    """Fit the response by least squares over all episodes; each episode has its own offset.

    Args:
        data: exciting episodes of one plant.
        lags: n, number of past samples of y and of r~ on which the next y depends; at most half an episode.
    """
    k = np.arange(lags - 1, data.r_tilde.shape[1])
    past = k[:, None] - np.arange(lags)
    rows = np.concatenate([data.y[:, past], data.r_tilde[:, past]], -1)  # (E, T - n + 1, 2 n)
    targets = data.y[:, k + 1]
    level, level_next = rows.mean(1, keepdims=True), targets.mean(1, keepdims=True)
    theta = np.linalg.lstsq((rows - level).reshape(-1, 2 * lags), (targets - level_next).ravel(), rcond=None)[0]
    each = np.broadcast_to(theta, (len(data.y), 2 * lags))
    smoothed = _smoothed(data.y, targets - rows @ theta, theta[:lags])
    found = (each[:, :lags], each[:, lags:], data.r_tilde, data.y, smoothed)
    return CounterfactualParams(*(jnp.asarray(x, float) for x in found))


def _smoothed(y: np.ndarray, disturbance: np.ndarray, a: np.ndarray) -> np.ndarray:
    """`y` (E, T + 1) without the effect of the fast part of the disturbance (E, T - n + 1) on its last samples."""
    window = min(disturbance.shape[1], y.shape[1] // 4) // 2 * 2 + 1
    fast = disturbance - scipy.signal.savgol_filter(disturbance, window, min(2, window - 1))
    effect = np.asarray(scipy.signal.lfilter([1.0], np.append(1.0, -a), fast))
    return np.concatenate([y[:, : -effect.shape[1]], y[:, -effect.shape[1] :] - effect], 1)


@cache
def plant(original: Plant, lags: int) -> Plant:
    """The plant declared like `original` whose parameters are `CounterfactualParams`; cached, as it is a jit key.

    Each training episode replays a recorded one under another r~, and is no longer than it.
    """

    def init(key: chex.PRNGKey, params: CounterfactualParams) -> CounterfactualState:
        del key, params
        return CounterfactualState(jnp.zeros(lags), jnp.zeros(lags), jnp.zeros((), jnp.int32))

    def output(params: CounterfactualParams, state: CounterfactualState) -> jax.Array:
        return params.y[state.k] + state.dy[0]

    def step(
        params: CounterfactualParams, state: CounterfactualState, r_tilde: jax.Array, key: chex.PRNGKey
    ) -> CounterfactualState:
        del key
        dr_tilde = jnp.concatenate([(r_tilde - params.r_tilde[state.k])[None], state.dr_tilde[:-1]])
        dy = jnp.dot(params.a, state.dy) + jnp.dot(params.b, dr_tilde)
        return CounterfactualState(jnp.concatenate([dy[None], state.dy[:-1]]), dr_tilde, state.k + 1)

    def draw(key: chex.PRNGKey, params: CounterfactualParams) -> CounterfactualParams:
        episode = jax.random.randint(key, (), 0, params.y.shape[0])
        return jax.tree.map(lambda leaf: leaf[episode], params)

    def smooth(params: CounterfactualParams) -> CounterfactualParams:
        return params._replace(y=params.smoothed)

    rest: dict[str, Any] = dict(start=None, members=None, reuse=lambda old, fresh: fresh, noise_free=smooth)
    rest |= dict(variables=float_leaves, settled=with_float_leaves, smallest=lambda params: params)
    return replace(original, init=init, step=step, output=output, draw=draw, **rest)
