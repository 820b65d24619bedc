"""What learners for gymnax read of an environment. scripts/test.sh --all compares with gymnax itself."""

from __future__ import annotations

from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxouter
from jaxouter import plants
from jaxouter.loop.environment import Environment, EnvParams
from jaxouter.loop.spaces import Box
from tests import lag
from tests.precision import FLOAT

try:
    from gymnax.environments.spaces import Box as Reference
except ImportError:

    class Reference:
        """As gymnax 1.0 documents it."""

        def __init__(self, low: Any, high: Any, shape: Any, dtype: Any = jnp.float32) -> None:
            self.low, self.high, self.shape, self.dtype = low, high, shape, dtype

        def sample(self, key: jax.Array) -> jax.Array:
            return jax.random.uniform(key, shape=self.shape, minval=self.low, maxval=self.high).astype(self.dtype)

        def contains(self, x: jax.Array) -> jax.Array:
            return jnp.logical_and(jnp.all(x >= self.low), jnp.all(x <= self.high))


KEY = jax.random.key(0)
EPISODE = 50  # steps of the lag
BOUNDS = {
    "numbers": (-2.0, 3.0, (4,)),
    "arrays": (jnp.array([-1.0, 0.0]), jnp.array([1.0, 5.0]), (2,)),
    "scalar": (0.0, 40.0, ()),
}


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(plants.REGISTRY, "lag", lag.make)


def make() -> tuple[Environment, EnvParams]:
    """The lag, whose line has one length in all tests."""
    return jaxouter.make("lag", max_delay=1.0)


@pytest.mark.parametrize("bounds", BOUNDS.values(), ids=BOUNDS)
def test_box_is_gymnaxs(bounds: tuple[Any, Any, tuple[int, ...]]) -> None:
    for arguments in (bounds, (*bounds, jnp.float16)):
        box, reference = Box(*arguments), Reference(*arguments)
        assert (box.shape, box.dtype) == (reference.shape, reference.dtype)
        chex.assert_trees_all_equal((box.low, box.high), (reference.low, reference.high))
        for key in jax.random.split(KEY, 3):
            drawn = box.sample(key)
            chex.assert_trees_all_equal_shapes_and_dtypes(drawn, reference.sample(key))
            chex.assert_trees_all_equal(drawn, reference.sample(key))
    low, high, shape = bounds
    box, reference = Box(*bounds), Reference(*bounds)
    ends = (jnp.broadcast_to(jnp.asarray(end, float), shape) for end in (low, high))
    for end, outward in zip(ends, (-1.0, 1.0), strict=True):
        for x in (end, end + 0.1 * outward, end - 0.1 * outward, end.at[...].set(jnp.nan)):
            assert bool(box.contains(x)) == bool(reference.contains(x))
        assert bool(box.contains(end))
        assert not bool(box.contains(end + 0.1 * outward))


def test_box_is_drawn_uniformly() -> None:
    drawn = np.asarray(jax.vmap(Box(0.0, 40.0, (1,)).sample)(jax.random.split(KEY, 4000)))
    assert drawn.shape == (4000, 1)
    assert (drawn.min() >= 0.0, drawn.max() <= 40.0) == (True, True)
    shares = np.histogram(drawn, 8, (0.0, 40.0))[0] / 4000
    np.testing.assert_allclose(shares, 1 / 8, atol=5 * np.sqrt(7 / 64 / 4000))


@pytest.mark.parametrize(("name", "size", "bounds"), [("pitch", 33, (-60.0, 60.0)), ("heaters", 13, (0.0, 40.0))])
def test_spaces_are_those_of_the_plant(name: str, size: int, bounds: tuple[float, float]) -> None:
    env, params = jaxouter.make(name)
    assert (env.name, env.num_actions) == (name, 1)
    action = env.action_space(params)
    assert (action.low, action.high, action.shape, action.dtype) == (*bounds, (1,), FLOAT)
    seen = env.observation_space(params)
    assert (seen.shape, seen.dtype) == ((size,), FLOAT)
    chex.assert_shape([seen.low, seen.high], (size,))
    chex.assert_trees_all_equal(env.default_params, params)


