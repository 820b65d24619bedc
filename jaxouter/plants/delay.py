"""Delay lines: ring buffers of scalar samples, read at real-valued lags.

A line of length L holds the last L samples of a signal; sample m is in row m mod L, m = 0 at the start of the episode.
Reads before sample 0 give zero, whatever the rows hold, so a line need not be cleared at a reset.

If n samples are written at once, the line ends with a mirror of its first n rows, so that n + 1 consecutive samples
are one slice. Lines that are written and read in blocks may have trailing axes, and so may their lags.
"""

from __future__ import annotations

import math

import chex
import jax
import jax.numpy as jnp


def length(max_delay: float, sample_time: float) -> int:
    """Rows a line needs for delays up to `max_delay` (same unit as `sample_time`)."""
    return round(max_delay / sample_time) + 4


def block_length(max_delay: float, block_time: float, n: int) -> int:
    """Rows, mirror included, of a line of n samples a block, for delays up to `max_delay` (unit of `block_time`)."""
    return n * (math.ceil(round(max_delay / block_time, 5)) + 1)


def write(line: jax.Array, newest: jax.Array, sample: jax.Array) -> jax.Array:
    """`line` (L,) with sample number `newest` (int scalar) set to `sample` (scalar)."""
    return jax.lax.dynamic_update_index_in_dim(line, sample, newest % line.shape[0], 0)


def write_block(lines: jax.Array, block: jax.Array, samples: jax.Array) -> jax.Array:
    """`lines` (S, L, ...) with block number `block` (int scalar) set to `samples` (S, n, ...)."""
    n = samples.shape[1]
    position = block * n % (lines.shape[1] - n)
    lines = jax.lax.dynamic_update_slice_in_dim(lines, samples, position, 1)
    mirror = jnp.where(position == 0, lines.shape[1] - n, position)  # or write the same place again, without a branch
    return jax.lax.dynamic_update_slice_in_dim(lines, samples, mirror, 1)


def _rows(line: jax.Array, start: jax.Array, n: int) -> jax.Array:
    """Read n rows of `line` (L, ...) from row `start` on (scalar, or one per entry of the trailing axes); (n, ...)."""
    if start.ndim == 0:
        return jax.lax.dynamic_slice_in_dim(line, start, n)
    lanes = jnp.arange(start.size, dtype=start.dtype).reshape(1, *start.shape)
    place = (start[None] + _column(start, n, line.ndim)) * start.size + lanes
    return line.reshape(-1).at[place].get(mode="promise_in_bounds")  # on a CPU one index is much faster than two


def _raise(x: jax.Array, ndim: int) -> jax.Array:
    """`x` with leading axes added up to `ndim` axes."""
    return x.reshape((1,) * (ndim - x.ndim) + x.shape)


def _column(like: jax.Array, n: int, ndim: int) -> jax.Array:
    """0 to n - 1 along the first of `ndim` axes, with the dtype of `like`."""
    return jnp.arange(n, dtype=like.dtype).reshape(n, *(1,) * (ndim - 1))


def window(line: jax.Array, first: jax.Array, lag: jax.Array, n: int) -> tuple[jax.Array, jax.Array]:
    """The signal `lag` samples before each of the samples first, ..., first + n - 1, none of which is written yet.

    Args:
        line: samples (L, ...), written in blocks of n.
        first: int scalar, a multiple of n.
        lag: in samples, real, scalar or one per entry of the trailing axes; n <= lag <= L - n.
        n: samples per block.

    Returns:
        weights (n, m) and rows (m, ...). Their product (n, ...) is the signal, linear between samples and zero before
        sample 0. For several lines with one lag the rows are the stored samples; otherwise the weights are the
        identity.
    """
    whole = jnp.floor(-lag)
    start = first + whole.astype(first.dtype)
    past = _rows(line, start % (line.shape[0] - n), n + 1)
    share = -lag - whole
    if line.ndim > 1 and lag.ndim == 0:
        weights = jnp.eye(n, n + 1) * (1.0 - share) + jnp.eye(n, n + 1, 1) * share
        return jnp.where(start + _column(start, n, 2) < 0, 0.0, weights), past
    share = _raise(share, line.ndim)
    # For a whole lag the next sample may not be written yet; its row holds an older value, perhaps not finite.
    value = past[:-1] + jnp.where(share > 0.0, (past[1:] - past[:-1]) * share, 0.0)
    number = _raise(start, line.ndim) + _column(start, n, line.ndim)
    return jnp.eye(n), jnp.where(number < 0, 0.0, value)


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
    # Before sample 0 the signal is zero; the pair (-1, 0) is held only when looking ahead of sample 0.
    return jnp.where((left < -1) | ((left == -1) & (lag > 0)), 0.0, value)


def read_held(line: jax.Array, interval: jax.Array, lag: jax.Array, per_sample: int) -> jax.Array:
    """Mean over one inner interval, `lag` inner intervals ago, of a signal that is held between its samples.

    Exact for a piecewise constant signal, even if a jump falls inside the interval.

    Args:
        line: samples (L,), each held for `per_sample` inner intervals.
        interval: number of the current inner interval, int scalar; it lies within the newest sample's hold.
        lag: in inner intervals, real scalar, 0 <= lag <= (L - 2) * per_sample.
        per_sample: inner intervals per sample.
    """
    chex.assert_rank([line, interval, lag], [1, 0, 0])
    whole = jnp.ceil(lag)
    first = interval - whole.astype(interval.dtype)
    second = jnp.minimum(first + 1, interval)

    def held(i: jax.Array) -> jax.Array:
        return jnp.where(i < 0, 0.0, line[(i // per_sample) % line.shape[0]])

    weight = whole - lag  # share of the interval that lies in the second one
    return (1.0 - weight) * held(first) + weight * held(second)


def held_window(line: jax.Array, newest: jax.Array, lag: jax.Array, n: int) -> tuple[jax.Array, jax.Array]:
    """`read_held` for each of the n inner intervals of the newest sample's hold.

    Args:
        line: samples (L, ...), each held for n inner intervals.
        newest: number of the newest sample, int scalar.
        lag: in inner intervals, real, scalar or one per entry of the trailing axes, n <= lag <= (L - 2) n.
        n: inner intervals per sample.

    Returns:
        weights (n, m) and rows (m, ...), as in `window`.
    """
    lag = lag / n
    whole = jnp.ceil(lag)
    first = newest - whole.astype(newest.dtype)
    earlier, later = (_rows(line, i % line.shape[0], 1) for i in (first, first + 1))
    side_by_side = line.ndim > 1 and lag.ndim == 0
    ndim = 2 if side_by_side else line.ndim
    # The share of each interval that lies in the later hold.
    share = jnp.clip(_column(lag, n, ndim) + 1.0 - n * _raise(1.0 - (whole - lag), ndim), 0.0, 1.0)
    before, not_yet = (_raise(i, ndim) < 0 for i in (first, first + 1))  # before the start: zero
    if side_by_side:
        weights = [jnp.where(before, 0.0, 1.0 - share), jnp.where(not_yet, 0.0, share)]
        return jnp.concatenate(weights, 1), jnp.concatenate([earlier, later])
    earlier, later = jnp.where(before, 0.0, earlier), jnp.where(not_yet, 0.0, later)
    return jnp.eye(n), earlier + (later - earlier) * share
