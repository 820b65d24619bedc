"""The Gymnasium adapters: Gymnasium's own checks, and that they are the functional environment."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils import seeding
from gymnasium.utils.env_checker import check_env

import jaxouter
from jaxouter import plants
from jaxouter.loop import sensor
from jaxouter.loop.environment import Environment
from jaxouter.loop.references import Reaimed
from jaxouter.runtime.gymnasium import OuterLoop, OuterLoops
from tests import lag
from tests.precision import makes_nan


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(plants.REGISTRY, "lag", lag.make)


def make(**settings: Any) -> OuterLoop:
    """The lag, whose line has one length in all tests."""
    return OuterLoop("lag", max_delay=1.0, **settings)


def make_loops(num_envs: int, **settings: Any) -> OuterLoops:
    """The same, many."""
    return OuterLoops("lag", num_envs, max_delay=1.0, **settings)


def act(value: float) -> np.ndarray:
    return np.array([value], np.float32)


def episode(env: OuterLoop, seed: int | None, action: float = 0.2) -> list[tuple[Any, ...]]:
    """All that one episode returns, from reset to the end."""
    seen: list[tuple[Any, ...]] = [env.reset(seed=seed)]
    while len(seen) == 1 or not (seen[-1][2] or seen[-1][3]):
        seen.append(env.step(act(action)))
    return seen


@pytest.mark.parametrize("name", ["Pitch", "Heaters"])
def test_gymnasium_finds_no_fault(name: str) -> None:
    check_env(gymnasium.make(f"jaxouter/{name}-v0").unwrapped)


def test_settings_are_keywords_of_make() -> None:
    env = gymnasium.make("jaxouter/Pitch-v0", tau=0.5, history=3)
    assert env.observation_space.shape == (9,)
    loops = gymnasium.make_vec("jaxouter/Pitch-v0", num_envs=2, tau=0.5, history=3)
    assert loops.observation_space.shape == (2, 9)
    assert isinstance(env.unwrapped, OuterLoop)
    assert isinstance(loops, OuterLoops)
    assert env.unwrapped.params.plant.tau == loops.params.plant.tau == 0.5


def test_it_is_the_functional_environment() -> None:
    actions = np.linspace(-1.3, 1.3, 9, dtype=np.float32)
    adapter = OuterLoop("heaters")
    env, params = jaxouter.make("heaters")
    draw = seeding.np_random(3)[0].integers(2**32, dtype=np.uint32)
    key, key_reset = jax.random.split(jax.random.key(draw))
    obs, state = jax.jit(env.reset)(key_reset, params)
    seen, info = adapter.reset(seed=3)
    np.testing.assert_allclose(seen, obs, rtol=1e-6)
    assert (info["r"], info["y"]) == pytest.approx((float(state.r), float(state.y)))
    step_env = jax.jit(env.step_env)
    for action in actions:
        key, key_step = jax.random.split(key)
        r_tilde = 20.0 + 20.0 * action
        obs, state, reward, *_, expected = step_env(key_step, state, jnp.asarray(r_tilde, float), params)
        seen, seen_reward, terminated, truncated, info = adapter.step(act(action))
        np.testing.assert_allclose(seen, obs, rtol=1e-4, atol=1e-5)
        assert seen_reward == pytest.approx(float(reward), rel=1e-4, abs=1e-5)
        assert (terminated, truncated) == (False, False)
        assert info == pytest.approx(
            {"r": float(expected["r"]), "y": float(expected["y"]), "r_tilde": np.clip(r_tilde, 0.0, 40.0)}, rel=1e-5
        )


def test_episodes_are_of_the_seed_and_go_on_without_one() -> None:
    env, other = make(randomise=True), make(randomise=True)
    first, second = episode(env, 5), episode(env, None)
    for expected, seed in ((first, 5), (second, None)):
        for got, (obs, *rest) in zip(episode(other, seed), expected, strict=True):
            np.testing.assert_array_equal(got[0], obs)
            assert got[1:] == tuple(rest)
    starts = [first[0][1], second[0][1], env.reset(seed=6)[1]]
    assert len({start["r"] for start in starts}) == len({start["y"] for start in starts}) == 3


def test_time_limit_truncates_and_does_not_reset() -> None:
    env = make()
    seen = episode(env, 0)
    assert len(seen) == 1 + 50
    assert seen[-1][2:4] == (False, True)
    assert env.step(act(0.2))[4] == pytest.approx(seen[-1][4], abs=1e-4)  # long settled, and still there


def test_divergence_terminates_within_the_space() -> None:
    env = make(K=20.0)
    seen = episode(env, 0, action=1.0)
    assert len(seen) < 1 + 50
    assert seen[-1][2:4] == (True, False)
    assert seen[-1][4]["y"] == 20.0
    assert seen[-1][1] < -5.0
    assert all(obs in env.observation_space for obs, *_ in seen)


def test_spaces_have_the_bounds_of_the_plant() -> None:
    env = make()
    high = np.array([20.0, 40.0, 40.0] + 5 * [40.0] + 5 * [1.0])  # r, r - y, its integral, past y - y, past r~
    np.testing.assert_allclose(env.observation_space.high, high)
    np.testing.assert_allclose(env.observation_space.low, -high)
    heaters = OuterLoop("heaters").observation_space  # not symmetric: y from -20 to 60 about 20, scaled by 5
    np.testing.assert_allclose((heaters.low[:2], heaters.high[:2]), ((-8.0, -16.0), (8.0, 16.0)))
    assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)


def test_unit_of_the_plant_by_a_wrapper() -> None:
    env = make()
    in_units = gymnasium.wrappers.RescaleAction(env, *np.asarray(env.functional.plant.r_tilde_bounds, np.float32))
    in_units.reset(seed=0)
    assert in_units.step(act(1.5))[4]["r_tilde"] == pytest.approx(1.5)
    assert env.step(act(-7.0))[4]["r_tilde"] == -4.0


@makes_nan
def test_instances_share_what_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    traced = []
    step_env = Environment.step_env
    monkeypatch.setattr(Environment, "step_env", lambda *a: traced.append(None) or step_env(*a))
    goal = Reaimed(-1.0, 1.0, tolerance=0.3)  # of this test alone
    env, other = make(goal=goal), make(goal=goal, K=0.7)
    other.params = replace(other.params, sensor=sensor.params(noise=1000.0))
    for each in (env, other):
        for seed in (0, 1):
            each.reset(seed=seed)
            seen = [each.step(act(0.5))[0], each.step(np.array([0.5]))[0]]
            assert all(obs in each.observation_space for obs in seen)
    assert len(traced) == 1


def test_observations_are_the_callers() -> None:
    env = make()
    obs, _ = env.reset(seed=0)
    obs[:] = 0.0
    again, _ = env.reset(seed=0)
    assert np.abs(again).max() > 0.01
    assert again.dtype == np.float32


@pytest.mark.parametrize("action", [np.zeros(2), np.float32(0.0), np.array([np.nan])])
def test_action_that_does_not_fit(action: np.ndarray) -> None:
    env = make()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"finite numbers in an array of shape \(1,\)"):
        env.step(action)


@pytest.mark.parametrize("actions", [np.zeros(2), np.zeros((3, 1)), np.array([[0.0], [np.nan]])])
def test_actions_that_do_not_fit(actions: np.ndarray) -> None:
    loops = make_loops(2)
    loops.reset(seed=0)
    with pytest.raises(ValueError, match=r"finite numbers in an array of shape \(2, 1\)"):
        loops.step(actions)


def test_loops_that_cannot_be() -> None:
    with pytest.raises(ValueError, match="num_envs is 0; it must be at least 1"):
        make_loops(0)
    with pytest.raises(ValueError, match="seed has 3 elements; it must be one number or one for each of 2"):
        make_loops(2).reset(seed=[0, 1, 2])


@pytest.mark.parametrize("kind", [OuterLoop, OuterLoops])
def test_there_is_nothing_to_render(kind: Any) -> None:
    kind("lag", render_mode=None)
    with pytest.raises(TypeError, match="render_mode is 'rgb_array'; there is nothing to render, so it must be None"):
        kind("lag", render_mode="rgb_array")


def test_step_before_reset() -> None:
    for env, action in ((make(), np.zeros(1)), (make_loops(2), np.zeros((2, 1)))):
        with pytest.raises(gymnasium.error.ResetNeeded, match="call reset first"):
            env.step(action)


def test_resets_are_left_to_the_caller() -> None:
    assert OuterLoop.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.DISABLED


def same(got: Any, expected: Any) -> None:
    """Equal in keys, shapes, dtypes and, but for rounding, values; rows of object arrays too."""
    if isinstance(expected, dict):
        assert set(got) == set(expected)
        for name in expected:
            same(got[name], expected[name])
    elif expected is None:
        assert got is None
    else:
        assert (got.shape, got.dtype) == (expected.shape, expected.dtype)
        if expected.dtype == object:
            for pair in zip(got, expected, strict=True):
                same(*pair)
        else:
            np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("settings", [{"randomise": True}, {"K": 20.0}], ids=["truncated", "terminated"])
def test_loops_are_gymnasiums_synchronous_ones(settings: dict[str, Any]) -> None:
    loops, modes = make_loops(3, **settings), gymnasium.vector.AutoresetMode
    single = gymnasium.vector.SyncVectorEnv([lambda: make(**settings)] * 3, autoreset_mode=modes.SAME_STEP)
    for name in ("observation_space", "action_space", "single_observation_space", "single_action_space", "metadata"):
        assert getattr(loops, name) == getattr(single, name)
    rng, ended = np.random.default_rng(0), []
    for seed in (7, None, [3, None, 4]):  # 7: loop i has 7 + i
        same(
            dict(zip("oi", loops.reset(seed=seed), strict=True)), dict(zip("oi", single.reset(seed=seed), strict=True))
        )
        for _ in range(53):
            actions = rng.uniform(0.2, 1.0, (3, 1)).astype(np.float32) * [[1.0], [1.0], [0.01]]
            got, expected = loops.step(actions), single.step(actions)
            same(dict(zip("ortui", got, strict=True)), dict(zip("ortui", expected, strict=True)))
            ended.append(got[2] | got[3])
    assert np.any(ended, axis=0).sum() >= 2
    assert settings == {"randomise": True} or any(0 < each.sum() < 3 for each in ended)  # not all at once


def test_loops_end_where_the_plant_says() -> None:
    loops = gymnasium.make_vec("jaxouter/Heaters-v0", num_envs=4, vectorization_mode="vector_entry_point")
    assert isinstance(loops, OuterLoops)
    steps = loops.functional.plant.episode_steps
    obs, first = loops.reset(seed=0)
    assert len(set(first["r"])) == len(set(first["y"])) == 4
    for k in range(1, steps + 1):
        before = obs
        obs, _, terminated, truncated, infos = loops.step(np.zeros((4, 1)))
        assert not terminated.any()
        assert truncated.tolist() == [k == steps] * 4
        assert ("final_obs" in infos) == (k == steps)
    final = np.stack(infos["final_obs"])
    assert all(each in loops.single_observation_space for each in final)
    np.testing.assert_array_equal(infos["final_info"]["r"], first["r"])
    np.testing.assert_allclose(final[:, 0], before[:, 0])  # of the same set-point, when obs is of the next
    assert not np.any(np.isclose(final[:, 0], obs[:, 0]))
    assert np.all(infos["r"] != first["r"])


def test_loops_are_of_the_seed() -> None:
    def run(seed: int | None) -> list[np.ndarray]:
        start = loops.reset(seed=seed)[0]
        return [start] + [loops.step(np.full((2, 1), 0.3))[0] for _ in range(60)]  # into the second episode

    loops = make_loops(2)
    one, two, again = run(1), run(2), run(1)
    np.testing.assert_array_equal(one, again)
    np.testing.assert_array_equal(np.stack(one)[:50, 1], np.stack(two)[:50, 0])  # seed 1 + 1
    loops = make_loops(2)
    assert not np.array_equal(run(None)[0], run(None)[0])


def test_loops_count_as_gymnasium_counts() -> None:
    loops = gymnasium.wrappers.vector.RecordEpisodeStatistics(make_loops(2))
    loops.reset(seed=0)
    total = np.zeros(2)
    for _ in range(50):
        _, reward, _, _, infos = loops.step(np.full((2, 1), 0.3))
        total += reward
    assert infos["episode"]["l"].tolist() == [50, 50]
    np.testing.assert_allclose(infos["episode"]["r"], total)


def test_without_gymnasium_the_extra_is_named() -> None:
    code = "import sys; sys.modules['gymnasium'] = None; import jaxouter.runtime; print('there'); "
    code += "import jaxouter.runtime.gymnasium"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (run.stdout, run.returncode) == ("there\n", 1)
    last = run.stderr.splitlines()[-1]
    assert (
        last
        == 'ImportError: jaxouter.runtime.gymnasium needs Gymnasium 1.1 or later: pip install "jaxouter[gymnasium]"'
    )
