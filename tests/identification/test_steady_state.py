"""Identification from r~ and y alone."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.identification import linear_models, records, steady_state
from jaxouter.identification.linear_models import ARX
from jaxouter.identification.records import Record
from jaxouter.plants import make
from tests import lag

KEY = jax.random.key(0)


def test_dc_gain_of_pitch_is_a_third_without_offset() -> None:
    gain, offset, *_ = steady_state.dc_gain(*make("pitch"), KEY)
    assert float(gain) == pytest.approx(1 / 3, rel=0.01)
    assert float(offset) == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize("K", [0.5, -2.0])
def test_dc_gain_of_a_lag_is_exact(K: float) -> None:
    gain, offset, *_ = steady_state.dc_gain(*lag.make(K=K, T=0.2), KEY)
    assert float(gain) == pytest.approx(K, rel=1e-5)
    assert float(offset) == pytest.approx(0.0, abs=1e-5)


def test_offset_is_found() -> None:
    plant, params = lag.make(K=0.5, T=0.2)
    raised = dataclasses.replace(plant, output=lambda params, state: state.y + 3.0)
    gain, offset, *_ = steady_state.dc_gain(raised, params, KEY)
    assert float(gain) == pytest.approx(0.5, rel=1e-5)
    assert float(offset) == pytest.approx(3.0, rel=1e-5)


def test_static_prefilter_inverts_the_identified_line() -> None:
    actor, params = steady_state.static(*lag.make(K=0.5, T=0.2), KEY)
    r = jnp.asarray(0.7, float)
    _, r_tilde = actor.act(params, actor.init(params, r, r), r, r)
    assert float(r_tilde) == pytest.approx(1.4, rel=1e-4)
    assert actor.r_tilde_bounds == (-4.0, 4.0)


def test_offset_is_taken_off_by_the_static_prefilter(monkeypatch: pytest.MonkeyPatch) -> None:
    found = steady_state.DcGain(jnp.asarray(0.5, float), jnp.asarray(-3.0, float))

    def line(*_: Any) -> steady_state.DcGain:
        return found

    monkeypatch.setattr(steady_state, "dc_gain", line)
    actor, params = steady_state.static(*make("heaters"), KEY)
    r = jnp.asarray(10.0, float)
    assert float(actor.act(params, actor.init(params, r, r), r, r)[1]) == pytest.approx(26.0)


@pytest.mark.parametrize(
    ("overrides", "text"),
    [
        ({"K": 0.0}, "no r~ in (-4.0, 4.0) moves its output: y is the same under 8 levels of r~ from -3.5 to 3.5"),
        ({"K": float("nan")}, "y is nan from control step 1 of 50 on under r~ = -3.5"),
        ({"d": 8.0}, "y is the same under 8 levels of r~ from -3.5 to 3.5 for 80 control steps (the dead time), and"),
        ({"K": 1e-4}, "r~ from -4 to 4 moves y by only 0.0007, but the set-points span 2: the gain is too small"),
    ],
)
def test_why_a_plant_does_not_answer_is_said(overrides: dict[str, float], text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(f"the DC gain of lag can't be found: {text}")):
        steady_state.dc_gain(*lag.make(**overrides), KEY)


@pytest.mark.parametrize("unit", [1e-6, 1e5])
def test_a_small_unit_is_no_small_gain(unit: float) -> None:
    """Neither where y has it and r~ has not."""
    plant, params = lag.make()
    one = replace(plant, output=lambda params, state: unit * state.y, setpoint_range=(-unit, unit))
    assert float(steady_state.dc_gain(one, params, KEY).gain) == pytest.approx(0.5 * unit, rel=1e-3)


# The lag with K = 0.5, T = 0.3 s and a dead time of 2.5 steps of 0.1 s: two steps pass, then r~ jumps half way.
HALF = np.exp(-0.05 / 0.3)
A, B = [HALF**2, 0.0], [0.5 * (1 - HALF), 0.5 * HALF * (1 - HALF)]
TRUE = ARX(np.array(A), np.array(B), 0.0, 2, 0.0)


@pytest.fixture(scope="module")
def data() -> Record:
    return records.record(*lag.make(), KEY, 40)


def test_record_is_the_response_to_levels_held_from_long_to_briefly(data: Record) -> None:
    assert data.r_tilde.shape == (40, 50)
    assert data.y.shape == (40, 51)
    assert data.r_tilde.dtype == data.y.dtype == np.float64
    assert -4.0 <= data.r_tilde.min() < -3.9
    assert 3.9 < data.r_tilde.max() <= 4.0
    changes = np.count_nonzero(np.diff(data.r_tilde), axis=1)
    assert changes.min() <= 4
    assert 15 <= changes.max() <= 35
    assert np.all(np.abs(data.y[:, 0]) <= 0.5)
    assert np.ptp(data.y[:, 0]) > 0.9
    # From y_0 with a line full of zeros: r~_k moves y_(k+3) first, by B[0], then the rest of its step.
    expected = data.y[:, :1]
    for k in range(50):
        late = [data.r_tilde[:, [k - i]] if k >= i else np.zeros((40, 1)) for i in (2, 3)]
        expected = np.hstack([expected, A[0] * expected[:, -1:] + B[0] * late[0] + B[1] * late[1]])
    np.testing.assert_allclose(data.y, expected, atol=1e-5)


def test_arx_model_of_a_lag_is_exact_without_noise(data: Record) -> None:
    found = linear_models.fit_arx(data, 2, 2)
    np.testing.assert_allclose(found.a, A, atol=1e-6)
    np.testing.assert_allclose(found.b, B, atol=1e-6)
    assert found.c == pytest.approx(0.0, abs=1e-6)
    assert found.dead == 2
    assert found.sigma < 1e-6


def test_arx_model_has_the_offset_and_the_size_of_the_noise(data: Record) -> None:
    """With white e in the equation itself, for which least squares is consistent."""
    rng = np.random.default_rng(0)
    y = np.zeros_like(data.y)
    for k in range(3, 50):
        e = rng.normal(0.0, 0.05, len(y))
        y[:, k + 1] = A[0] * y[:, k] + B[0] * data.r_tilde[:, k - 2] + B[1] * data.r_tilde[:, k - 3] + 0.2 + e
    found = linear_models.fit_arx(Record(data.r_tilde, y), 2, 2)
    np.testing.assert_allclose(found.a, A, atol=0.05)
    np.testing.assert_allclose(found.b, B, atol=0.005)
    assert found.c == pytest.approx(0.2, abs=0.05)
    assert found.sigma == pytest.approx(0.05, rel=0.1)


@pytest.mark.parametrize("dead", [0, 1, 3])
def test_wrong_dead_time_fits_worse(dead: int, data: Record) -> None:
    assert linear_models.fit_arx(data, 2, dead).sigma > 1e-2


@pytest.mark.parametrize("horizon", [1, 10, 47])
def test_true_model_predicts_without_error(horizon: int, data: Record) -> None:
    assert linear_models.predict(TRUE, data, horizon).shape[::2] == (40, horizon)
    assert linear_models.prediction_error(TRUE, data, horizon) < 1e-5


def test_prediction_error_is_that_of_the_free_run_by_hand() -> None:
    """Y doubles in truth; the model says y_(k+1) = y_k + r~_k: of 2 and 4 it predicts 1 + 1 and 2 + 1."""
    data = Record(np.ones((1, 2)), np.array([[1.0, 2.0, 4.0]]))
    model = ARX(np.ones(1), np.ones(1), 0.0, 0, 0.0)
    np.testing.assert_allclose(linear_models.predict(model, data, 2), [[[2.0, 3.0]]])
    assert linear_models.prediction_error(model, data, 2) == pytest.approx(np.sqrt((0.0**2 + 1.0**2) / 2))
    np.testing.assert_allclose(linear_models.predict(model, data, 1), [[[2.0], [3.0]]])
