"""A plant that is one file and one line in the registry."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter import plants
from tests import lag

KEY = jax.random.key(0)


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(plants.REGISTRY, "lag", lag.make)


def closed_form(t: np.ndarray, K: float, T: float, d: float, start: float = 0.0) -> np.ndarray:
    """Response to a unit step of r~ at time 0."""
    return start * np.exp(-t / T) + K * np.where(t > d, 1.0 - np.exp(-np.maximum(t - d, 0.0) / T), 0.0)


@pytest.mark.parametrize("d", [0.0, 0.04, 0.1, 0.25, 0.3, 1.0, 2.999])
def test_step_response_is_the_closed_form(d: float) -> None:
    y = plants.simulate(*plants.make("lag", K=0.8, T=0.35, d=d, max_delay=3.0), np.ones(60), KEY)
    np.testing.assert_allclose(y, closed_form(0.1 * np.arange(1, 61), 0.8, 0.35, d), atol=1e-5)


def test_start_decays_beside_the_response() -> None:
    plant, params = plants.make("lag", d=0.25)
    state = plant.training_start(KEY, params)
    y0 = float(plant.output(params, state))
    y = plants.simulate(plant, params, np.ones(60), KEY, state)
    assert 0.0 < abs(y0) <= 0.5
    np.testing.assert_allclose(y, closed_form(0.1 * np.arange(1, 61), 0.5, 0.3, 0.25, y0), atol=1e-5)


def test_dead_time_is_traced() -> None:
    plant, params = plants.make("lag", max_delay=3.0)
    dead_times = jnp.array([0.0, 0.25, 1.7, 3.0])
    lanes = jax.vmap(lambda d: plants.simulate(plant, params.replace(d=d), jnp.ones(60), KEY))(dead_times)
    expected = [closed_form(0.1 * np.arange(1, 61), 0.5, 0.3, float(d)) for d in dead_times]
    np.testing.assert_allclose(lanes, expected, atol=1e-5)


def test_wrong_dead_time_is_named() -> None:
    with pytest.raises(ValueError, match=r"d is 0.3 s.*\[0, 0.2\]"):
        plants.make("lag", d=0.3, max_delay=0.2)


def test_it_is_listed_with_the_others() -> None:
    with pytest.raises(ValueError, match="pitch, heaters, lag"):
        plants.make("leg")
