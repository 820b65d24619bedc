"""Plants that are unstable alone: what their records give, and what can't be held."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.identification import lq, unstable
from jaxouter.identification.linear_models import impulse_response, radius
from jaxouter.identification.records import Record, record, within
from jaxouter.identification.steady_state import IdentificationWarning
from jaxouter.loop.disturbances import Disturbances
from jaxouter.loop.policy import Linear, none
from jaxouter.plants import simulate
from jaxouter.plants.arx import Model
from tests import kinds

A, B = 1.08, 0.04  # y_(k+1) = A y_k + B r~_k: |y| beyond B 4 / (A - 1) = 2 can't be brought back
GROWING = kinds.kind([A], [B], divergence_bounds=(-12.0, 12.0))
WITHOUT = Disturbances()


@pytest.fixture(scope="module")
def diverging():
    """The plant, its parameters, and a record in which episodes leave the bounds."""
    plant, params = GROWING()
    data = within(record(plant, params, kinds.key(0), 16), plant.divergence_bounds, 0.0)
    gone = np.isnan(data.y).any(1)
    assert 4 < gone.sum() <= 16
    return plant, params, data


def test_growth_is_found_in_what_is_left_of_the_record(diverging):
    plant, _, data = diverging
    model = unstable.fit(plant, data, 5)
    assert radius(model) == pytest.approx(A, rel=1e-2)
    assert np.sum(model.b) / (1.0 - np.sum(model.a)) == pytest.approx(B / (1.0 - A), rel=0.05)


def test_continued_episodes_are_what_the_plant_would_have_done(diverging):
    plant, params, data = diverging
    model = Model(np.array([A, 0.0, 0.0]), np.array([B, 0.0, 0.0]), 0.0, 0.0)
    new = unstable.continued(plant, data, model)
    assert len(new.y) == len(data.y)
    assert np.abs(new.y[:, -10:]).max() < 0.1  # it would have come to rest
    free = replace(plant, r_tilde_bounds=(-1e6, 1e6))
    for r_tilde, y in zip(new.r_tilde[:4], new.y[:4], strict=True):
        state = plant.init(kinds.key(0), params)._replace(y=jnp.asarray(y[:1], float))
        found = simulate(free, params, jnp.asarray(r_tilde, float), kinds.key(0), state)
        np.testing.assert_allclose(found[:60], y[1:61], atol=1e-3)  # later what was rounded has grown


@pytest.mark.parametrize(("y0", "back"), [(0.0, True), (1.8, True), (-1.9, True), (2.2, False), (-2.5, False)])
def test_what_can_be_brought_back_is_what_the_bounds_of_r_tilde_allow(y0, back):
    plant, _ = GROWING()
    model = Model(np.array([A]), np.array([B]), 0.0, 0.0)
    y = np.append(y0, np.full(kinds.EPISODE, np.nan))
    y[1] = A * y0  # as long as the model's past
    alone = Record(np.zeros((1, kinds.EPISODE)), y[None])
    replayed = unstable.continued(plant, alone, model)
    assert unstable.can_be_brought_back(plant, replayed, impulse_response(model, kinds.EPISODE)).tolist() == [back]


def test_laws_are_compared_from_rest_wherever_the_model_has_it():
    plant, _ = kinds.kind([A], [B], setpoint_range=(2.0, 6.0), r_tilde_bounds=(-20.0, 20.0))()
    model = Model(np.array([A, 0.0]), np.array([B, 0.0]), 0.3, 0.0)
    rests = unstable.resting(plant, model)
    np.testing.assert_allclose(rests.y, 4.0)
    np.testing.assert_allclose(A * 4.0 + B * rests.r_tilde + 0.3, 4.0, rtol=1e-6)


@pytest.mark.parametrize(("dead", "least"), [(0, 15), (25, 30)])
def test_as_many_lags_are_chosen_as_predict_well(dead, least):
    plant, params = kinds.kind([1.03], [0.04], dead)()
    assert unstable.lags(plant, params, kinds.key(1)) == least


def test_the_law_of_diverging_records_holds_the_plant(diverging):
    plant, params, data = diverging
    law = none(plant)[1]
    with pytest.warns(IdentificationWarning, match=r"can be brought back, and 3\d of 32 episodes"):
        found = unstable.identify(plant, params, data, kinds.key(2), 15, WITHOUT, law, 32)
    policy, carry, state = Linear(plant.r_tilde_bounds), None, plant.init(kinds.key(0), params)
    ys = []
    for _ in range(200):
        y = state.y[0]
        carry = policy.init(found.chosen.law, jnp.asarray(0.5), y) if carry is None else carry
        carry, r_tilde = policy.act(found.chosen.law, carry, jnp.asarray(0.5), y)
        state = plant.step(params, state, r_tilde, kinds.key(0))
        ys.append(float(state.y[0]))
    assert np.abs(np.array(ys[100:]) - 0.5).max() < 0.02
    assert found.params.y.shape == (len(found.params.a), kinds.EPISODE + 1)
    assert bool(jnp.isfinite(found.params.y).all())


def test_half_of_the_episodes_in_closed_loop_begin_at_rest(diverging):
    plant, params, _ = diverging
    law = lq.law_for(plant, np.array([A, 0.0]), np.array([B, 0.0]), 1.0)
    found = unstable.in_closed_loop(plant, params, law, kinds.key(5), 8)
    assert len(found.y) == 8
    assert (found.y[:4, 0] == 0.0).all()
    assert (found.y[4:, 0] != 0.0).all()


def test_what_no_r_tilde_can_hold_is_refused_with_the_reason():
    maker = kinds.kind([1.2], [0.01], divergence_bounds=(-12.0, 12.0), setpoint_range=(-1.0, 1.0))
    plant, params = maker()
    weak = replace(plant, r_tilde_bounds=(-0.01, 0.01))
    data = record(weak, params, kinds.key(3), 16)
    with pytest.raises(ValueError, match=r"grows by 1\.2 in a control step.*brings back none"):
        unstable.identify(weak, params, data, jax.random.key(4), 5, WITHOUT, none(weak)[1], 8)