def test_bounds_of_observations_are_those_of_what_is_seen() -> None:
    space = jaxouter.make("heaters")[0].observation_space()
    # y is between -20 and 60 degrees, seen relative to 20 in units of 5: r, r - y, its integral, past y - y, past r~
    np.testing.assert_allclose(space.high, [8.0, 16.0, 16.0] + 5 * [16.0] + 5 * [1.0])
    np.testing.assert_allclose(space.low, [-8.0, -16.0, -16.0] + 5 * [-16.0] + 5 * [-1.0])


def test_default_params_are_those_that_came_with_it() -> None:
    (one, params), (other, _) = jaxouter.make("pitch", tau=0.3), jaxouter.make("pitch")
    assert one == other  # it shares what is compiled
    assert float(one.default_params.plant.tau) == float(params.plant.tau) == pytest.approx(0.3)
    assert float(other.default_params.plant.tau) == 0.5


def test_an_action_of_length_one_is_a_scalar_one() -> None:
    env, params = make()
    _, state = jax.jit(env.reset)(KEY, params)
    step = jax.jit(env.step_env)
    chex.assert_trees_all_equal(*(step(KEY, state, jnp.full(shape, 1.5), params) for shape in ((), (1,))))


def test_a_learner_in_the_form_of_purejaxrl_runs_on_it() -> None:
    """A compiled scan over vmapped steps, whose networks have the sizes of the spaces."""
    env, params = make()
    n, steps = 4, 70  # into the second episode
    size, length = env.observation_space(params).shape[0], env.action_space(params).shape[0]

    @jax.jit
    def train(key: jax.Array) -> tuple[Any, ...]:
        key, key_reset, key_weights = jax.random.split(key, 3)
        weights = 0.1 * jax.random.normal(key_weights, (size, length))
        obs, state = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(key_reset, n), params)

        def step(runner: tuple[Any, ...], _: None) -> tuple[tuple[Any, ...], Any]:
            obs, state, key = runner
            key, key_action, key_step = jax.random.split(key, 3)
            drawn = jax.vmap(env.action_space(params).sample)(jax.random.split(key_action, n))
            action = jnp.clip(obs @ weights + drawn, env.action_space(params).low, env.action_space(params).high)
            after, state, reward, terminated, truncated, info = jax.vmap(env.step, in_axes=(0, 0, 0, None))(
                jax.random.split(key_step, n), state, action, params
            )
            transition = (obs, action, reward, terminated, truncated, info["final_observation"])
            return (after, state, key), transition

        return jax.lax.scan(step, (obs, state, key), None, steps)[1]

    obs, action, reward, terminated, truncated, final = train(KEY)
    chex.assert_shape([obs, final], (steps, n, size))
    chex.assert_shape(action, (steps, n, length))
    chex.assert_shape([reward, terminated, truncated], (steps, n))
    chex.assert_tree_all_finite((obs, action, reward, final))
    space = env.observation_space(params)
    assert bool(jax.vmap(jax.vmap(space.contains))(obs).all())
    assert not bool(terminated.any())
    np.testing.assert_array_equal(np.flatnonzero(truncated.all(axis=1)), [EPISODE - 1])
    chex.assert_trees_all_equal(final[: EPISODE - 1], obs[1:EPISODE])
    assert float(jnp.abs(final[EPISODE - 1] - obs[EPISODE]).max()) > 0.01


def test_gymnaxs_own_wrapper_counts_what_it_does() -> None:
    purerl = pytest.importorskip("gymnax.wrappers.purerl")
    env, params = make()
    logged = purerl.LogWrapper(env)
    assert logged.default_params is params
    _, state = logged.reset(KEY, params)
    total = 0.0
    with jax.numpy_dtype_promotion("standard"):  # as it multiplies by `done`
        for key in jax.random.split(KEY, EPISODE):
            action = logged.action_space(params).sample(key)
            _, state, reward, _, truncated, info = logged.step(key, state, action, params)
            total += float(reward)
    assert bool(truncated)
    assert int(info["returned_episode_lengths"]) == EPISODE
    assert float(info["returned_episode_returns"]) == pytest.approx(total, rel=1e-4)
