"""The environment of gymnax 0.0: one `done`, scaled action and reward, otherwise the functional environment."""

from __future__ import annotations

from copy import deepcopy

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxouter
from jaxouter import plants
from jaxouter.runtime import gymnax
from tests import lag

KEY = jax.random.key(0)


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(plants.REGISTRY, "lag", lag.make)


def test_a_step_is_that_of_the_functional_environment() -> None:
    env, params = gymnax.make("lag", reward_scale=0.1, max_delay=1.0, K=0.7)
    functional, functional_params = jaxouter.make("lag", max_delay=1.0, K=0.7)
    assert env.functional == functional
    chex.assert_trees_all_equal(jax.tree.leaves(params), jax.tree.leaves(functional_params))
    start = jax.jit(env.reset)(KEY, params)
    chex.assert_trees_all_equal(start, jax.jit(functional.reset)(KEY, functional_params))
    for shape in ((), (1,)):
        obs, state, reward, done, info = jax.jit(env.step)(KEY, start[1], jnp.full(shape, 0.25), params)
        expected = jax.jit(functional.step)(KEY, start[1], jnp.asarray(1.0), functional_params)
        chex.assert_trees_all_close((obs, state.y, reward), (expected[0], expected[1].y, 0.1 * expected[2]), rtol=1e-6)
        chex.assert_trees_all_close({name: info[name] for name in expected[5]}, expected[5], rtol=1e-6)
        assert (bool(done), bool(info["terminated"]), bool(info["truncated"])) == (False, False, False)
        chex.assert_shape([reward, done], ())


@pytest.mark.parametrize("ending", ["terminated", "truncated"])
def test_done_is_either_end(ending: str) -> None:
    env, params = gymnax.make("lag", max_delay=1.0)
    _, state = jax.jit(env.reset)(KEY, params)
    if ending == "terminated":
        state = state._replace(plant=state.plant._replace(y=jnp.full_like(state.y, 1000.0)))
    else:
        state = state._replace(k=jnp.full_like(state.k, params.max_steps_in_episode - 1))
    *_, done, info = jax.jit(env.step)(KEY, state, jnp.zeros(1), params)
    assert bool(done)
    assert [name for name in ("terminated", "truncated") if bool(info[name])] == [ending]


def test_spaces_name_and_length_of_an_episode() -> None:
    env, params = gymnax.make("pitch")
    space = env.action_space(params)
    assert (space.low, space.high, space.shape) == (-1.0, 1.0, (1,))
    assert env.observation_space(params).shape == (33,)
    assert (env.name, env.num_actions, params.max_steps_in_episode) == ("pitch", 1, 200)
    chex.assert_trees_all_equal(env.default_params, params)


def test_it_is_static_and_may_be_copied() -> None:
    (one, _), (other, params) = gymnax.make("pitch"), gymnax.make("pitch", tau=0.3)
    assert one == other == deepcopy(other)  # rejax copies its configuration
    assert hash(one) == hash(other)
    assert float(deepcopy(other).default_params.plant.tau) == float(params.plant.tau) == pytest.approx(0.3)


def test_a_learner_in_the_form_of_purejaxrl_runs_on_it() -> None:
    env, params = gymnax.make("lag", reward_scale=0.1, max_delay=1.0)
    n, steps = 4, 60

    @jax.jit
    def train(key):
        obs, state = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(key, n), params)

        def step(carry, key):
            obs, state = carry
            action = jax.vmap(env.action_space(params).sample)(jax.random.split(key, n))
            after, state, reward, done, _ = jax.vmap(env.step, in_axes=(0, 0, 0, None))(
                jax.random.split(key, n), state, action, params
            )
            return (after, state), (obs, reward, done)

        return jax.lax.scan(step, (obs, state), jax.random.split(key, steps))[1]

    obs, reward, done = train(KEY)
    chex.assert_shape(obs, (steps, n, 13))
    chex.assert_tree_all_finite((obs, reward))
    assert float(reward.max()) < 0.0
    np.testing.assert_array_equal(np.flatnonzero(done.all(axis=1)), [49])
