"""The environment: timing, ends of episodes, what is rewarded and what is seen."""

from __future__ import annotations

import dataclasses
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxouter
from jaxouter import plants
from jaxouter.loop import rewards, sensor
from jaxouter.loop.environment import Environment, EnvParams, EnvState
from jaxouter.loop.observation import Signals
from jaxouter.loop.references import Reaimed, SetPoint
from tests import lag

KEY = jax.random.key(0)
reset = jax.jit(Environment.reset, static_argnums=0)
step = jax.jit(Environment.step, static_argnums=0)
step_env = jax.jit(Environment.step_env, static_argnums=0)


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(plants.REGISTRY, "lag", lag.make)


def scalar(value: float) -> jax.Array:
    return jnp.asarray(value, float)


def make(**overrides: Any) -> tuple[Environment, EnvParams]:
    """The lag, whose lines have one length in all tests."""
    return jaxouter.make("lag", max_delay=1.0, **overrides)


def with_plant(env: Environment, **changes: Any) -> Environment:
    return dataclasses.replace(env, plant=dataclasses.replace(env.plant, **changes))


def only_moves(params: EnvParams) -> EnvParams:
    """A reward of minus |r~_k - r~_(k-1)|."""
    reward = params.reward.replace(alpha_g=scalar(0.0), beta_h=scalar(1.0), rho_h=scalar(0.0))
    return params.replace(reward=reward)


@pytest.mark.parametrize(("name", "history"), [("pitch", 15), ("heaters", 5), ("lag", 5)])
def test_made_by_name_with_the_history_of_the_plant(name: str, history: int) -> None:
    env, params = jaxouter.make(name)
    assert env.plant.name == name
    assert env.observer.history == history
    assert env.goal == SetPoint(*env.plant.setpoint_range)
    assert params.reward == rewards.params(env.plant)
    assert params.sensor == sensor.params()


def test_made_with_another_history_integral_goal_and_plant() -> None:
    goal = Reaimed(-1.0, 1.0, 0.1)
    env, params = make(history=2, integral_steps=3, goal=goal, K=0.7)
    assert (env.observer.history, env.observer.integral_steps, env.goal) == (2, 3, goal)
    assert float(params.plant.K) == pytest.approx(0.7)


def test_it_is_static() -> None:
    (one, _), (other, _) = make(), make(K=0.9)
    assert one == other
    assert hash(one) == hash(other)


def test_reset_and_step_have_the_shapes_and_types_of_gymnax() -> None:
    env, params = make()
    obs, state = reset(env, KEY, params)
    chex.assert_shape(obs, (13,))
    after = step(env, KEY, state, scalar(1.0), params)
    assert len(after) == 6
    new_obs, new_state, reward, terminated, truncated, info = after
    chex.assert_trees_all_equal_shapes_and_dtypes((obs, state), (new_obs, new_state))
    chex.assert_shape([reward, terminated, truncated], ())
    chex.assert_type([obs, reward, info["final_observation"], info["r"], info["y"]], jnp.float32)
    chex.assert_type([terminated, truncated], jnp.bool_)
    chex.assert_equal_shape([obs, info["final_observation"]])


@pytest.mark.parametrize("name", ["pitch", "heaters"])
def test_plants_of_the_paper_keep_shapes_and_single_precision(name: str) -> None:
    env, params = jaxouter.make(name)
    before = jax.eval_shape(env.reset, KEY, params)
    obs, state, reward, *_ = jax.eval_shape(env.step, KEY, before[1], scalar(1.0), params)
    chex.assert_trees_all_equal_shapes_and_dtypes(before, (obs, state))
    assert (obs.dtype, reward.dtype) == (jnp.float32, jnp.float32)


def test_action_must_be_scalar() -> None:
    env, params = make()
    _, state = reset(env, KEY, params)
    with pytest.raises(AssertionError, match="rank"):
        step_env(env, KEY, state, jnp.zeros(1), params)


