from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.evaluation import scenarios
from jaxouter.evaluation.rollout import rollout
from jaxouter.loop.policy import none


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


@pytest.mark.parametrize("identifier", ["pitch/noise", "heaters/load"])
def test_host_policy_meets_the_same_episodes(identifier):
    scenario = scenarios.get(identifier, 2)
    jitted, host = (rollout(Integrator(host), np.float32(0.02), scenario) for host in (False, True))
    for name in ("y0", "y", "r_tilde", "reward"):
        np.testing.assert_allclose(getattr(host, name), getattr(jitted, name), rtol=1e-4, atol=1e-3)


def test_random_policy_gets_another_key_at_each_step_and_the_same_on_the_host():
    scenario = scenarios.get("pitch/paper", 2)
    jitted, host = (rollout(Random(host), None, scenario) for host in (False, True))
    assert len(np.unique(jitted.r_tilde)) == jitted.r_tilde.size
    np.testing.assert_allclose(host.r_tilde, jitted.r_tilde, rtol=1e-6)


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
