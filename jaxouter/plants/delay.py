"""Delay lines: ring buffers of scalar samples, read at real-valued lags.

A line of length L holds the last L samples of a signal; sample number m lies in row m mod L, m = 0 at the start of the
episode. Before sample 0 every line is zero, whatever the rows hold: a line need not be cleared to be reset.
"""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp


def length(max_delay: float, sample_time: float) -> int:
    """Rows a line needs to serve delays up to `max_delay` (same unit as `sample_time`)."""
    return round(max_delay / sample_time) + 4


def write(line: jax.Array, newest: jax.Array, sample: jax.Array) -> jax.Array:
    """`line` (L,) with sample number `newest` (int scalar) set to `sample` (scalar)."""
    return jax.lax.dynamic_update_index_in_dim(line, sample, newest % line.shape[0], 0)


def read(line: jax.Array, newest: jax.Array, lag: jax.Array) -> jax.Array:
    """The signal `lag` samples before sample `newest`: linear between samples, zero before sample 0.

    A lag between -1 and 0 looks ahead of the newest sample: extrapolated from the last two (sample 0: held).

    Args:
        line: samples (L,).
        newest: number of the newest sample, int scalar.
        lag: in samples, real scalar, -1 <= lag <= L - 2.
    """
    chex.assert_rank([line, newest, lag], [1, 0, 0])
    rows = line.shape[0]
    offset = jnp.minimum(jnp.floor(-lag), -1.0)  # from the newest sample back to the left one of the pair
    left = newest + offset.astype(newest.dtype)
    a = line[left % rows]
    b = line[(left + 1) % rows]
    value = jnp.where(left < 0, b, a + (b - a) * (-lag - offset))
    # Left of sample 0 lies the zero past; its pair (-1, 0) may only be held when looking ahead of sample 0.
    return jnp.where((left < -1) | ((left == -1) & (lag > 0)), 0.0, value)


def read_held(line: jax.Array, interval: jax.Array, lag: jax.Array, per_sample: int) -> jax.Array:
    """Mean over one inner interval, `lag` inner intervals ago, of a signal that is held between its samples.

    Exact for a piecewise constant signal also when a jump falls inside the interval, so nothing is smeared.

    Args:
        line: samples (L,), each held for `per_sample` inner intervals.
        interval: number of the present inner interval, int scalar; it lies within the newest sample's hold.
        lag: in inner intervals, real scalar, 0 <= lag <= (L - 2) * per_sample.
        per_sample: inner intervals a sample.
    """
    chex.assert_rank([line, interval, lag], [1, 0, 0])
    whole = jnp.ceil(lag)
    first = interval - whole.astype(interval.dtype)
    second = jnp.minimum(first + 1, interval)

    def held(i: jax.Array) -> jax.Array:
        return jnp.where(i < 0, 0.0, line[(i // per_sample) % line.shape[0]])

    weight = whole - lag  # share of the interval that lies in the second one
    return (1.0 - weight) * held(first) + weight * held(second)