def test_resets_draw_start_and_set_point() -> None:
    env, params = make()
    _, states = jax.jit(jax.vmap(env.reset, (0, None)))(jax.random.split(KEY, 500), params)
    for values, bound in ((states.y, 0.5), (states.r, 1.0)):
        assert bound * 0.95 < float(jnp.abs(values).max()) <= bound
        assert float(values.min()) < 0.0 < float(values.max())
    assert abs(np.corrcoef(states.y, states.r)[0, 1]) < 5 / np.sqrt(500)


def episode(env: Environment, params: EnvParams, actions: jax.Array, key: jax.Array = KEY, resets: bool = False) -> Any:
    """Start, then all that the steps gave, stacked; one step function, scanned."""
    take = step if resets else step_env

    def advance(state: EnvState, inputs: tuple[jax.Array, jax.Array]) -> tuple[EnvState, Any]:
        out = take(env, inputs[0], state, inputs[1], params)
        return out[1], out

    first = reset(env, key, params)
    keys = jax.random.split(jax.random.fold_in(key, 1), len(actions))
    return first, jax.lax.scan(advance, first[1], (keys, actions))[1]


def test_episode_is_truncated_at_its_length_and_not_terminated() -> None:
    env, params = make()
    _, (_, _, _, terminated, truncated, _) = episode(env, params, jnp.ones(52))
    np.testing.assert_array_equal(truncated, np.arange(1, 53) >= env.plant.episode_steps)
    assert not bool(terminated.any())


def test_divergence_terminates_with_its_penalty() -> None:
    env, params = make(K=6.0, T=0.1, d=0.0)
    (_, start), (_, states, reward, terminated, truncated, _) = episode(env, params, jnp.full(4, 4.0))
    true_y = 24.0 + (float(start.y) - 24.0) * np.exp(-np.arange(1, 5))
    np.testing.assert_array_equal(terminated, true_y > 20.0)
    assert terminated.any()
    assert not terminated.all()
    assert not truncated.any()
    y = np.minimum(true_y, 20.0)
    np.testing.assert_allclose(states.y, y, rtol=1e-4)
    np.testing.assert_allclose(reward, -0.3 * np.abs(float(start.r) - y) - 50.0 * (true_y > 20.0), rtol=1e-4)


def test_output_at_the_bound_is_not_divergence() -> None:
    env, params = make()
    _, state = reset(env, KEY, params)
    for y, diverged in ((20.0, False), (20.001, True), (-20.0, False), (-20.001, True)):
        at = with_plant(env, output=lambda params, state, y=y: state.y * 0.0 + y)
        assert bool(at.step_env(KEY, state, scalar(0.0), params)[3]) == diverged


@pytest.mark.parametrize(("value", "counted_as"), [(np.nan, 20.0), (np.inf, 20.0), (-np.inf, -20.0)])
def test_output_that_is_not_finite_terminates_and_stays_inside(value: float, counted_as: float) -> None:
    env, params = make()
    _, state = reset(env, KEY, params)
    broken = with_plant(env, output=lambda params, state: state.y * 0.0 + value)
    obs, after, reward, terminated, truncated, info = broken.step_env(KEY, state, scalar(1.0), params)
    assert bool(terminated)
    assert not bool(truncated)
    chex.assert_tree_all_finite((obs, reward, info))
    assert float(after.y) == counted_as
    assert float(reward) == pytest.approx(-0.3 * abs(float(state.r) - counted_as) - 50.0)


def test_plant_that_breaks_is_replaced_by_a_new_episode() -> None:
    env, params = make()
    broken = with_plant(env, output=lambda params, state: jnp.where(state.k == 2, jnp.nan, state.y), start=lag.init)
    _, (obs, states, reward, terminated, _, info) = episode(broken, params, jnp.ones(8), resets=True)
    np.testing.assert_array_equal(terminated, [False, True] * 4)
    np.testing.assert_array_equal(states.k, [1, 0] * 4)
    chex.assert_tree_all_finite((obs, reward, info, states.y, states.memory))


