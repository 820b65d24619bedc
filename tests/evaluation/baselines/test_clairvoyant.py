from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.evaluation import scenarios
from jaxouter.evaluation.baselines.clairvoyant import Replay, plan
from jaxouter.evaluation.rollout import rollout
from jaxouter.evaluation.scenarios import Scenario
from jaxouter.identification import steady_state
from jaxouter.loop.policy import none
from tests import lag
from tests.precision import FLOAT, makes_nan

K, T, DEAD_STEPS = 0.5, 0.3, 2


@dataclass(frozen=True)
class LagWithPlan:
    scenario: Scenario
    plan: object


def lag_scenario(plant=lag.LAG):
    """Set-points -0.8, 0.3 and 1.5 (reachable up to 2) from rest, with a dead time of two control steps."""
    _, params = lag.make(K=K, T=T, d=DEAD_STEPS * lag.CONTROL_STEP)
    r = jnp.repeat(jnp.array([[-0.8], [0.3], [1.5]]), 50, axis=1)
    params = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (3,)), params)
    return Scenario("lag/steps", plant, params, r, jax.random.split(jax.random.key(0), 3))


@pytest.fixture(scope="module")
def on_lag():
    scenario = lag_scenario()
    return LagWithPlan(scenario, plan(scenario))


def mae(traces):
    return np.mean(np.abs(traces.r - traces.y), axis=1)


def replayed(scenario, planned):
    return rollout(Replay(), planned.r_tilde, scenario, per_episode=True)


def test_optimum_on_the_lag_is_dead_time_plus_saturated_rise(on_lag):
    k = np.arange(50)
    fastest = 4.0 * K * (1 - np.exp(-np.maximum(0, k + 1 - DEAD_STEPS) * lag.CONTROL_STEP / T))
    expected = [np.mean(np.maximum(0.0, abs(r) - fastest)) for r in (-0.8, 0.3, 1.5)]
    np.testing.assert_allclose(on_lag.plan.mae, expected, rtol=1e-5)
    np.testing.assert_array_equal(on_lag.plan.violation, 0.0)


def test_no_other_policy_is_below_it_on_any_episode(on_lag):
    scenario, plant = on_lag.scenario, on_lag.scenario.plant
    _, params = lag.make(K=K, T=T, d=DEAD_STEPS * lag.CONTROL_STEP)
    for policy in (none(plant), steady_state.static(plant, params, jax.random.key(0))):
        assert (mae(rollout(*policy, scenario)) >= on_lag.plan.mae - 1e-6).all()
    rng = np.random.default_rng(0)
    for spread in (0.1, 1.0, 8.0):
        r_tilde = np.clip(on_lag.plan.r_tilde + rng.normal(0, spread, on_lag.plan.r_tilde.shape), -4, 4)
        noisy = on_lag.plan._replace(r_tilde=r_tilde.astype(FLOAT))
        assert (mae(replayed(scenario, noisy)) >= on_lag.plan.mae - 1e-6).all()


@pytest.mark.parametrize(
    ("identifier", "episodes", "low", "high"),
    [
        ("pitch/paper", 1, 2.58, 2.60),
        ("pitch/load", 1, 2.5, 2.7),
        ("pitch/uncertainty", 1, 2.6, 3.4),
        ("heaters/paper-4", 3, 0.1, 0.47),
        ("heaters/mixed-stock", 2, 0.1, 0.47),
    ],
)
def test_simulated_plan_has_the_optimum_and_keeps_the_limits(identifier, episodes, low, high):
    scenario = scenarios.get(identifier, episodes)
    planned = plan(scenario)
    traces = replayed(scenario, planned)
    np.testing.assert_allclose(mae(traces), planned.mae, rtol=1e-3)
    assert low < planned.mae.mean() < high
    np.testing.assert_array_equal(planned.violation, 0.0)
    assert planned.r_tilde.dtype == FLOAT
    bounds = scenario.plant.r_tilde_bounds
    assert bounds[0] - 1e-5 <= planned.r_tilde.min() <= planned.r_tilde.max() <= bounds[1] + 1e-5
    change = np.diff(traces.y, prepend=traces.y0[:, None], axis=1)
    assert np.abs(traces.y).max() <= (scenario.plant.output_limit or np.inf) + 1e-3
    assert np.abs(change).max() <= (scenario.plant.rate_limit or np.inf) + 1e-3


def test_sensor_noise_does_not_touch_the_plan():
    planned = plan(scenarios.get("pitch/noise", 3))
    np.testing.assert_array_equal(planned.r_tilde, planned.r_tilde[:1].repeat(3, axis=0))


def test_output_limit_that_binds_is_kept():
    limited = replace(lag.LAG, output_limit=0.5)
    scenario = lag_scenario(limited)
    planned = plan(scenario)
    traces = replayed(scenario, planned)
    assert np.abs(traces.y).max() == pytest.approx(0.5, abs=1e-5)
    np.testing.assert_allclose(mae(traces), planned.mae, rtol=1e-4)
    np.testing.assert_array_equal(planned.violation, 0.0)


def test_limit_that_cannot_be_kept_is_left_by_as_little_as_possible():
    """Y(0) = 1 decays while the dead time lasts, by more than the rate limit; then r~ = 2 holds it."""
    limited = replace(lag.LAG, rate_limit=0.1, init=lambda key, p: lag.init(key, p)._replace(y=jnp.ones(())))
    planned = plan(lag_scenario(limited))
    np.testing.assert_allclose(planned.violation, 1 - np.exp(-lag.CONTROL_STEP / T) - 0.1, atol=1e-5)
    assert np.isfinite(planned.mae).all()


def test_plant_that_is_not_affine_is_refused():
    def cubic(params, state, r_tilde, key):
        return lag.step(params, state, r_tilde**3, key)

    with pytest.raises(ValueError, match="'lag' is not affine in r~"):
        plan(lag_scenario(replace(lag.LAG, step=cubic)))


@makes_nan
def test_output_that_is_not_finite_has_no_bound():
    scenario = lag_scenario()
    scenario = replace(scenario, params=scenario.params.replace(K=scenario.params.K.at[1].set(jnp.nan)))
    planned = plan(scenario)
    np.testing.assert_array_equal(np.isfinite(planned.mae), [True, False, True])
    assert np.isfinite(planned.r_tilde).all()
