"""Delay lines against exact shifts of known signals."""

from __future__ import annotations

from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.plants import delay, make, simulate

ROWS = 8
KEY = jax.random.key(0)


@partial(jax.jit, static_argnums=1)
def fill(samples: jax.Array, rows: int) -> jax.Array:

    def write(line: jax.Array, numbered: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        return delay.write(line, *numbered), None

    return jax.lax.scan(write, jnp.full(rows, jnp.nan), (jnp.arange(len(samples)), samples))[0]


def filled(samples: np.ndarray, rows: int = ROWS) -> jax.Array:
    """A line with nothing but NaN in it, after `samples` were written one by one."""
    return fill(jnp.asarray(samples, float), rows)


read_lanes = jax.jit(jax.vmap(delay.read, (None, None, 0)))
read_held_lanes = jax.jit(jax.vmap(delay.read_held, (None, None, 0, None)), static_argnums=3)


def read(samples: np.ndarray, lags: np.ndarray, rows: int = ROWS) -> np.ndarray:
    """The signal at each of `lags` before the last of `samples`."""
    newest = jnp.asarray(len(samples) - 1)
    return np.asarray(read_lanes(filled(samples, rows), newest, jnp.asarray(lags, float)))


def read_held(samples: np.ndarray, interval: int, lags: np.ndarray, per_sample: int) -> np.ndarray:
    return np.asarray(read_held_lanes(filled(samples), jnp.asarray(interval), jnp.asarray(lags, float), per_sample))


def mean_of_held(samples: np.ndarray, start: float, per_sample: int) -> float:
    """Mean over [start, start + 1] inner intervals of the held signal, zero before 0, by summing overlaps."""
    total = 0.0
    for interval in range(len(samples) * per_sample):
        overlap = max(0.0, min(interval + 1, start + 1) - max(interval, start))
        total += overlap * samples[interval // per_sample]
    return total


def test_write_goes_around_the_ring() -> None:
    line = filled(np.arange(11.0), rows=4)
    chex.assert_trees_all_equal(line, jnp.array([8.0, 9.0, 10.0, 7.0]))


def test_write_leaves_the_other_rows_alone() -> None:
    line = delay.write(jnp.arange(4.0), jnp.asarray(6), jnp.asarray(9.0))
    chex.assert_trees_all_equal(line, jnp.array([0.0, 1.0, 9.0, 3.0]))


@pytest.mark.parametrize("count", [7, 8, 9, 30], ids=lambda n: f"{n}-samples")
def test_ramp_is_shifted_exactly_on_and_off_the_grid(count: int) -> None:
    lags = np.array([0.0, 0.25, 1.0, 1.5, 2.0, 3.75, 5.0, 5.5, 6.0])
    lags = lags[lags <= count - 1]
    ramp = 2.0 + 0.5 * np.arange(count)
    np.testing.assert_allclose(read(ramp, lags), 2.0 + 0.5 * (count - 1 - lags), rtol=1e-6)


def test_step_is_shifted_and_zero_before_sample_0() -> None:
    lags = np.array([0.0, 1.0, 2.0, 2.01, 2.5, 3.0, 3.5, 6.0])
    expected = np.where(2 - lags >= 0, 5.0, 0.0)
    np.testing.assert_array_equal(read(np.full(3, 5.0), lags), expected)


def test_first_sample_is_not_interpolated_with_the_zero_past() -> None:
    np.testing.assert_array_equal(read(np.array([4.0]), np.array([0.0, 0.1, 0.9, 1.0])), [4.0, 0.0, 0.0, 0.0])


def test_negative_lag_extrapolates_the_last_two_samples() -> None:
    lags = np.array([-0.25, -0.5, -0.9])
    ramp = 1.0 - 2.0 * np.arange(20)
    np.testing.assert_allclose(read(ramp, lags), 1.0 - 2.0 * (19 - lags), rtol=1e-6)


def test_negative_lag_at_sample_0_holds_it() -> None:
    np.testing.assert_array_equal(read(np.array([3.0]), np.array([-0.9, -0.5, -0.01])), [3.0, 3.0, 3.0])


@pytest.mark.parametrize(("max_delay", "sample_time"), [(0.0, 0.1), (0.57, 0.01), (0.537, 0.1), (8.0, 0.1)])
def test_line_is_long_enough_for_its_longest_delay(max_delay: float, sample_time: float) -> None:
    rows = delay.length(max_delay, sample_time)
    lag = max_delay / sample_time
    ramp = np.arange(3.0 * rows)
    np.testing.assert_allclose(read(ramp, np.array([lag]), rows), ramp[-1] - lag, rtol=1e-6)


def test_lag_is_traced() -> None:
    traced = chex.assert_max_traces(delay.read, n=1)
    lookup = jax.jit(traced)
    line = filled(np.arange(10.0))
    for lag in (0.0, 0.3, 5.0):
        chex.assert_trees_all_close(
            lookup(line, jnp.asarray(9), jnp.asarray(lag, float)), jnp.asarray(9.0 - lag, float)
        )


@pytest.mark.parametrize("phase", [0, 1, 3])
def test_held_signal_is_shifted_exactly_on_and_off_the_grid(phase: int) -> None:
    per_sample = 4
    samples = np.random.default_rng(0).normal(size=30)
    lags = np.array([0.0, 0.3, 0.5, 1.0, 3.9, 4.0, 4.1, 7.25, 15.0, 24.0])
    interval = 29 * per_sample + phase
    expected = [mean_of_held(samples, interval - lag, per_sample) for lag in lags]
    np.testing.assert_allclose(read_held(samples, interval, lags, per_sample), expected, atol=1e-5)


def test_held_signal_is_zero_before_sample_0() -> None:
    lags = np.array([2.0, 2.25, 3.0, 3.5, 9.0])
    held = read_held(np.array([8.0]), interval=2, lags=lags, per_sample=4)
    np.testing.assert_allclose(held, [8.0, 6.0, 0.0, 0.0, 0.0], rtol=1e-6)


def test_jump_of_a_held_signal_is_not_smeared_over_other_intervals() -> None:
    samples = np.array([0.0, 1.0])  # jumps at the start of inner interval 10
    before, across, after = (
        read_held(samples, interval, np.array([5.4]), per_sample=10)[0] for interval in (14, 15, 16)
    )
    assert before == 0.0
    assert across == pytest.approx(0.6, rel=1e-5)  # from 9.6 to 10.6
    assert after == 1.0


def test_one_compiled_function_serves_a_sweep_of_delays() -> None:
    plant, params = make("pitch", max_delay=8.0)

    def lane(tau: jax.Array, d1: jax.Array, d2: jax.Array) -> jax.Array:
        return simulate(plant, params.replace(tau=tau, d1=d1, d2=d2), jnp.full(200, 16.0), KEY)

    sweep = jax.jit(jax.vmap(chex.assert_max_traces(lane, n=1)))
    for delays in (
        [[0.5, 0.0, 0.0], [0.0, 0.0, 0.0], [0.537, 0.123, 0.0049], [8.0, 0.57, 0.3]],
        [[0.5, 0.57, 0.57], [0.55, 0.01, 0.02], [1.0, 0.2, 0.1], [3.3, 0.0, 0.005]],
    ):
        lanes = sweep(*jnp.array(delays).T)
        assert len({float(y) for y in lanes[:, 60]}) == len(delays), "the lanes must differ"
        for y, (tau, d1, d2) in zip(lanes, delays, strict=True):
            alone = simulate(plant, make("pitch", tau=tau, d1=d1, d2=d2, max_delay=8.0)[1], jnp.full(200, 16.0), KEY)
            chex.assert_trees_all_close(y, alone, atol=1e-4)


@pytest.mark.parametrize("name", ["tau", "d1", "d2"])
@pytest.mark.parametrize("value", [-0.01, 8.01, np.nan])
def test_traced_delay_outside_its_range_gives_nan(name: str, value: float) -> None:
    plant, params = make("pitch", max_delay=8.0)
    y = simulate(plant, params.replace(**{name: jnp.asarray(value, float)}), jnp.full(200, 16.0), KEY)
    assert bool(jnp.isnan(y).all())


@pytest.mark.parametrize("count", [3, 30, 50, 80], ids=lambda n: f"{n}-samples")
def test_window_of_a_line_written_in_blocks_is_what_single_reads_give(count: int) -> None:
    """Around the ring too, and with lags that differ along a trailing axis."""
    n, lags = 10, jnp.array([10.0, 10.3, 17.5, 29.99, 30.0])
    rows = delay.block_length(3.0, 1.0, n)
    samples = np.random.default_rng(0).normal(size=count // n * n)
    lines = jnp.full((1, rows, len(lags)), jnp.nan)
    for block, part in enumerate(samples.reshape(-1, n)):
        lines = delay.write_block(lines, jnp.asarray(block), jnp.broadcast_to(part[None, :, None], (1, n, len(lags))))
    lines, first = lines[0], jnp.asarray(len(samples))  # nan where nothing was ever written
    window = product(delay.window(lines, first, lags, n))
    full = filled(np.concatenate([samples, np.zeros(n)]), rows=count + 2 * n)
    for i in range(n):
        newest = jnp.asarray(len(samples) + i)
        np.testing.assert_allclose(window[i], read_lanes(full, newest, lags), atol=1e-5)
    for j, lag in enumerate(lags):  # alone, and side by side with one lag
        np.testing.assert_allclose(product(delay.window(lines[:, j], first, lag, n)), window[:, j], atol=1e-5)
        together = product(delay.window(jnp.nan_to_num(lines, nan=9.0), first, lag, n))
        np.testing.assert_allclose(together[:, j], window[:, j], atol=1e-5)


@pytest.mark.parametrize("newest", [0, 3, 9, 20])
def test_held_window_is_what_single_reads_give(newest: int) -> None:
    n, lags = 10, jnp.array([10.0, 10.5, 23.7, 60.0])
    samples = np.random.default_rng(1).normal(size=newest + 1)
    line = jnp.nan_to_num(filled(samples), nan=9.0)
    lines, newest = jnp.broadcast_to(line[:, None], (ROWS, 4)), jnp.asarray(newest)
    window = product(delay.held_window(lines, newest, lags, n))
    for i in range(n):
        np.testing.assert_allclose(window[i], read_held_lanes(line, newest * n + i, lags, n), atol=1e-5)
    for j, lag in enumerate(lags):
        np.testing.assert_allclose(product(delay.held_window(line, newest, lag, n)), window[:, j], atol=1e-5)
        np.testing.assert_allclose(product(delay.held_window(lines, newest, lag, n))[:, j], window[:, j], atol=1e-5)


def product(window: tuple[jax.Array, jax.Array]) -> jax.Array:
    """Weights times rows."""
    return jnp.tensordot(*window, 1)
