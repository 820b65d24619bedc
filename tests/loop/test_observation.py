"""What the agent sees: by hand, from windows of signals, and nothing but r, y and r~."""

from __future__ import annotations

import dataclasses
import inspect
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxouter
from jaxouter.loop import rewards, sensor
from jaxouter.loop.bank import Evidence
from jaxouter.loop.environment import Environment, EnvParams, EnvState
from jaxouter.loop.observation import Memory, Observer, Signals
from jaxouter.plants import Plant
from jaxouter.plants.heaters import HEATERS
from jaxouter.plants.pitch import PITCH, PitchParams, PitchState
from tests import lag

KEY = jax.random.key(0)
H = 3
OBSERVER = Observer(history=H, integral_steps=4.0, y_middle=20.0, y_scale=5.0, r_tilde_bounds=(0.0, 40.0))


def scalar(value: float) -> jax.Array:
    return jnp.asarray(value, float)


@pytest.mark.parametrize(("y0", "before"), [(18.0, 18.0), (70.0, 40.0), (-3.0, 0.0)])
def test_memory_is_filled_with_the_first_output_and_its_clipped_value(y0: float, before: float) -> None:
    memory = OBSERVER.init(scalar(22.0), scalar(y0))
    chex.assert_trees_all_equal(memory, Memory(jnp.full(H, y0), jnp.full(H, before), scalar(0.0)))


def test_first_observation_is_as_computed_by_hand() -> None:
    memory, obs = OBSERVER.observe(OBSERVER.init(scalar(22.0), scalar(18.0)), scalar(22.0), scalar(18.0))
    expected = [0.4, 0.8, 0.2, 0.0, 0.0, 0.0, -0.1, -0.1, -0.1]
    chex.assert_trees_all_close(obs, jnp.array(expected), atol=1e-6)
    assert float(memory.integral) == 1.0


def test_later_observations_are_as_computed_by_hand() -> None:
    memory, _ = OBSERVER.observe(OBSERVER.init(scalar(22.0), scalar(18.0)), scalar(22.0), scalar(18.0))
    memory, second = OBSERVER.observe(OBSERVER.record(memory, scalar(18.0), scalar(30.0)), scalar(22.0), scalar(19.0))
    _, third = OBSERVER.observe(OBSERVER.record(memory, scalar(19.0), scalar(0.0)), scalar(15.0), scalar(21.0))
    # The integral of r - y goes 0, 1, 1.5, -0.375 with a time constant of four steps.
    chex.assert_trees_all_close(second, jnp.array([0.4, 0.6, 0.3, -0.2, -0.2, -0.2, 0.5, -0.1, -0.1]), atol=1e-6)
    chex.assert_trees_all_close(third, jnp.array([-1.0, -1.2, -0.075, -0.4, -0.6, -0.6, -1.0, 0.5, -0.1]), atol=1e-6)


def test_an_observation_had_r_been_another_is_that_of_the_other() -> None:
    memory, _ = OBSERVER.observe(OBSERVER.init(scalar(22.0), scalar(18.0)), scalar(22.0), scalar(18.0))
    memory = OBSERVER.record(memory, scalar(18.0), scalar(30.0))
    here, there = (OBSERVER.observe(memory, scalar(r), scalar(19.0))[1] for r in (22.0, 16.5))
    chex.assert_trees_all_close(OBSERVER.had_r_been(here, scalar(-5.5)), there, atol=1e-6)
    batch = OBSERVER.had_r_been(jnp.stack([here, here]), jnp.array([0.0, -5.5]))
    chex.assert_trees_all_close(batch, jnp.stack([here, there]), atol=1e-6)


def test_integral_settles_at_a_constant_error() -> None:
    memory = OBSERVER.init(scalar(22.0), scalar(20.0))
    for _ in range(60):
        memory, _ = OBSERVER.observe(memory, scalar(22.0), scalar(20.0))
    assert float(memory.integral) == pytest.approx(2.0, rel=1e-5)


