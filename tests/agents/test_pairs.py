"""Learning from pairs, on gains that are known."""

from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.agents.networks import Actor, act
from jaxouter.agents.pairs import Pairs, PairsConfig, PairsLearner

CONFIG = PairsConfig(rounds=3, states=512, kept=2, updates=200, batch_size=128, saturation_penalty=0.0)
HIDDEN = (16, 16)


def gains(obs: jax.Array, action: jax.Array, change: jax.Array) -> jax.Array:
    """Of a return -(a - 0.5 obs_0)^2, which is greatest at an action of half the observation's first number."""
    best = 0.5 * obs[:, 0]
    return (action - best) ** 2 - (action + change - best) ** 2


def pairs(actor: object, seed: int) -> Pairs:
    key_obs, key_change = jax.random.split(jax.random.key(seed))
    obs = jax.random.uniform(key_obs, (CONFIG.states, 2), minval=-1.0)
    change = jax.random.uniform(key_change, (CONFIG.states,), minval=-0.3, maxval=0.3)
    action = act(HIDDEN, actor, obs)[:, 0]
    return Pairs(obs, action, change, gains(obs, action, change))


def test_the_actor_moves_to_the_action_that_gains_most():
    learner = PairsLearner(CONFIG, HIDDEN, 2)
    actor = Actor(HIDDEN, 1).init(jax.random.key(0), jnp.zeros(2))
    state, learn = learner.init(jax.random.key(1), actor), jax.jit(learner.learn)
    obs = jax.random.uniform(jax.random.key(9), (100, 2), minval=-1.0)

    def wrong() -> float:
        return float(jnp.abs(act(HIDDEN, actor, obs)[:, 0] - 0.5 * obs[:, 0]).mean())

    before = wrong()
    for i in range(6):
        state, actor, metrics = learn(learner.add(state, pairs(actor, i)), actor, jax.random.key(i))
    assert wrong() < 0.3 * before
    assert float(metrics["pairs_loss"]) < 0.2  # of a variance of the gains of about 1
    assert int(state.rounds) == 6


def test_only_the_newest_rounds_are_kept():
    learner = PairsLearner(CONFIG, HIDDEN, 2)
    actor = Actor(HIDDEN, 1).init(jax.random.key(0), jnp.zeros(2))
    state, each = learner.init(jax.random.key(1), actor), [pairs(actor, i) for i in range(3)]
    for one in each:
        state = learner.add(state, one)
    newest = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), each[2], each[1])
    chex.assert_trees_all_equal(state.pairs, newest)
    np.testing.assert_allclose(state.scale, np.std(each[0].gain), rtol=1e-5)


@pytest.mark.parametrize("wrong", [{"rounds": -1}, {"states": 0}, {"change": 0.0}, {"noise_sigma": (0.2, 0.1)}])
def test_wrong_settings_are_named(wrong):
    ((name, value),) = wrong.items()
    with pytest.raises(ValueError, match=rf"pairs\.{name} is \(?{str(value).strip('()')}"):
        replace(CONFIG, **wrong).check()
