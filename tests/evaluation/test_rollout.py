from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.evaluation import scenarios
from jaxouter.evaluation.metrics import figures_of_merit
from jaxouter.evaluation.rollout import rollout
from jaxouter.loop import sensor
from jaxouter.loop.policy import none
from tests.precision import FLOAT


@dataclass(frozen=True)
class Integrator:
    """r~ = r + sum of errors times the gain; in JAX, or in plain Python where `host`."""

    host: bool = False

    def init(self, params, r0, y0):
        return 0.0 * r0 + 0.0 * y0

    def act(self, params, carry, r, y, key=None):
        carry = carry + params * (r - y)
        return carry, r + carry


@dataclass(frozen=True)
class Random:
    """r~ normal with the key it is given."""

    host: bool = False

    def init(self, params, r0, y0):
        return ()

    def act(self, params, carry, r, y, key=None):
        return carry, jax.random.normal(key)


@dataclass(frozen=True)
class HostRandom:
    """r~ normal from a generator of its own; its params are the seed."""

    host: bool = True

    def init(self, params, r0, y0):
        return np.random.default_rng(params)

    def act(self, params, carry, r, y, key=None):
        assert key is None
        return carry, carry.normal()


@dataclass(frozen=True)
class Failing:
    """r~ = r until step `params`, where it fails; it must not be asked again."""

    error: type[Exception] | None
    host: bool = True

    def init(self, params, r0, y0):
        return 0

    def act(self, params, carry, r, y, key=None):
        assert carry <= params
        if carry == params:
            if self.error is not None:
                raise self.error("cannot")
            return carry + 1, np.nan
        return carry + 1, r


@pytest.mark.parametrize("identifier", ["pitch/noise", "heaters/load"])
def test_a_policy_on_the_host_runs_on_the_same_episodes(identifier):
    scenario = scenarios.get(identifier, 2)
    jitted, host = (rollout(Integrator(host), FLOAT.type(0.02), scenario) for host in (False, True))
    for name in ("y0", "y", "r_tilde", "reward"):
        np.testing.assert_allclose(getattr(host, name), getattr(jitted, name), rtol=1e-4, atol=1e-3)


def test_random_policy_gets_another_key_at_each_step():
    traces = rollout(Random(), None, scenarios.get("pitch/paper", 2))
    assert len(np.unique(traces.r_tilde)) == traces.r_tilde.size


@pytest.mark.parametrize("host", [False, True])
def test_parameters_may_differ_from_episode_to_episode(host):
    scenario = scenarios.get("pitch/noise", 3)
    gains = np.array([0.0, 0.01, 0.02], FLOAT)
    traces = rollout(Integrator(host), gains, scenario, per_episode=True)
    for i, gain in enumerate(gains):
        alone = rollout(Integrator(), gain, scenario)
        np.testing.assert_allclose(traces.y[i], alone.y[i], rtol=1e-4, atol=1e-3)


def test_host_policy_draws_from_its_own_generator():
    scenario = scenarios.get("pitch/paper", 2)
    traces = rollout(HostRandom(), np.array([1, 2]), scenario, per_episode=True)
    expected = [np.random.default_rng(seed).normal(size=200) for seed in (1, 2)]
    np.testing.assert_allclose(traces.r_tilde, expected, rtol=1e-6)


@pytest.mark.parametrize("error", [None, ZeroDivisionError, np.linalg.LinAlgError])
@pytest.mark.parametrize("step", [5, 199])
def test_host_policy_that_fails_has_diverged(error, step):
    scenario = scenarios.get("pitch/paper", 2)
    traces = rollout(Failing(error), np.array([step, 1000]), scenario, per_episode=True)
    assert np.isfinite(traces.y[0, :step]).all()
    assert np.isnan(traces.y[0, step:]).all()
    assert np.isfinite(traces.y[1]).all()
    assert figures_of_merit(traces, scenario).diverged


def test_mistake_of_a_host_policy_is_not_hidden():
    with pytest.raises(KeyError, match="cannot"):
        rollout(Failing(KeyError), 3, scenarios.get("pitch/paper"))


def test_sensor_may_differ_from_episode_to_episode():
    scenario = scenarios.get("pitch/noise", 2)
    mixed = replace(scenario, sensor=scenario.sensor.replace(noise=jnp.array([0.0, 0.2])))
    clean = replace(scenario, sensor=sensor.params())
    a, noisy, calm = (rollout(Integrator(), FLOAT.type(0.02), s).y for s in (mixed, scenario, clean))
    np.testing.assert_allclose(a, [calm[0], noisy[1]], rtol=1e-5, atol=1e-5)
    assert np.abs(calm[1] - noisy[1]).max() > 1e-3


def test_r_tilde_is_held_to_its_bounds_whatever_the_policy_says():
    scenario = scenarios.get("heaters/paper-4", 1)
    traces = rollout(Integrator(), jnp.array(5.0), scenario)
    assert traces.r_tilde.max() == 40.0


def test_output_is_the_one_after_each_step():
    scenario = scenarios.get("pitch/paper")
    traces = rollout(*none(scenario.plant), scenario)
    assert traces.y0[0] == 0.0
    assert traces.y[0, 0] != 0.0
    assert traces.reward[0, 0] == pytest.approx(-0.3 * abs(traces.r[0, 0] - traces.y[0, 0]) - 0.1 * traces.r[0, 0])