@pytest.mark.parametrize("plant", [PITCH, HEATERS], ids=lambda plant: plant.name)
def test_plant_gives_scales_and_length(plant: Plant) -> None:
    observer = Observer.of(plant)
    low, high = plant.setpoint_range
    assert observer.history == {"pitch": 15, "heaters": 5}[plant.name]
    assert observer.size == 3 + 2 * observer.history
    assert (observer.y_middle, observer.y_scale) == ((low + high) / 2, (high - low) / 2)
    assert observer.integral_steps == 50
    assert hash(observer) == hash(Observer.of(plant))


def test_bounds_of_set_point_and_modified_reference_are_seen_as_one() -> None:
    observer = Observer.of(HEATERS, history=1)
    memory = Memory(jnp.array([25.0]), jnp.array([40.0]), scalar(0.0))
    chex.assert_trees_all_close(observer.features(memory, scalar(25.0), scalar(15.0)), jnp.array([1.0, 2, 0, 2, 1]))


def test_history_and_integral_are_configurable() -> None:
    observer = Observer.of(PITCH, history=2, integral_steps=7)
    memory, obs = observer.observe(observer.init(scalar(7.0), scalar(0.0)), scalar(7.0), scalar(0.0))
    chex.assert_shape(obs, (7,))
    assert float(memory.integral) == pytest.approx(1.0)


@pytest.mark.parametrize("settings", [{"history": 0}, {"integral_steps": 0.5}])
def test_impossible_settings_are_named(settings: dict[str, Any]) -> None:
    ((name, value),) = settings.items()
    with pytest.raises(ValueError, match=rf"{name} is {value}.*at least 1"):
        Observer.of(PITCH, **settings)


class Recorded:
    """Episodes of random signals, seen step by step; the rows that a replay would hold."""

    def __init__(self, lengths: tuple[int, ...]) -> None:
        random = np.random.default_rng(0)
        rows: list[Signals] = []
        self.memories: list[Memory] = []  # at each row, its error integrated
        self.obs: list[jax.Array] = []
        self.final: list[jax.Array] = []  # what was seen after each row, before any reset
        self.episode: list[int] = []
        for episode, length in enumerate(lengths):
            r, y = random.uniform(10.0, 30.0, (2, length + 1)).astype(np.float32)
            r_tilde = random.uniform(0.0, 40.0, length).astype(np.float32)
            y[0] += 30.0 * (episode % 2)  # beyond the bounds of r~, too
            memory, obs = OBSERVER.observe(OBSERVER.init(scalar(r[0]), scalar(y[0])), scalar(r[0]), scalar(y[0]))
            for k in range(length):
                self.memories.append(memory)
                self.obs.append(obs)
                self.episode.append(episode)
                row = (r[k], y[k], float(memory.integral), r_tilde[k], k, r[k + 1], y[k + 1])
                rows.append(Signals(*(scalar(value) for value in row)))
                memory = OBSERVER.record(memory, scalar(y[k]), scalar(r_tilde[k]))
                memory, obs = OBSERVER.observe(memory, scalar(r[k + 1]), scalar(y[k + 1]))
                self.final.append(obs)
        self.window = jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows)

    def cut(self, first: int, last: int) -> Signals:
        return jax.tree.map(lambda leaf: leaf[first : last + 1], self.window)


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    """Among them episodes shorter than the history."""
    return Recorded((6, 2, 1, 4, 7))


def test_memory_of_a_window_is_the_running_one_at_every_age(recorded: Recorded) -> None:
    memory_at = jax.jit(OBSERVER.memory_at)
    ages = set()
    for i in range(H, len(recorded.obs)):
        chex.assert_trees_all_close(memory_at(recorded.window, jnp.asarray(i)), recorded.memories[i], atol=1e-6)
        ages.add(int(recorded.window.age[i]))
    assert ages == set(range(7))


def test_shortest_window_gives_the_same_memory(recorded: Recorded) -> None:
    memory_at = jax.jit(OBSERVER.memory_at)
    for i in range(H, len(recorded.obs)):
        chex.assert_trees_all_close(memory_at(recorded.cut(i - H, i), H), recorded.memories[i], atol=1e-6)


