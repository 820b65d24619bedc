"""The model-predictive baseline on the lag, whose model is known."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from jaxouter.evaluation.baselines import clairvoyant, mpc
from jaxouter.evaluation.baselines.mpc import MPCSettings, innovations_form
from jaxouter.evaluation.baselines.tuning import score, training_episodes
from jaxouter.evaluation.metrics import mae
from jaxouter.evaluation.rollout import rollout
from jaxouter.identification.linear_models import ARX, choose_arx
from jaxouter.identification.records import record
from jaxouter.loop.policy import none
from jaxouter.plants.base import excess
from tests import kinds, lag

KEY = jax.random.key(0)
# K = 0.5, T = 0.3 s, d = 2.5 steps: two steps pass, then r~ jumps in the middle of a step.
HALF = np.exp(-0.05 / 0.3)
TRUE = ARX(np.array([HALF**2, 0.0]), 0.5 * (1 - HALF) * np.array([1.0, HALF]), 0.0, 2, 1e-6)
SETTINGS = MPCSettings(horizon=10, move_weight=0.01, disturbance=1e-3, margin=1.0, noise=1e-3)
BUDGET = 2_500 + 12 * 800


@pytest.fixture(scope="module")
def data():
    """A record with measurement noise."""
    clean = record(*lag.make(), KEY, 20)
    return clean._replace(y=clean.y + np.random.default_rng(0).normal(0.0, 0.01, clean.y.shape))


@pytest.fixture(scope="module")
def tuned():
    return mpc.tune(*lag.make(), KEY, BUDGET, lambda text, share: None)


def true_controller(plant=lag.LAG, **settings):
    return mpc.controller(plant, innovations_form(TRUE), TRUE.sigma, SETTINGS._replace(**settings))


def gain_too_high(scenario):
    return replace(scenario, params=scenario.params.replace(K=1.1 * scenario.params.K))


def loaded(scenario):
    def step(params, state, r_tilde, key):
        return lag.step(params, state, r_tilde + 0.3, key)

    return replace(scenario, plant=replace(scenario.plant, step=step))


def test_innovations_form_simulates_like_the_arx_model():
    model = ARX(np.array([1.1, -0.5, 0.2]), np.array([0.3, -0.1, 0.4]), 0.7, 2, 1.0)
    u, e = np.random.default_rng(0).normal(size=(2, 200))
    y = np.zeros(200)
    for k in range(4, 199):
        y[k + 1] = model.a @ y[[k, k - 1, k - 2]] + model.b @ u[[k - 2, k - 3, k - 4]] + model.c + e[k + 1]
    A, B, C, K, d = innovations_form(model)
    x, outputs = np.zeros(len(A)), []
    for k in range(200):
        outputs.append(C @ x + e[k])
        x = A @ x + B * (u[k] + d) + K * e[k]
    np.testing.assert_allclose(outputs[150:], y[150:], atol=1e-6)
    assert innovations_form(model).gain == pytest.approx(0.6 / 0.2)


@pytest.mark.parametrize(("d", "n", "dead"), [(0.0, 1, 0), (0.2, 1, 2), (0.25, 2, 2)])
def test_dead_time_and_order_are_found(d, n, dead):
    found = choose_arx(record(*lag.make(d=d, max_delay=0.3), KEY, 8), 15)
    assert (len(found.a), found.dead) == (n, dead)
    assert innovations_form(found).gain == pytest.approx(0.5, rel=1e-5)


def test_it_starts_in_steady_state():
    A, B, C, *_ = innovations_form(TRUE)
    x = true_controller().init((), 0.0, 0.4).x[:-1]
    assert C @ x == pytest.approx(0.4)
    np.testing.assert_allclose(A @ x + B * 0.4 / 0.5, x)


INTEGRATOR = ARX(np.array([1.0]), np.array([0.04]), 0.0, 0, 1e-6)


@pytest.mark.parametrize("pole", [1.0, 1.0 - 1e-9, 1.0 + 1e-9, 0.9999])
def test_moves_on_an_integrator_cost_what_they_do_within_the_horizon(pole):
    model = innovations_form(INTEGRATOR._replace(a=np.array([pole])))
    assert mpc.effect(model, 100, 20) == pytest.approx(0.8, rel=0.01)
    assert mpc.effect(innovations_form(TRUE), 50, 10) == pytest.approx(0.5, rel=1e-6)


def test_it_starts_on_an_integrator_where_y_is():
    policy = mpc.controller(kinds.Integrating()[0], innovations_form(INTEGRATOR), 1e-6, SETTINGS)
    x = policy.init((), 0.0, 0.4).x[:-1]
    assert innovations_form(INTEGRATOR).C @ x == pytest.approx(0.4)
    at_rest = policy.init((), 0.4, 0.4)._replace(r_tilde=0.0)
    assert policy.act((), at_rest, 0.4, 0.4)[1] == pytest.approx(0.0, abs=1e-6)


def test_on_an_integrator_it_is_far_better_than_the_inner_loop_alone():
    plant, params = kinds.Integrating()
    arx = choose_arx(record(plant, params, KEY, 8), 30)
    policy = mpc.controller(plant, innovations_form(arx), arx.sigma, SETTINGS._replace(horizon=20))
    episodes = training_episodes(plant, params, KEY, 2)
    assert score(policy, (), episodes) > 0.6 * score(*none(plant), episodes)  # both negative


def test_horizons_reach_beyond_a_long_dead_time_and_stay_where_it_is_short():
    plant = replace(lag.LAG, episode_steps=200)
    assert mpc.horizons_for(plant, 5) == [20, 30, 40, 60]
    assert mpc.horizons_for(plant, 40) == [50, 60, 70, 90]


def test_tuned_is_near_the_controller_of_the_true_model_and_keeps_the_budget(steps, tuned):
    found = rollout(*mpc.build(lag.LAG, tuned), steps)
    settings = {name: tuned.settings[name] for name in MPCSettings._fields}
    true = rollout(true_controller(**settings), (), steps)
    assert mae(found) == pytest.approx(mae(true), rel=0.05)
    assert found.reward.sum() == pytest.approx(true.reward.sum(), rel=0.05)
    assert tuned.steps <= BUDGET


def test_model_from_noisy_data_serves_nearly_as_well_as_the_true_one(steps, data):
    arx = choose_arx(data, 15)
    found = rollout(mpc.controller(lag.LAG, innovations_form(arx), arx.sigma, SETTINGS), (), steps)
    true = rollout(true_controller(), (), steps)
    assert mae(found) == pytest.approx(mae(true), rel=0.05)
    assert found.reward.sum() == pytest.approx(true.reward.sum(), rel=0.05)


def test_cheap_moves_come_near_the_clairvoyant_optimum_within_the_bounds(steps):
    found = rollout(true_controller(horizon=5, move_weight=1e-6), (), steps)
    error = np.mean(np.abs(found.r - found.y), axis=1)
    np.testing.assert_allclose(error, clairvoyant.plan(steps).mae, rtol=0.005)
    assert found.r_tilde.min() == -4.0
    assert found.r_tilde.max() == 4.0


@pytest.mark.parametrize("fault", [gain_too_high, loaded])
def test_no_steady_state_error_is_left(fault, steps):
    found = rollout(true_controller(), (), fault(steps))
    np.testing.assert_allclose(found.y[:, -5:], found.r[:, -5:], atol=1e-4)


@pytest.mark.parametrize("limits", [{"output_limit": 0.5}, {"rate_limit": 0.1}])
def test_limits_are_kept(limits, steps):
    plant = replace(lag.LAG, **limits)

    def worst(controller):
        y = rollout(controller, (), steps).y
        return np.max(excess(plant, y, np.pad(y, ((0, 0), (1, 0)))[:, :-1]))

    assert worst(true_controller(plant)) < 5e-3  # they are soft
    assert worst(true_controller()) > 0.19


def test_limit_that_is_left_is_returned_to():
    """From y = 1 the limit of 0.5 cannot be kept at once; what is asked then is the fastest way back."""
    controller = true_controller(replace(lag.LAG, output_limit=0.5))
    carry = controller.init((), 0.5, 1.0)
    assert controller.act((), carry, 0.5, 1.0)[1] == pytest.approx(-4.0, abs=1e-3)


def test_output_that_is_not_a_number_gives_none():
    controller = true_controller(replace(lag.LAG, output_limit=0.5))
    carry, r_tilde = controller.act((), controller.init((), 0.5, 0.0), 0.5, np.nan)
    assert np.isnan(r_tilde)
    assert np.isnan(controller.act((), carry, 0.5, 0.1)[1])