def test_end_of_an_episode_gives_the_new_observation_and_keeps_the_last() -> None:
    env, params = make()
    _, state = reset(env, KEY, params)
    last = state._replace(k=jnp.asarray(env.plant.episode_steps - 1, jnp.int32))
    obs, new, reward, terminated, truncated, info = step(env, KEY, last, scalar(2.0), params)
    assert bool(truncated)
    assert not bool(terminated)
    final, ended, final_reward, *_ = step_env(env, KEY, last, scalar(2.0), params)
    chex.assert_trees_all_close(info["final_observation"], final, atol=1e-6)
    chex.assert_trees_all_close((info["r"], info["y"], reward), (ended.r, ended.y, final_reward), atol=1e-6)
    memory, first = env.observer.observe(env.observer.init(new.r, new.y), new.r, new.y)
    chex.assert_trees_all_close((obs, new.memory), (first, memory), atol=1e-6)
    assert int(new.k) == 0
    assert float(new.r) != float(ended.r)
    assert float(new.y) != float(ended.y)
    assert float(jnp.abs(obs - final).max()) > 0.01


def test_step_within_an_episode_is_the_raw_one() -> None:
    env, params = make()
    _, state = reset(env, KEY, params)
    obs, after, *rest = step(env, KEY, state, scalar(2.0), params)
    raw_obs, raw_after, *raw_rest = step_env(env, KEY, state, scalar(2.0), params)
    chex.assert_trees_all_close((obs, *rest), (raw_obs, *raw_rest), atol=1e-6)
    chex.assert_trees_all_close(obs, rest[-1]["final_observation"])
    assert int(after.k) == int(raw_after.k) == 1


def test_new_episodes_differ() -> None:
    env, params = make()
    _, (_, states, _, _, truncated, _) = episode(env, params, jnp.zeros(200), resets=True)
    np.testing.assert_array_equal(np.flatnonzero(truncated), [49, 99, 149, 199])
    begun = np.flatnonzero(np.asarray(states.k) == 0)
    assert len(np.unique(states.r[begun])) == len(begun) == 4
    assert len(np.unique(states.y[begun])) == 4


def test_error_is_of_the_reference_before_and_the_output_after_the_step() -> None:
    env, params = make(goal=SetPoint(-1.0, 1.0, redraw=1.0))
    (_, start), (_, states, reward, *_) = episode(env, params, jnp.linspace(-2.0, 2.0, 10))
    r = np.concatenate([[start.r], states.r[:-1]])
    np.testing.assert_allclose(reward, -0.3 * np.abs(r - np.asarray(states.y)), rtol=1e-5)
    assert np.abs(np.diff(r)).min() > 0


def test_moves_of_the_modified_reference_are_charged_with_the_first_from_the_start() -> None:
    env, params = make()
    actions = jnp.array([1.0, -2.0, -2.0, 0.5])
    (_, start), (_, _, reward, *_) = episode(env, only_moves(params), actions)
    np.testing.assert_allclose(reward, [-abs(1.0 - float(start.y)), -3.0, 0.0, -2.5], rtol=1e-5)
    assert float(start.y) != 0.0


def test_first_move_is_from_the_start_clipped_to_the_bounds() -> None:
    env, params = make()
    narrow = with_plant(env, r_tilde_bounds=(-0.001, 0.001))
    narrow = dataclasses.replace(narrow, observer=dataclasses.replace(env.observer, r_tilde_bounds=(-0.001, 0.001)))
    _, state = reset(narrow, KEY, params)
    assert abs(float(state.y)) > 0.001
    edge = 0.001 * np.sign(float(state.y))
    reward = step_env(narrow, KEY, state, scalar(-edge), only_moves(params))[2]
    assert float(reward) == pytest.approx(-0.002, rel=1e-4)


def test_moves_of_the_output_are_charged_with_the_first() -> None:
    env, params = make()
    zero = scalar(0.0)
    params = params.replace(reward=params.reward.replace(alpha_g=zero, beta_b=scalar(1.0), rho_b=zero))
    (_, start), (_, states, reward, *_) = episode(env, params, jnp.linspace(-2.0, 2.0, 6))
    moves = np.abs(np.diff(np.concatenate([[start.y], states.y])))
    np.testing.assert_allclose(reward, -moves, atol=1e-6)
    assert moves.min() > 0.0


