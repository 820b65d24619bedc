"""The Gymnasium adapter: Gymnasium's own checks, and that it is the functional environment."""

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
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import seeding
from gymnasium.utils.env_checker import check_env

import jaxouter
from jaxouter import plants
from jaxouter.deploy.gymnasium import OuterLoop
from jaxouter.loop import sensor
from jaxouter.loop.environment import Environment
from jaxouter.loop.references import Reaimed
from tests import lag
from tests.precision import makes_nan


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(plants.REGISTRY, "lag", lag.make)


def make(**settings: Any) -> OuterLoop:
    """The lag, whose line has one length in all tests."""
    return OuterLoop("lag", max_delay=1.0, **settings)


def act(value: float) -> np.ndarray:
    return np.array([value], np.float32)


def episode(env: OuterLoop, seed: int | None, action: float = 0.2) -> list[tuple[Any, ...]]:
    """All that one episode returns, from reset to the end."""
    seen: list[tuple[Any, ...]] = [env.reset(seed=seed)]
    while len(seen) == 1 or not (seen[-1][2] or seen[-1][3]):
        seen.append(env.step(act(action)))
    return seen


@pytest.mark.parametrize("name", ["pitch", "heaters"])
def test_gymnasium_finds_no_fault(name: str) -> None:
    spec = EnvSpec(
        "OuterLoop-v0", entry_point=OuterLoop, kwargs={"plant": name}
    )  # else it can't check close and render
    check_env(gymnasium.make(spec).unwrapped)


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
    assert seen[-1][1] < -50.0
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
    with pytest.raises(ValueError, match=r"one finite number in an array of shape \(1,\)"):
        env.step(action)


def test_step_before_reset() -> None:
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset first"):
        make().step(act(0.0))


def test_resets_are_left_to_the_caller() -> None:
    assert OuterLoop.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.DISABLED


def test_without_gymnasium_the_extra_is_named() -> None:
    code = "import sys; sys.modules['gymnasium'] = None; import jaxouter.deploy; print('there'); "
    code += "import jaxouter.deploy.gymnasium"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (run.stdout, run.returncode) == ("there\n", 1)
    last = run.stderr.splitlines()[-1]
    assert last == 'ImportError: jaxouter.deploy.gymnasium needs Gymnasium: pip install "jaxouter[gymnasium]"'
