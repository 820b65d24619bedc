"""The PI baseline: its law by hand, its tuning on the lag."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter import plants
from jaxouter.evaluation import scenarios
from jaxouter.evaluation.baselines import pi
from jaxouter.evaluation.baselines.pi import PI, PIParams
from jaxouter.evaluation.baselines.tuning import score, training_episodes
from jaxouter.evaluation.rollout import rollout
from jaxouter.identification import steady_state
from jaxouter.loop.policy import affine, none
from tests import kinds, lag
from tests.precision import of_single_draws

KEY = jax.random.key(0)
BUDGET = 25_600


@pytest.fixture(scope="module")
def steps():
    """Set-points from rest, on the lag whose K is 10 % higher than where the baselines were tuned."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(plants.REGISTRY, "lag", lag.make)
        scenario = scenarios.get("lag/steps", 16)
    return replace(scenario, params=scenario.params.replace(K=1.1 * scenario.params.K))


@pytest.fixture(scope="module")
def tuned():
    return pi.tune(*lag.make(), KEY, BUDGET, lambda text, share: None)


def number(value):
    return jnp.asarray(value, float)


def run(policy, params, e):
    """r~ and integral for r = e, y = 0."""
    carry, out = policy.init(params, number(e[0]), number(0.0)), []
    for r in e:
        carry, r_tilde = policy.act(params, carry, number(r), number(0.0))
        out.append((float(r_tilde), float(carry)))
    return np.array(out).T


def test_law_by_hand():
    policy = PI((-4.0, 4.0), 0.1)
    params = PIParams(affine(2.0, 0.5), number(3.0), number(10.0))
    r_tilde, integral = run(policy, params, [0.1, -0.2, 0.3])
    np.testing.assert_allclose(integral, [0.01, -0.01, 0.02], atol=1e-6)
    # 0.5 + 2 r + 3 e + 10 integral
    np.testing.assert_allclose(
        r_tilde, [0.5 + 0.2 + 0.3 + 0.1, 0.5 - 0.4 - 0.6 - 0.1, 0.5 + 0.6 + 0.9 + 0.2], atol=1e-6
    )


@pytest.mark.parametrize("ki", [10.0, -10.0])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_integral_stands_still_only_where_it_would_drive_further_beyond_a_bound(side, ki):
    """The prefilter alone is beyond the bound, e has the sign that leads further out or back in."""
    policy = PI((-1.0, 1.0), 0.1)
    params = PIParams(affine(0.0, 2.0 * side), number(0.0), number(ki))
    outwards = side * np.sign(ki)
    r_tilde, integral = run(policy, params, outwards * np.array([0.3, 0.2, -0.5, -0.5, -0.5]))
    np.testing.assert_allclose(integral, outwards * np.array([0.0, 0.0, -0.05, -0.1, -0.15]), atol=1e-6)
    np.testing.assert_allclose(r_tilde, side * np.array([1.0, 1.0, 1.0, 1.0, 0.5]), atol=1e-6)


@of_single_draws
def test_tuned_beats_the_static_prefilter_and_twice_the_budget_is_worth_little(tuned):
    plant, params = lag.make()
    twice = pi.tune(plant, params, KEY, 2 * BUDGET, lambda text, share: None)
    episodes = training_episodes(plant, params, jax.random.split(KEY)[1])
    once = score(*pi.build(plant, tuned), episodes)
    assert once > 0.92 * score(*steady_state.static(plant, params, KEY), episodes)
    assert score(*pi.build(plant, twice), episodes) == pytest.approx(once, rel=0.01)
    assert tuned.steps <= BUDGET
    assert twice.steps <= 2 * BUDGET


def test_it_finds_the_reciprocal_of_the_gain_for_its_prefilter(tuned):
    assert tuned.settings["slope"] == pytest.approx(2.0, rel=1e-5)
    assert tuned.settings["offset"] == pytest.approx(0.0, abs=1e-5)
    assert tuned.settings["kp"] > 0
    assert tuned.settings["ki"] > 0


@pytest.mark.parametrize("plant", [kinds.Integrating, kinds.Slow])
def test_where_y_does_not_settle_it_acts_from_where_y_stays(plant):
    made = plant()
    found = pi.tune(*made, KEY, 40_000, lambda text, share: None)
    assert found.settings["slope"] == 0.0
    episodes = training_episodes(*made, jax.random.split(KEY)[1])
    assert score(*pi.build(made[0], found), episodes) > 0.7 * score(*none(made[0]), episodes)  # both negative


def test_it_leaves_no_steady_state_error_where_the_static_prefilter_does(steps):
    plant, params = lag.make()
    _, base = steady_state.static(plant, params, KEY)
    integrating = PI(plant.r_tilde_bounds, plant.control_step), PIParams(base, number(0.5), number(2.0))
    found, static = (rollout(*baseline, steps) for baseline in (integrating, steady_state.static(plant, params, KEY)))
    np.testing.assert_allclose(found.y[:, -1], found.r[:, -1], atol=1e-3)
    np.testing.assert_allclose(static.y[:, -1], 1.1 * static.r[:, -1], atol=1e-4)


def test_bounds_of_r_tilde_are_kept(steps, tuned):
    plant, _ = lag.make()
    policy, params = pi.build(plant, tuned)
    low, high = plant.r_tilde_bounds
    r_tilde = rollout(policy, params._replace(kp=number(50.0)), steps).r_tilde
    assert low == r_tilde.min() < r_tilde.max() == high