@pytest.mark.parametrize(("action", "applied"), [(100.0, 4.0), (-7.0, -4.0), (3.5, 3.5)])
def test_action_is_clipped_to_the_bounds(action: float, applied: float) -> None:
    env, params = make(d=0.0)
    _, state = reset(env, KEY, params)
    out = step_env(env, KEY, state, scalar(action), only_moves(params))
    chex.assert_trees_all_equal(out, step_env(env, KEY, state, scalar(applied), only_moves(params)))
    assert float(out[1].memory.r_tilde_past[0]) == applied
    assert float(out[2]) == pytest.approx(-abs(applied - float(state.y)), rel=1e-5)


def test_sensor_changes_what_is_seen_and_not_what_is_rewarded() -> None:
    env, params = make()
    noisy = params.replace(sensor=sensor.params(noise=0.3, bias=1.0))
    actions = jnp.linspace(-2.0, 2.0, 20)
    (_, clean_start), (clean_obs, clean, clean_reward, *_) = episode(env, params, actions)
    (_, start), (obs, states, reward, _, _, info) = episode(env, noisy, actions)
    chex.assert_trees_all_equal((reward, states.y, start.y), (clean_reward, clean.y, clean_start.y))
    error = np.asarray(states.y_seen - states.y)
    assert error.mean() == pytest.approx(1.0, abs=5 * 0.3 / np.sqrt(20))
    assert error.std() > 0.1
    assert float(jnp.abs(obs - clean_obs).max()) > 0.5
    chex.assert_trees_all_equal(info["y"], states.y_seen)
    chex.assert_trees_all_close(obs[:, 1], (states.r - states.y_seen) / env.observer.y_scale, atol=1e-6)
    chex.assert_trees_all_equal(states.memory.y_past[1:, 0], states.y_seen[:-1])


def test_lost_samples_leave_the_last_one_seen() -> None:
    env, params = make()
    lost = params.replace(sensor=sensor.params(missing=1.0))
    (_, start), (_, states, *_) = episode(env, lost, jnp.ones(10))
    chex.assert_trees_all_equal(states.y_seen, jnp.broadcast_to(start.y, (10,)))
    assert float(jnp.ptp(states.y)) > 0.1


def test_goal_aims_by_what_is_seen() -> None:
    env, params = make(goal=Reaimed(-1.0, 1.0, tolerance=0.5))
    biased = params.replace(sensor=sensor.params(bias=0.6))
    (_, start), (_, states, *_) = episode(env, biased, jnp.zeros(40))
    r = np.concatenate([[start.r], states.r])
    near = np.abs(r[:-1] - np.asarray(states.y_seen)) < 0.5
    np.testing.assert_array_equal(np.diff(r) != 0, near)
    assert near.any()
    assert (near != (np.abs(r[:-1] - np.asarray(states.y)) < 0.5)).any()


def test_plant_that_draws_has_other_parameters_in_each_episode() -> None:
    env, params = make(randomise=True)
    _, (_, states, *_) = episode(env, params, jnp.zeros(150), resets=True)
    K = np.asarray(states.plant_params.K)
    assert [len(np.unique(K[part])) for part in (slice(0, 49), slice(49, 99), slice(99, 149))] == [1, 1, 1]
    assert len(np.unique(K)) == 4
    assert (np.abs(K / 0.5 - 1.0) <= 0.1 + 1e-6).all()


def test_drawn_parameters_are_those_of_the_plant() -> None:
    env, params = make(randomise=True, d=0.0, T=0.05)
    _, (_, states, *_) = episode(env, params, jnp.full(40, 2.0))
    np.testing.assert_allclose(states.y[-1], 2.0 * states.plant_params.K[-1], rtol=1e-4)
    assert abs(float(states.plant_params.K[-1]) - 0.5) > 1e-4


def test_plant_that_draws_nothing_carries_no_parameters() -> None:
    env, params = make()
    assert reset(env, KEY, params)[1].plant_params is None


