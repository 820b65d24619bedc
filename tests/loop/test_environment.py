"""The environment: timing, ends of episodes, what is rewarded and what is seen."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxouter
from jaxouter import plants
from jaxouter.loop import rewards, sensor
from jaxouter.loop.disturbances import Disturbances, Load
from jaxouter.loop.environment import Environment, EnvParams, EnvState
from jaxouter.loop.observation import Signals
from jaxouter.loop.references import Reaimed, SetPoint
from tests import lag
from tests.precision import FLOAT

KEY = jax.random.key(0)
STEPS = 160  # of a roll-out: three episodes of the lag, and a part
REAIMED = Reaimed(-1.0, 1.0, tolerance=0.5)

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
    return replace(env, plant=replace(env.plant, **changes))


def only_moves(params: EnvParams) -> EnvParams:
    """A reward of minus |r~_k - r~_(k-1)|."""
    return replace(params, reward=replace(params.reward, alpha_g=scalar(0.0), beta_h=scalar(1.0), rho_h=scalar(0.0)))


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
    chex.assert_type([obs, reward, info["final_observation"], info["r"], info["y"]], FLOAT)
    chex.assert_type([terminated, truncated], jnp.bool_)
    chex.assert_equal_shape([obs, info["final_observation"]])


@pytest.mark.parametrize("name", ["pitch", "heaters"])
def test_plants_of_the_paper_keep_shapes_and_precision(name: str) -> None:
    env, params = jaxouter.make(name)
    before = jax.eval_shape(env.reset, KEY, params)
    obs, state, reward, *_ = jax.eval_shape(env.step, KEY, before[1], scalar(1.0), params)
    chex.assert_trees_all_equal_shapes_and_dtypes(before, (obs, state))
    assert (obs.dtype, reward.dtype) == (FLOAT, FLOAT)


def test_half_of_the_episodes_have_noise_and_half_a_load_where_asked() -> None:
    env, params = make(disturbances=Disturbances(0.5, 0.2))
    found = jax.vmap(lambda key: env.reset(key, params)[1])(jax.random.split(KEY, 400))
    for value, most in ((found.disturbance.noise, 0.5), (found.disturbance.load.size, 0.2 * 4.0)):
        assert np.mean(np.asarray(value) == 0.0) == pytest.approx(0.5, abs=0.08)
        assert 0.9 * most < np.abs(value).max() <= most
    assert make()[0].reset(KEY, params)[1].disturbance is None
    noisy = np.asarray(found.disturbance.noise) > 0.0
    np.testing.assert_array_equal(noisy, np.asarray(found.y != found.y_seen))


def test_a_load_is_added_to_the_modified_reference_unseen() -> None:
    env, params = make(disturbances=Disturbances(0.0, 0.2))
    _, state = env.reset(KEY, params)
    load = Load(scalar(3.0), scalar(0.25))
    state = state._replace(disturbance=state.disturbance._replace(load=load))
    plain, other = make()[0], state._replace(disturbance=None)
    for k in range(30):
        state = step_env(env, KEY, state, scalar(0.5), params)[1]
        other = step_env(plain, KEY, other, scalar(0.5 if k < 3 else 0.75), params)[1]
        np.testing.assert_allclose(state.y, other.y, rtol=1e-6)
    assert float(state.memory.r_tilde_past[0]) == 0.5
    assert float(other.memory.r_tilde_past[0]) == 0.75


@pytest.mark.parametrize("shape", [(2,), (1, 1)])
def test_action_must_be_one_number(shape: tuple[int, ...]) -> None:
    env, params = make()
    _, state = reset(env, KEY, params)
    with pytest.raises(AssertionError, match="rank"):
        step_env(env, KEY, state, jnp.zeros(shape), params)


def test_resets_draw_start_and_set_point() -> None:
    env, params = make()
    drawn = [reset(env, key, params)[1] for key in jax.random.split(KEY, 100)]
    y, r = np.array([[state.y, state.r] for state in drawn]).T
    for values, bound in ((y, 0.5), (r, 1.0)):
        assert bound * 0.9 < np.abs(values).max() <= bound
        assert values.min() < 0.0 < values.max()
    assert abs(np.corrcoef(y, r)[0, 1]) < 5 / np.sqrt(100)


@partial(jax.jit, static_argnums=0)
def rollout(env: Environment, params: EnvParams, actions: jax.Array, key: jax.Array = KEY) -> Any:
    """Start, then all that the steps gave, stacked; new episodes begin where one ends."""

    def advance(state: EnvState, inputs: tuple[jax.Array, jax.Array]) -> tuple[EnvState, Any]:
        out = env.step(inputs[0], state, inputs[1], params)
        return out[1], out

    first = env.reset(key, params)
    keys = jax.random.split(jax.random.fold_in(key, 1), len(actions))
    return first, jax.lax.scan(advance, first[1], (keys, actions))[1]


def episode(env: Environment, params: EnvParams, actions: jax.Array) -> Any:
    """A roll-out of one length, so that tests share a compilation, cut to these actions of the first episode."""
    assert len(actions) < env.plant.episode_steps
    first, out = rollout(env, params, jnp.concatenate([actions, jnp.zeros(STEPS - len(actions))]))
    return first, jax.tree.map(lambda leaf: leaf[: len(actions)], out)


def test_episodes_are_truncated_at_their_length_and_not_terminated() -> None:
    env, params = make()
    _, (_, states, _, terminated, truncated, _) = rollout(env, params, jnp.ones(STEPS))
    np.testing.assert_array_equal(np.flatnonzero(truncated), [49, 99, 149])
    np.testing.assert_array_equal(states.k, np.arange(1, STEPS + 1) % env.plant.episode_steps)
    assert not bool(terminated.any())


def test_divergence_terminates_with_its_penalty() -> None:
    env, params = make(K=6.0, T=0.1, d=0.0)
    _, state = reset(env, KEY, params)
    true_y, ended = float(state.y), []
    for _ in range(4):
        true_y = 24.0 + (true_y - 24.0) * np.exp(-1.0)
        r = float(state.r)
        _, state, reward, terminated, truncated, _ = step_env(env, KEY, state, scalar(4.0), params)
        ended.append(bool(terminated))
        assert ended[-1] == (true_y > 20.0)
        assert not bool(truncated)
        y = min(true_y, 20.0)
        assert float(state.y) == pytest.approx(y, rel=1e-4)
        assert float(reward) == pytest.approx(-0.3 * abs(r - y) - 5.0 * ended[-1], rel=1e-4)
    assert ended == [False, True, True, True]


def shown(y: float, r: float = 0.5) -> Any:
    """One raw step of a lag that stays at y, whatever it is."""
    env, params = make(T=1e12)
    _, state = reset(env, KEY, params)
    state = state._replace(plant=state.plant._replace(y=scalar(y)), r=scalar(r))
    return step_env(env, KEY, state, scalar(0.0), params)


@pytest.mark.parametrize(("y", "diverged"), [(20.0, False), (20.001, True), (-20.0, False), (-20.001, True)])
def test_output_at_the_bound_is_not_divergence(y: float, diverged: bool) -> None:
    assert bool(shown(y)[3]) == diverged


@pytest.mark.parametrize(("y", "counted_as"), [(np.nan, 20.0), (np.inf, 20.0), (-np.inf, -20.0)])
def test_output_that_is_not_finite_terminates_and_counts_as_a_bound(y: float, counted_as: float) -> None:
    obs, after, reward, terminated, truncated, info = shown(y, r=0.5)
    assert bool(terminated)
    assert not bool(truncated)
    chex.assert_tree_all_finite((obs, reward, info))
    assert float(after.y) == float(info["y"]) == counted_as
    assert float(reward) == pytest.approx(-0.3 * abs(0.5 - counted_as) - 5.0)


def test_plant_that_breaks_is_replaced_by_a_new_episode() -> None:
    env, params = make(K=float("nan"))
    _, (obs, states, reward, terminated, _, info) = rollout(env, params, jnp.ones(STEPS))
    assert bool(terminated.all())
    np.testing.assert_array_equal(states.k, 0)
    chex.assert_tree_all_finite((obs, reward, info, states.y, states.memory, states.plant))
    assert len(np.unique(states.y)) == STEPS


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
    _, (_, states, *_) = rollout(env, params, jnp.zeros(STEPS))
    begun = np.flatnonzero(np.asarray(states.k) == 0)
    assert len(begun) == 3
    assert len(np.unique(states.r[begun])) == len(np.unique(states.y[begun])) == 3


def test_error_is_of_the_reference_before_and_the_output_after_the_step() -> None:
    env, params = make(goal=REAIMED)
    (_, start), (_, states, reward, *_) = episode(env, params, jnp.linspace(-2.0, 2.0, 45))
    r = np.concatenate([[start.r], states.r[:-1]])
    np.testing.assert_allclose(reward, -0.3 * np.abs(r - np.asarray(states.y)), rtol=1e-5)
    assert np.count_nonzero(np.diff(r)) > 1


def test_moves_of_the_modified_reference_are_charged_with_the_first_from_the_start() -> None:
    env, params = make()
    actions = jnp.array([1.0, -2.0, -2.0, 0.5])
    (_, start), (_, _, reward, *_) = episode(env, only_moves(params), actions)
    np.testing.assert_allclose(reward, [-abs(1.0 - float(start.y)), -3.0, 0.0, -2.5], rtol=1e-5)
    assert float(start.y) != 0.0


def test_first_move_is_from_the_start_clipped_to_the_bounds() -> None:
    env, params = make()
    narrow = with_plant(env, r_tilde_bounds=(-0.001, 0.001))
    narrow = replace(narrow, observer=replace(env.observer, r_tilde_bounds=(-0.001, 0.001)))
    _, state = reset(narrow, KEY, params)
    assert abs(float(state.y)) > 0.001
    edge = 0.001 * np.sign(float(state.y))
    reward = step_env(narrow, KEY, state, scalar(-edge), only_moves(params))[2]
    assert float(reward) == pytest.approx(-0.002, rel=1e-4)


def test_moves_of_the_output_are_charged_with_the_first() -> None:
    env, params = make()
    zero = scalar(0.0)
    params = replace(params, reward=replace(params.reward, alpha_g=zero, beta_b=scalar(1.0), rho_b=zero))
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
    zero = scalar(0.0)
    params = replace(params, reward=replace(params.reward, rho_h=zero, rho_b=zero))  # all moves are charged
    noisy = replace(params, sensor=sensor.params(noise=0.3, bias=1.0))
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
    lost = replace(params, sensor=sensor.params(missing=1.0))
    (_, start), (_, states, *_) = episode(env, lost, jnp.ones(10))
    chex.assert_trees_all_equal(states.y_seen, jnp.broadcast_to(start.y, (10,)))
    assert float(jnp.ptp(states.y)) > 0.1


def test_goal_aims_by_what_is_seen() -> None:
    env, params = make(goal=REAIMED)
    biased = replace(params, sensor=sensor.params(bias=0.6))
    (_, start), (_, states, *_) = episode(env, biased, jnp.zeros(40))
    r = np.concatenate([[start.r], states.r])
    near = np.abs(r[:-1] - np.asarray(states.y_seen)) < 0.5
    np.testing.assert_array_equal(np.diff(r) != 0, near)
    assert near.any()
    assert (near != (np.abs(r[:-1] - np.asarray(states.y)) < 0.5)).any()


def test_plant_that_draws_has_other_parameters_in_each_episode() -> None:
    env, params = make(randomise=True)
    _, (_, states, *_) = rollout(env, params, jnp.zeros(STEPS))
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


def test_lanes_under_vmap_equal_single_environments_whatever_parameter_is_swept() -> None:
    env, params = make()
    scales = jnp.linspace(0.5, 1.5, 4)
    swept = jax.tree.map(lambda leaf: jnp.where(jnp.isinf(leaf), leaf, leaf * scales), params)
    swept = replace(swept, sensor=replace(swept.sensor, bias=scales, noise=scales))
    keys, ages = jax.random.split(KEY, 4), jnp.array([0, 10, 49, 60], jnp.int32)
    actions = jnp.array([1.0, -1.0, 3.0, 9.0])
    singles = [jax.tree.map(lambda leaf, i=i: leaf[i], swept) for i in range(4)]
    states = [reset(env, key, p)[1]._replace(k=k) for key, k, p in zip(keys, ages, singles, strict=True)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    lanes = jax.jit(jax.vmap(env.step_env))(keys, stacked, actions, swept)
    for i, p in enumerate(singles):
        lane = jax.tree.map(lambda leaf, i=i: leaf[i], lanes)
        alone = step_env(env, keys[i], states[i], actions[i], p)
        chex.assert_trees_all_close(comparable(lane), comparable(alone), atol=1e-5)
    np.testing.assert_array_equal(lanes[4], [False, False, True, True])


@pytest.mark.parametrize("ages", [[0, 10, 49, 60], [0, 10, 20, 30]], ids=["some-end", "none-ends"])
def test_resets_under_vmap_are_those_of_single_environments(ages: list[int]) -> None:
    env, params = make()
    keys, actions = jax.random.split(KEY, 4), jnp.array([1.0, -1.0, 3.0, 9.0])
    states = [
        reset(env, key, params)[1]._replace(k=jnp.asarray(k, jnp.int32)) for key, k in zip(keys, ages, strict=True)
    ]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    lanes = jax.jit(jax.vmap(env.step, (0, 0, 0, None)))(keys, stacked, actions, params)
    for i, state in enumerate(states):
        lane = jax.tree.map(lambda leaf, i=i: leaf[i], lanes)
        alone = step(env, keys[i], state, actions[i], params)
        chex.assert_trees_all_close(comparable(lane), comparable(alone), atol=1e-5)
    np.testing.assert_array_equal(lanes[1].k == 0, np.array(ages) >= 49)


def test_new_episode_of_pitch_does_not_see_the_old_one() -> None:
    """The contents of its delay lines are kept at a reset, so that nothing is copied, but count as zero."""
    env, params = jaxouter.make("pitch")
    _, old = reset(env, KEY, params)
    for action in (50.0, -50.0, 50.0):
        _, old, *_ = step_env(env, KEY, old, scalar(action), params)
    _, fresh = reset(env, KEY, params)
    reused = fresh._replace(plant=env.plant.reuse(old.plant, fresh.plant))
    assert float(jnp.abs(reused.plant.lines).max()) > 0.01
    for _ in range(8):
        fresh, reused = (step_env(env, KEY, state, scalar(20.0), params)[1] for state in (fresh, reused))
        chex.assert_trees_all_equal((fresh.y, fresh.plant.x), (reused.y, reused.plant.x))


def comparable(tree: Any) -> Any:
    """Keys as numbers."""
    is_key = lambda leaf: jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)  # noqa: E731
    return jax.tree.map(lambda leaf: jax.random.key_data(leaf) if is_key(leaf) else leaf, tree)


def test_scan_equals_a_loop() -> None:
    env, params = make()
    actions = jnp.linspace(-3.0, 3.0, STEPS)
    first, scanned = rollout(env, params, actions)
    state, keys = first[1], jax.random.split(jax.random.fold_in(KEY, 1), STEPS)
    for i in range(60):
        out = step(env, keys[i], state, actions[i], params)
        state = out[1]
        expected = jax.tree.map(lambda leaf, i=i: leaf[i], scanned)
        chex.assert_trees_all_close(comparable(out), comparable(expected), atol=1e-5)


def test_step_is_the_same_without_jit() -> None:
    env, params = make()
    _, state = reset(env, KEY, params)
    with jax.disable_jit():
        plain = env.step_env(KEY, state, scalar(9.0), params)
    compiled = step_env(env, KEY, state, scalar(9.0), params)
    chex.assert_trees_all_close(comparable(compiled), comparable(plain), atol=1e-5)


def test_windows_of_recorded_signals_give_back_the_observations() -> None:
    env, params = make(goal=REAIMED)
    noisy = replace(params, sensor=sensor.params(noise=0.1))
    actions = 3.0 * jnp.sin(jnp.arange(STEPS, dtype=float))
    (first_obs, start), (obs, states, _, _, _, info) = rollout(env, noisy, actions)
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
    at = jnp.arange(env.observer.history, STEPS)
    seen, after = jax.jit(jax.vmap(env.observer.before_and_after, (None, 0, 0)))(window, at, at)
    chex.assert_trees_all_close(seen, before[0][at], atol=1e-5)
    chex.assert_trees_all_close(after, info["final_observation"][at], atol=1e-5)
    assert np.count_nonzero(np.asarray(states.k) == 0) == 3, "episodes must end inside the window"


@pytest.mark.parametrize("plant", ["pitch", "heaters"])
def test_an_action_that_is_no_number_shows_the_reference_itself(plant):
    env, params = jaxouter.make(plant)
    _, state = reset(env, KEY, params)
    chex.assert_trees_all_equal(*(step(env, KEY, state, action, params) for action in (jnp.array(jnp.nan), state.r)))


def test_small_moves_cost_once_the_reference_has_rested() -> None:
    """By hand, on moves of 1 crad back and forth: 0.2 / 3.5 from the third step on, and nothing before."""
    price = rewards.RewardConfig(0.0, beta_b=0.0, delta_b=0.0, rest=0.2, rest_after=2)
    env, params = jaxouter.make("pitch", reward=price)
    _, state = reset(env, KEY, params)
    before, costs = float(jnp.clip(state.y, *env.plant.r_tilde_bounds)), []
    for i in range(4):
        _, state, reward, *_ = step_env(env, KEY, state, scalar(before + (i + 1) % 2), params)
        costs.append(float(reward))
    assert costs == pytest.approx([0.0, 0.0, -0.2 / 3.5, -0.2 / 3.5], rel=1e-4)
