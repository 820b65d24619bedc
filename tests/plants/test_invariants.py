"""What must hold for the plants whatever the input: properties under random signals, delays and parameters."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxouter.plants import delay, make
from jaxouter.plants.base import Plant
from tests.precision import X64

KEY = jax.random.key(0)
STEPS = 60
EXACT = 1e-9 if X64 else 2e-4
some = settings(max_examples=20, deadline=None, derandomize=True)
seeds = st.integers(0, 2**31 - 1)
delays = st.one_of(st.sampled_from([0.0, 0.1, 0.5]), st.floats(0.0, 2.0))


@partial(jax.jit, static_argnums=0)
def outputs(plant: Plant, params: Any, state: Any, r_tilde: jax.Array) -> jax.Array:
    """y_1, ..., y_T."""

    def step(state: Any, r_tilde: jax.Array) -> tuple[Any, jax.Array]:
        state = plant.step(params, state, r_tilde, KEY)
        return state, plant.output(params, state)

    return jax.lax.scan(step, state, r_tilde)[1]


def pitch(**overrides: Any) -> tuple[Plant, Any]:
    """In inner steps, so that one compiled function serves all delays."""
    return make("pitch", max_delay=4.0, **overrides)


def pitch_outputs(plant: Plant, params: Any, x0: np.ndarray, r_tilde: np.ndarray) -> np.ndarray:
    state = plant.init(KEY, params)._replace(x=jnp.asarray(x0, float))
    return np.asarray(outputs(plant, params, state, jnp.asarray(r_tilde, float)))


def near(found: np.ndarray, expected: np.ndarray) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=EXACT * (1.0 + np.abs(expected).max()))


@some
@given(seed=seeds, tau=delays, d1=delays, d2=delays, gain=st.floats(0.5, 1.5))
def test_pitch_is_linear_in_state_and_modified_reference_but_for_its_bias(seed, tau, d1, d2, gain):
    rng = np.random.default_rng(seed)
    plant, params = pitch(tau=tau, d1=d1, d2=d2, gain=gain)
    x0, r_tilde = rng.uniform(-1, 1, (2, 4)), rng.uniform(-60, 60, (2, STEPS))
    a, b = rng.uniform(-1, 1, 2)
    bias = pitch_outputs(plant, params, np.zeros(4), np.zeros(STEPS))
    one, other = (pitch_outputs(plant, params, *given) - bias for given in zip(x0, r_tilde, strict=True))
    both = pitch_outputs(plant, params, a * x0[0] + b * x0[1], a * r_tilde[0] + b * r_tilde[1]) - bias
    near(both, a * one + b * other)


@some
@given(seed=seeds, tau=delays, d1=delays, d2=delays, wait=st.integers(1, 30))
def test_pitch_answers_later_what_is_asked_later(seed, tau, d1, d2, wait):
    """From rest without the bias, so that nothing moves before."""
    r_tilde = np.random.default_rng(seed).uniform(-60, 60, STEPS)
    plant, params = pitch(tau=tau, d1=d1, d2=d2, W=(0.0, 0.003, -0.003))
    at_once = pitch_outputs(plant, params, np.zeros(4), r_tilde)
    late = pitch_outputs(plant, params, np.zeros(4), np.append(np.zeros(wait), r_tilde[:-wait]))
    near(late[:wait], np.zeros(wait))
    near(late[wait:], at_once[:-wait])


@some
@given(seed=seeds, lag=st.one_of(st.integers(0, 12).map(float), st.floats(0.0, 12.0)))
def test_a_delay_line_shifts_any_signal_by_any_delay(seed, lag):
    signal = np.random.default_rng(seed).normal(size=40)
    line, found = jnp.zeros(14), []
    for k, value in enumerate(signal):
        line = delay.write(line, jnp.asarray(k), jnp.asarray(value, float))
        found.append(float(delay.read(line, jnp.asarray(k), jnp.asarray(lag, float))))
    asked = np.arange(40) - lag
    expected = np.where(asked < 0, 0.0, np.interp(asked, np.arange(40), signal))
    edge = (asked > -1e-5) & (asked < 1e-5)  # where rounding decides whether sample 0 is reached
    near(np.asarray(found)[~edge], expected[~edge])


def heaters(rng: np.random.Generator, n: int) -> dict[str, Any]:
    """Houses that differ in everything."""
    ranges = dict(Ca=(7, 13), Ua=(0.14, 0.26), x_out=(-20, 5), Pi=(0.3, 18), gain=(0.5, 1.5), x0_mean=(15, 25))
    return {name: rng.uniform(low, high, n) for name, (low, high) in ranges.items()} | {"sigma": 0.0, "x0_spread": 0.0}


def temperatures(r_tilde: np.ndarray, n: int, **overrides: Any) -> np.ndarray:
    """Of the houses after the last hour (n,)."""
    plant, params = make("heaters", n=n, **overrides)
    assert plant.members is not None
    state = plant.init(KEY, params)
    step = jax.jit(plant.step)
    for value in r_tilde:
        state = step(params, state, jnp.asarray(value, float), KEY)
    return np.asarray(plant.members(params, state))


@some
@given(seed=seeds)
def test_permuting_the_houses_permutes_the_temperatures(seed):
    rng = np.random.default_rng(seed)
    houses, order, r_tilde = heaters(rng, 5), rng.permutation(5), rng.uniform(0, 40, 6)
    permuted = {name: value[order] if isinstance(value, np.ndarray) else value for name, value in houses.items()}
    weights = rng.dirichlet(np.ones(5))
    found = temperatures(r_tilde, 5, weights=weights[order], **permuted)
    near(found, temperatures(r_tilde, 5, weights=weights, **houses)[order])


@some
@given(seed=seeds, n=st.sampled_from([2, 5]))
def test_copies_of_one_house_without_noise_are_that_house(seed, n):
    rng = np.random.default_rng(seed)
    house, r_tilde = heaters(rng, 1), rng.uniform(0, 40, 6)
    copies = {name: np.repeat(value, n) if isinstance(value, np.ndarray) else value for name, value in house.items()}
    near(temperatures(r_tilde, n, **copies), np.repeat(temperatures(r_tilde, 1, **house), n))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pitch", "heaters"])
def test_a_million_random_steps_stay_finite(name):
    plant, params = make(name)
    low, high = plant.r_tilde_bounds

    @jax.jit
    def extremes(key: jax.Array) -> jax.Array:
        def step(carry: Any, i: jax.Array) -> tuple[Any, None]:
            state, least, greatest = carry
            key_r, key_step = jax.random.split(jax.random.fold_in(key, i))
            state = plant.step(params, state, jax.random.uniform(key_r, (), float, low, high), key_step)
            y = plant.output(params, state)
            return (state, jnp.minimum(least, y), jnp.maximum(greatest, y)), None

        state = plant.init(key, params)
        y = plant.output(params, state)
        (_, *found), _ = jax.lax.scan(step, (state, y, y), jnp.arange(1_000_000))
        return jnp.stack(found)

    least, greatest = extremes(KEY)
    assert plant.divergence_bounds[0] < least < greatest < plant.divergence_bounds[1]