def test_lanes_under_vmap_equal_single_environments() -> None:
    env, params = make(randomise=True)
    keys = jax.random.split(KEY, 4)
    actions = jnp.array([1.0, -1.0, 3.0, 9.0])
    _, states = jax.jit(jax.vmap(env.reset, (0, None)))(keys, params)
    states = states._replace(k=jnp.array([0, 10, 49, 60], jnp.int32))  # some end
    lanes = jax.jit(jax.vmap(env.step, (0, 0, 0, None)))(keys, states, actions, params)
    for i, key in enumerate(keys):
        _, state = reset(env, key, params)
        alone = step(env, key, state._replace(k=states.k[i]), actions[i], params)
        lane = jax.tree.map(lambda leaf, i=i: leaf[i], lanes)
        chex.assert_trees_all_close(comparable(lane), comparable(alone), atol=1e-5)


def comparable(tree: Any) -> Any:
    """Keys as numbers."""
    is_key = lambda leaf: jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)  # noqa: E731
    return jax.tree.map(lambda leaf: jax.random.key_data(leaf) if is_key(leaf) else leaf, tree)


def test_scan_equals_a_loop() -> None:
    env, params = make()
    actions = jnp.linspace(-3.0, 3.0, 60)
    first, scanned = episode(env, params, actions, resets=True)
    state, keys = first[1], jax.random.split(jax.random.fold_in(KEY, 1), 60)
    for i in range(60):
        out = step(env, keys[i], state, actions[i], params)
        state = out[1]
        expected = jax.tree.map(lambda leaf, i=i: leaf[i], scanned)
        chex.assert_trees_all_close(comparable(out), comparable(expected), atol=1e-5)


def test_a_few_steps_are_the_same_without_jit() -> None:
    env, params = make()
    _, state = reset(env, KEY, params)
    compiled = plain = state._replace(k=jnp.asarray(env.plant.episode_steps - 2, jnp.int32))  # the second step resets
    for action in (1.0, -9.0, 2.0):
        out = step(env, KEY, compiled, scalar(action), params)
        with jax.disable_jit():
            without = env.step(KEY, plain, scalar(action), params)
        chex.assert_trees_all_close(comparable(out), comparable(without), atol=1e-5)
        compiled, plain = out[1], without[1]


def test_every_parameter_is_traced() -> None:
    env, params = make()
    _, state = reset(env, KEY, params)
    take = jax.jit(chex.assert_max_traces(env.step_env, n=1))
    other = params.replace(
        plant=params.plant.replace(K=scalar(0.8), d=scalar(0.0)),
        sensor=sensor.params(bias=1.0),
        reward=rewards.params(env.plant, divergence=-3.0).replace(alpha_g=scalar(1.0)),
    )
    one, two = (take(KEY, state, scalar(3.0), p) for p in (params, other))
    assert float(one[1].y) != float(two[1].y)
    assert float(two[2]) == pytest.approx(-abs(float(state.r) - float(two[1].y)), rel=1e-5)


def test_windows_of_recorded_signals_give_back_the_observations() -> None:
    env, params = make(goal=SetPoint(-1.0, 1.0, redraw=0.2))
    noisy = params.replace(sensor=sensor.params(noise=0.1))
    actions = 3.0 * jnp.sin(jnp.arange(70, dtype=float))
    (first_obs, start), (obs, states, _, _, _, info) = episode(env, noisy, actions, resets=True)
    before = jax.tree.map(
        lambda a, b: jnp.concatenate([a[None], b[:-1]]), (first_obs, start), (obs, states)
    )  # rows at t_k
    window = Signals(
        r=before[1].r,
        y=before[1].y_seen,
        integral=before[1].memory.integral,
        r_tilde=actions,
        age=before[1].k.astype(float),
        r_next=info["r"],
        y_next=info["y"],
    )
    at = jnp.arange(env.observer.history, 70)
    seen, after = jax.jit(jax.vmap(env.observer.before_and_after, (None, 0, 0)))(window, at, at)
    chex.assert_trees_all_close(seen, before[0][at], atol=1e-5)
    chex.assert_trees_all_close(after, info["final_observation"][at], atol=1e-5)
    assert 0 in np.asarray(states.k), "an episode must end inside the window"
