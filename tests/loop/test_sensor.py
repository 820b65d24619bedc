"""The sensor: what is seen of y."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.loop import sensor
from tests.precision import FLOAT

KEY = jax.random.key(0)
N = 20_000
measure = jax.jit(jax.vmap(sensor.measure, (None, 0, None, None)))


def seen(y: float = 3.0, last: float = -7.0, n: int = N, **settings: float) -> np.ndarray:
    """What n sensors see."""
    keys = jax.random.split(KEY, n)
    return np.asarray(measure(sensor.params(**settings), keys, jnp.asarray(y, float), jnp.asarray(last, float)))


def test_default_is_perfect() -> None:
    np.testing.assert_array_equal(seen(y=3.3), FLOAT.type(3.3))


def test_bias_is_added() -> None:
    np.testing.assert_allclose(seen(y=3.0, bias=-0.5), 2.5)


def test_noise_has_the_given_deviation_and_no_bias() -> None:
    error = seen(y=3.0, noise=0.2).astype(float) - 3.0
    assert abs(error.mean()) < 5 * 0.2 / np.sqrt(N)
    assert abs(error.std() / 0.2 - 1) < 5 / np.sqrt(2 * N)


def test_missing_sample_leaves_the_last_one() -> None:
    np.testing.assert_array_equal(seen(y=3.0, last=-7.0, missing=1.0, bias=1.0, noise=0.1), -7.0)


def test_samples_are_missing_as_often_as_asked() -> None:
    y = seen(y=3.0, last=-7.0, missing=0.3)
    assert set(np.unique(y)) == {np.float32(-7.0), np.float32(3.0)}
    assert abs(np.mean(y == -7.0) - 0.3) < 5 * np.sqrt(0.3 * 0.7 / N)


def test_noise_does_not_tell_which_samples_are_missing() -> None:
    y = seen(y=3.0, last=-7.0, missing=0.5, noise=0.2).astype(float)
    arrived = y[y != -7.0]
    assert abs(arrived.mean() - 3.0) < 5 * 0.2 / np.sqrt(len(arrived))
    assert abs(arrived.std() / 0.2 - 1) < 5 / np.sqrt(2 * len(arrived))


def test_parameters_are_traced() -> None:
    p = sensor.params()
    biases = jnp.array([0.0, 1.0, 2.0])
    y = jnp.asarray(3.0, float)
    lanes = jax.vmap(lambda bias: sensor.measure(replace(p, bias=bias), KEY, y, y))(biases)
    np.testing.assert_allclose(lanes, [3.0, 4.0, 5.0])
    assert lanes.dtype == FLOAT


@pytest.mark.parametrize("settings", [{"noise": -0.1}, {"missing": -0.1}, {"missing": 1.1}])
def test_impossible_settings_are_named(settings: dict[str, float]) -> None:
    ((name, value),) = settings.items()
    with pytest.raises(ValueError, match=rf"{name} is {value}.*noise must be >= 0, missing in \[0, 1\]"):
        sensor.params(**settings)
