"""The learned inverse on the lag, where r~ moves y three steps later."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.evaluation.baselines import inverse
from jaxouter.evaluation.baselines.tuning import score, training_episodes
from jaxouter.identification.records import record
from jaxouter.loop.observation import Memory
from jaxouter.loop.policy import none
from tests import lag

KEY = jax.random.key(0)
BUDGET = 20_000


@pytest.fixture(scope="module")
def tuned():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inverse, "UPDATES", 1_000)
        patch.setattr(inverse, "BATCH", 64)
        return inverse.tune(*lag.make(), KEY, BUDGET, lambda text, share: None)


def test_horizon_is_that_of_the_first_effect_or_a_bit_more(tuned):
    assert tuned.settings["h"] in (3, 4, 6)
    assert tuned.steps <= BUDGET


def test_it_beats_the_inner_loop_alone(tuned):
    plant, params = lag.make()
    episodes = training_episodes(plant, params, jax.random.key(1))
    assert score(*inverse.build(plant, tuned), episodes) > 0.55 * score(*none(plant), episodes)


def test_asked_for_what_came_it_gives_what_was_applied(tuned):
    plant, params = lag.make()
    policy, network = inverse.build(plant, tuned)
    data = record(plant, params, jax.random.key(2), 4)
    r_tilde, y = (jnp.asarray(part, float) for part in data)
    H, h = policy.observer.history, tuned.settings["h"]

    def asked(r_tilde, y, t):
        back = t - jnp.arange(1, H + 1)
        memory = Memory(y[back], r_tilde[back], jnp.zeros(()))
        return policy.act(network, memory, y[t + h], y[t])[1]

    times = jnp.arange(H, plant.episode_steps - h + 1)
    given = jax.jit(jax.vmap(jax.vmap(asked, (None, None, 0)), (0, 0, None)))(r_tilde, y, times)
    error = np.sqrt(np.mean((given - r_tilde[:, times]) ** 2))
    assert error < 0.02 * (4.0 - -4.0)
    assert error < 0.1 * np.std(r_tilde)


def test_bounds_are_kept_and_nothing_is_integrated(tuned):
    policy, network = inverse.build(lag.LAG, tuned)
    memory = policy.init(network, jnp.ones(()), jnp.zeros(()))
    for r in (-30.0, 30.0):
        after, r_tilde = policy.act(network, memory, jnp.asarray(r), jnp.zeros(()))
        assert abs(float(r_tilde)) == 4.0
        assert float(after.r_tilde_past[0]) == float(r_tilde)
    # What the memory integrates must not reach the network, which never saw it.
    biased = memory._replace(integral=jnp.asarray(5.0))
    one, other = (policy.act(network, carry, jnp.ones(()), jnp.zeros(()))[1] for carry in (memory, biased))
    assert one == other