@pytest.mark.parametrize("steps", [1, 3])
def test_observations_before_and_after_some_steps_are_those_seen(recorded: Recorded, steps: int) -> None:
    before_and_after = jax.jit(OBSERVER.before_and_after)
    compared = 0
    for i in range(H, len(recorded.obs) - steps + 1):
        j = i + steps - 1
        if recorded.episode[i] == recorded.episode[j]:
            before, after = before_and_after(recorded.cut(i - H, j), H, H + steps - 1)
            chex.assert_trees_all_close(before, recorded.obs[i], atol=1e-5)
            chex.assert_trees_all_close(after, recorded.final[j], atol=1e-5)
            compared += 1
    assert compared > 4


@pytest.mark.parametrize("steps", [1, 3])
def test_observations_of_a_held_reference_are_those_seen_under_it(recorded: Recorded, steps: int) -> None:
    held = jax.jit(OBSERVER.held, static_argnums=1)
    compared = 0
    for i in range(H, len(recorded.obs) - steps + 1):
        j = i + steps - 1
        if recorded.episode[i] == recorded.episode[j]:
            window, r = recorded.cut(i - H, j), scalar(13.0)
            y = jnp.append(window.y[H:], window.y_next[-1])
            memory, tau = recorded.memories[i], OBSERVER.integral_steps
            before = (memory.integral - (window.r[H] - y[0]) / tau) / (1.0 - 1.0 / tau)
            memory, first = OBSERVER.observe(memory._replace(integral=before), r, y[0])
            for k in range(steps):
                memory, last = OBSERVER.observe(OBSERVER.record(memory, y[k], window.r_tilde[H + k]), r, y[k + 1])
            found = OBSERVER.before_and_after(held(window, H, r), H, H + steps - 1)
            chex.assert_trees_all_close(found, (first, last), atol=1e-5)
            compared += 1
    assert compared > 4


def test_nothing_but_references_and_outputs_is_recorded() -> None:
    assert Signals._fields == ("r", "y", "integral", "r_tilde", "age", "r_next", "y_next")
    assert Memory._fields == ("y_past", "r_tilde_past", "integral", "evidence")
    assert Evidence._fields == ("mean_error", "performance", "active")  # of predictions of y from past y and r~


