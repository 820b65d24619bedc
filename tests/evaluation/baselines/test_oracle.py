"""The oracle on the lag, in small."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter import plants
from jaxouter.agents.whitening import Whitening
from jaxouter.evaluation.baselines import mpc, oracle, pi
from jaxouter.evaluation.baselines.tuning import training_episodes
from jaxouter.evaluation.metrics import mae
from jaxouter.evaluation.rollout import rollout as rollout_of
from jaxouter.identification import linear_models, records, steady_state
from jaxouter.loop.policy import Linear
from jaxouter.training.config import preset
from jaxouter.training.policy import LearnedParams
from tests import lag

KEY = jax.random.key(0)
SMALL = {"SEEDS": 1, "BATCH": 16, "FIRST_STAGE": 100, "STAGES": 2, "VALIDATION": 64}


@pytest.fixture(scope="module", autouse=True)
def small():
    """Fewer seeds, episodes and gradient steps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(plants.REGISTRY, "lag", lag.make)
        for name, value in SMALL.items():
            patch.setattr(oracle, name, value)
        yield


@pytest.fixture(scope="module")
def tuned():
    return oracle.tune(*lag.make(), KEY, 0, lambda text, share: None)


@pytest.fixture(scope="module")
def rollout():
    return oracle.differentiable(preset("lag"))[0]


@pytest.fixture(scope="module")
def base():
    return steady_state.static(*lag.make(), KEY)[1]


@pytest.fixture(scope="module")
def white(rollout, base):
    return rollout.whitening(base, lag.make()[1], KEY)


def error(policy, params, episodes) -> float:
    return mae(rollout_of(policy, params, episodes))


@pytest.mark.slow
def test_it_follows_better_than_the_exact_law_that_it_corrects_and_than_pi_and_mpc(tuned):
    """On training episodes that none of them has seen."""
    plant, params = lag.make()
    episodes = training_episodes(plant, params, jax.random.key(1))
    policy, learned = oracle.build(plant, tuned)
    reached = error(policy, learned, episodes)
    assert reached < error(Linear(plant.r_tilde_bounds), learned.base, episodes)
    pi_tuned = pi.tune(plant, params, KEY, 20_000, lambda text, share: None)
    assert reached < error(*pi.build(plant, pi_tuned), episodes)
    exact = mpc.innovations_form(linear_models.fit_arx(records.record(plant, params, KEY, 4), 2, 2))
    for move_weight in (1e-4, 1e-3, 1e-2):
        controller = mpc.controller(plant, exact, 0.0, mpc.MPCSettings(10, move_weight, 1e-3, 0.0, 1e-3))
        assert reached < 1.02 * error(controller, (), episodes)


@pytest.mark.slow
def test_steps_and_stages_are_counted(tuned):
    assert tuned.settings["gradient_steps"] == 200
    assert tuned.steps == (200 * 16 + steady_state.LEVELS) * 50
    first, second = (max(values) for values in tuned.settings["returns"])
    assert second > first


@pytest.mark.slow
def test_built_policy_is_the_one_that_was_chosen(tuned):
    """Its cost on the validation episodes is the one written down."""
    policy, params = oracle.build(lag.LAG, tuned)
    rollout = replace(oracle.differentiable(preset("lag"))[0], policy=policy)
    key = jax.random.split(jax.random.split(KEY)[1], 4)[3]
    one = jax.tree.map(lambda leaf: leaf[None], params.actor)
    value = oracle.returns(rollout, one, params.base, lag.make()[1], key)
    assert float(value[0]) == pytest.approx(max(map(max, tuned.settings["returns"])), abs=1e-3)


def test_folded_acts_like_the_network_on_whitened_observations(rollout):
    size, rng = rollout.policy.observer.size, np.random.default_rng(0)
    white = Whitening(*(jnp.asarray(rng.normal(size=shape), float) for shape in ((size,), (size, size))))
    actor = rollout.policy.init_actor(KEY)
    actor["params"]["Dense_2"]["kernel"] = 30.0 * actor["params"]["Dense_2"]["kernel"]  # not too small to see
    obs = jnp.asarray(rng.normal(size=(20, size)), float)
    act = jax.vmap(rollout.policy.action, (None, 0))
    found, expected = act(white.folded(actor), obs), act(actor, (obs - white.mean[None]) @ white.matrix)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    assert np.ptp(expected) > 0.1


def test_whitened_observations_have_nearly_unit_covariance(rollout, base, white):
    """On other episodes than those it was made from; directions that hardly vary are left small, not blown up."""
    zero = jax.tree.map(jnp.zeros_like, rollout.policy.init_actor(KEY))

    def observed(key):
        seen = rollout.episodes.run(rollout.policy, LearnedParams(zero, base), lag.make()[1], key)
        observe = jax.vmap(lambda memory, r, y: rollout.policy.observer.observe(memory, r, y)[1])
        return observe(seen.memory, seen.r, seen.y_seen)

    obs = jax.jit(jax.vmap(observed))(jax.random.split(KEY, oracle.BATCH)).reshape(-1, rollout.policy.observer.size)
    whitened = np.asarray((obs - white.mean[None]) @ white.matrix, float)
    np.testing.assert_allclose(whitened.mean(0), 0.0, atol=1e-2)
    variances = np.linalg.eigvalsh(np.cov(whitened.T))
    assert variances.max() == pytest.approx(1.0, abs=0.02)
    assert np.count_nonzero(variances > 0.9) > rollout.policy.observer.size // 2
    assert variances.min() >= 0.0