@pytest.mark.parametrize(
    ("method", "takes"),
    [
        (Observer.init, ["self", "r0", "y0"]),
        (Observer.observe, ["self", "memory", "r", "y"]),
        (Observer.record, ["self", "memory", "y", "r_tilde"]),
        (Observer.features, ["self", "memory", "r", "y"]),
        (Observer.memory_at, ["self", "window", "i"]),
        (Observer.before_and_after, ["self", "window", "i", "j"]),
        (Observer.held, ["self", "window", "i", "r"]),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_nothing_but_references_and_outputs_goes_into_an_observation(method: Any, takes: list[str]) -> None:
    assert list(inspect.signature(method).parameters) == takes


def test_elapsed_time_does_not_enter_beyond_the_filling_of_the_history(recorded: Recorded) -> None:
    window = recorded.cut(15, 19)  # inside the last episode, of age 2 and more
    older = window._replace(age=window.age + 1000.0)
    full = window._replace(age=window.age + float(H))
    chex.assert_trees_all_equal(OBSERVER.before_and_after(older, H, H + 1), OBSERVER.before_and_after(full, H, H + 1))


@dataclasses.dataclass(frozen=True)
class Scripted:
    """A goal of its own, so that episodes of different keys have the same reference."""

    middle: float

    def init(self, key: chex.PRNGKey, y0: jax.Array) -> tuple[jax.Array, jax.Array]:
        del key, y0
        return scalar(0.0), scalar(self.middle)

    def step(self, state: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        del y
        return state + 1.0, self.middle + 3.0 * jnp.sin(state + 1.0)


def with_start(env: Environment, start: Any) -> Environment:
    plant = dataclasses.replace(env.plant, start=start)
    return dataclasses.replace(env, plant=plant, goal=Scripted(env.observer.y_middle))


@partial(jax.jit, static_argnums=0)
def observations(env: Environment, params: EnvParams, key: jax.Array) -> tuple[jax.Array, EnvState]:
    """All that the agent sees along scripted actions, and the states."""
    low, high = env.plant.r_tilde_bounds
    actions = (low + high) / 2 + (high - low) / 4 * jnp.cos(jnp.arange(25, dtype=float))
    first, state = env.reset(key, params)

    def step(state: EnvState, action: jax.Array) -> tuple[EnvState, tuple[jax.Array, EnvState]]:
        obs, state, *_ = env.step_env(key, state, action, params)
        return state, (obs, state)

    _, (obs, states) = jax.lax.scan(step, state, actions)
    return jnp.concatenate([first[None], obs]), states


def hidden_start(key: chex.PRNGKey, params: PitchParams) -> PitchState:
    """A pitch angle of 2 crad; everything that is hidden is drawn."""
    state = PITCH.init(key, params)
    keys = PitchState(*jax.random.split(key, len(state)))
    drawn = [jax.random.normal(k, leaf.shape, float) for k, leaf in zip(keys[:-1], state[:-1], strict=True)]
    state = PitchState(*drawn, k=jax.random.randint(keys.k, (), 0, 100))
    return state._replace(x=state.x.at[3].set(2.0))


@pytest.fixture(scope="module")
def two_hidden_lives() -> list[tuple[jax.Array, EnvState]]:
    """Of an aircraft whose pitch angle cannot move, while everything that is hidden does."""
    A = np.array(jaxouter.make("pitch")[1].plant.A)
    A[3] = 0.0
    fixed: dict[str, Any] = dict(A=A, K1=[-0.02, 0.07, -0.8, -1.3], K2=-0.5, max_delay=0.5)
    lives = []
    others: tuple[dict[str, Any], ...] = ({}, dict(tau=0.3, d1=0.2, d2=0.1, gain=0.5, disturbance=1.0))
    for seed, hidden in enumerate(others):
        env, params = jaxouter.make("pitch", **fixed, **hidden)
        lives.append(observations(with_start(env, hidden_start), params, jax.random.key(seed)))
    return lives


def test_hidden_state_and_parameters_do_not_reach_the_agent(two_hidden_lives: list[Any]) -> None:
    (one, states), (other, other_states) = two_hidden_lives
    chex.assert_trees_all_equal(one, other)
    assert float(jnp.ptp(one, axis=0).max()) > 0.1
    for name in ("xc", "xi", "lines", "r_tilde_line", "k"):
        assert bool((getattr(states.plant, name) != getattr(other_states.plant, name)).any()), name
    assert bool((states.plant.x[:, :3] != other_states.plant.x[:, :3]).all())


def test_observation_is_that_of_the_present_signals_and_memory(two_hidden_lives: list[Any]) -> None:
    obs, states = two_hidden_lives[0]
    observer = Observer.of(PITCH)
    seen = jax.vmap(observer.features)(states.memory, states.r, states.y_seen)
    chex.assert_trees_all_close(seen, obs[1:], atol=1e-6)


def test_single_houses_do_not_reach_the_agent() -> None:
    """Houses spread in two ways about one and the same mean."""
    env, params = jaxouter.make("heaters", sigma=0.0, x0_mean=18.0, x0_spread=5.0)
    env = with_start(env, HEATERS.init)
    (one, states), (other, other_states) = (observations(env, params, jax.random.key(seed)) for seed in (0, 1))
    chex.assert_trees_all_close(one, other, atol=1e-5)
    assert float(jnp.abs(states.plant.x - other_states.plant.x).max()) > 1.0


def test_elapsed_time_does_not_reach_the_agent() -> None:
    env, params = lag_environment()
    _, state = jax.jit(env.reset)(KEY, params)
    step = jax.jit(env.step_env)
    early = step(KEY, state, scalar(1.0), params)
    late = step(KEY, state._replace(k=state.k + 33), scalar(1.0), params)
    chex.assert_trees_all_equal(early[0], late[0])
    assert int(late[1].k) == 34


def lag_environment() -> tuple[Environment, EnvParams]:
    plant, plant_params = lag.make()
    env = Environment(plant, Observer.of(plant), Scripted(0.0))
    return env, EnvParams(plant=plant_params, sensor=sensor.params(), reward=rewards.params(plant))
