"""The environment around a plant, in the style of gymnax 1.0: pure functions, traced parameters.

    env, params = jaxouter.make("pitch")
    obs, state = env.reset(key, params)
    obs, state, reward, terminated, truncated, info = env.step(key, state, r_tilde, params)

The action is r~ itself, in the plant's unit. One environment is unbatched; vmap for many. Spaces, `name`, `num_actions`
and `default_params` are gymnax's too, except that `params` must always be passed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jax.custom_batching import custom_vmap

from jaxouter.loop import closed_loop, rewards, sensor
from jaxouter.loop.closed_loop import LoopState
from jaxouter.loop.disturbances import UNDISTURBED, Disturbances, Load
from jaxouter.loop.observation import Memory, Observer
from jaxouter.loop.references import Goal, SetPoint
from jaxouter.loop.rewards import RewardConfig, RewardParams
from jaxouter.loop.sensor import SensorParams
from jaxouter.loop.spaces import Box, observation_space
from jaxouter.plants import REGISTRY, Plant, Ranges, base, randomised
from jaxouter.plants import make as make_plant
from jaxouter.plants.registry import Maker, add

RESET = 1  # folded into the key of a step that ends an episode
DISTURBED = 3  # folded into the key of a reset


@struct.dataclass
class EnvParams:
    """Everything that can be swept without recompiling."""

    plant: Any
    sensor: SensorParams
    reward: RewardParams


class Disturbance(NamedTuple):
    """What disturbs one episode."""

    noise: jax.Array  # standard deviation of the measurement noise, beside the sensor's own
    load: Load


class EnvState(NamedTuple):
    """State of one environment at t_k."""

    plant: Any
    plant_params: Any  # drawn at reset; None if the plant draws none
    disturbance: Disturbance | None  # drawn at reset; None in an environment without any
    goal: Any
    memory: Memory  # of the outer loop, with e_k already integrated
    r: jax.Array  # reference r_k
    y: jax.Array  # true output y_k
    y_seen: jax.Array  # measured output
    k: jax.Array  # int32, k
    held: jax.Array  # int32, control steps since r last changed


@dataclass(frozen=True)
class Environment:
    """A plant, a reference generator and the observer. Static and hashable."""

    plant: Plant
    observer: Observer
    goal: Goal
    disturbances: Disturbances = UNDISTURBED
    default_params: EnvParams | None = field(default=None, repr=False, compare=False)
    """The parameters that `make` returned with it. Pass them to compiled functions as an argument: environments that
    differ in nothing else are equal, and share what is compiled."""

    @property
    def name(self) -> str:
        """Name of the plant."""
        return self.plant.name

    @property
    def num_actions(self) -> int:
        """Length of an action."""
        return 1

    def action_space(self, params: EnvParams | None = None) -> Box:
        """r~ within its bounds, (1,), in the plant's unit."""
        del params
        return Box(*self.plant.r_tilde_bounds, (1,), jnp.result_type(float))

    def observation_space(self, params: EnvParams | None = None) -> Box:
        """Observations (3 + 2H,) for r and y within the plant's `divergence_bounds`.

        Sensor noise, a set-point outside them, or rounding may exceed these bounds: `step` does not clip.
        """
        del params
        return observation_space(self.plant, self.observer)

    def reset(self, key: chex.PRNGKey, params: EnvParams) -> tuple[jax.Array, EnvState]:
        """Begin an episode: draw parameters, start and reference.

        Returns:
            obs (3 + 2H,) and the state.
        """
        key_draw, key_start, key_goal, key_sensor = jax.random.split(key, 4)
        drawn = None if self.plant.draw is None else self.plant.draw(key_draw, params.plant)
        plant_params = params.plant if drawn is None else drawn
        state = self.plant.training_start(key_start, plant_params)
        disturbance = self._disturbance(key)
        measure = partial(sensor.measure, _disturbed(params.sensor, disturbance), key_sensor)
        loop = closed_loop.begin(self.plant, plant_params, state, measure)
        goal, r = self.goal.init(key_goal, loop.y_seen)
        memory, obs = self.observer.observe(self.observer.init(r, loop.y_seen), r, loop.y_seen)
        zeros = jnp.zeros(2, jnp.int32)
        return obs, EnvState(state, drawn, disturbance, goal, memory, r, loop.y, loop.y_seen, *zeros)

    def _disturbance(self, key: chex.PRNGKey) -> Disturbance | None:
        """What disturbs an episode, drawn by the key of its reset."""
        drawn, plant = self.disturbances, self.plant
        if drawn == UNDISTURBED:
            return None
        key_noise, key_load = jax.random.split(jax.random.fold_in(key, DISTURBED))
        return Disturbance(drawn.noise_level(plant, key_noise), drawn.load_of(plant, key_load, plant.episode_steps))

    def _bounded(self, r_tilde: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Clip an output that has diverged (NaN included) to the bounds; the flag ends the episode."""
        del r_tilde
        low, high = self.plant.divergence_bounds
        terminated = ~((y >= low) & (y <= high))  # in this form NaN counts as divergence
        return jnp.where(terminated, jnp.clip(jnp.nan_to_num(y, nan=high), low, high), y), terminated

    def step_env(
        self, key: chex.PRNGKey, state: EnvState, action: jax.Array, params: EnvParams
    ) -> tuple[jax.Array, EnvState, jax.Array, jax.Array, jax.Array, dict[str, jax.Array]]:
        """One control step, without reset.

        Args:
            key: randomness of plant and sensor.
            state: at t_k.
            action: r~_k, () or (1,), clipped to its bounds; NaN is replaced by r_k.
            params: traced parameters.

        Returns:
            obs, state, reward, terminated (y diverged), truncated (the episode has its full length), and info with
            `final_observation` (obs before any reset), `r`, `y` and `y_true` (its reference, measured and true output).
        """
        if jnp.shape(action) == (1,):  # as the action space has it
            action = action[0]
        chex.assert_rank(action, 0)
        plant, p = self.plant, params.plant if state.plant_params is None else state.plant_params
        action = jnp.where(jnp.isnan(action), state.r, action)
        # Before the first step the memory holds a measured y; the reward needs the true one.
        before = jnp.where(state.k == 0, jnp.clip(state.y, *plant.r_tilde_bounds), state.memory.r_tilde_past[0])
        loop = LoopState(state.plant, state.y, state.y_seen, before)
        measure = partial(sensor.measure, _disturbed(params.sensor, state.disturbance), key)
        loop, reward, terminated = closed_loop.advance(
            plant,
            p,
            params.reward,
            loop,
            state.r,
            action,
            key,
            measure,
            self._bounded,
            load=0.0 if state.disturbance is None else state.disturbance.load.at(state.k),
            terms=plant.reward_terms,
            held=state.held.astype(state.y.dtype),
        )
        reward = reward + jnp.where(terminated, params.reward.divergence, 0.0)
        truncated = state.k + 1 >= plant.episode_steps

        goal, r = self.goal.step(state.goal, loop.y_seen)
        memory = self.observer.record(state.memory, state.y_seen, loop.r_tilde)
        memory, obs = self.observer.observe(memory, r, loop.y_seen)
        held = jnp.where(r == state.r, state.held + 1, 0)
        state = state._replace(
            plant=loop.plant, goal=goal, memory=memory, r=r, y=loop.y, y_seen=loop.y_seen, k=state.k + 1, held=held
        )
        info = {"final_observation": obs, "r": r, "y": loop.y_seen, "y_true": loop.y}
        return obs, state, reward, terminated, truncated, info

    def step(
        self, key: chex.PRNGKey, state: EnvState, action: jax.Array, params: EnvParams
    ) -> tuple[jax.Array, EnvState, jax.Array, jax.Array, jax.Array, dict[str, jax.Array]]:
        """One control step; when the episode ends, obs and state are those of a new one.

        The last observation of the old one is `info["final_observation"]`: bootstrap from it unless terminated.
        """
        obs, after, reward, terminated, truncated, info = self.step_env(key, state, action, params)
        done = terminated | truncated

        def reset(key: chex.PRNGKey, params: EnvParams) -> tuple[jax.Array, EnvState]:
            return self.reset(jax.random.fold_in(key, RESET), params)

        new_obs, new = _if_any(done, reset, (key, params), (obs, after))
        new = new._replace(plant=self.plant.reuse(after.plant, new.plant))
        obs, after = jax.tree.map(lambda a, b: jnp.where(done, a, b), (new_obs, new), (obs, after))
        return obs, after, reward, terminated, truncated, info


def _disturbed(params: SensorParams, disturbance: Disturbance | None) -> SensorParams:
    """The sensor in an episode."""
    return params if disturbance is None else replace(params, noise=jnp.hypot(params.noise, disturbance.noise))


def _if_any(needed: jax.Array, function: Callable[..., Any], operands: tuple[Any, ...], otherwise: Any) -> Any:
    """function(*operands) if `needed` (bool scalar), else `otherwise`, of the same structure.

    Under vmap the function runs for all lanes if one needs it, so lanes that don't may get either value. `cond` would
    become a `select` and always run it. A reset is needed once in an episode, but costs more than a step.
    """

    @custom_vmap
    def call(needed: jax.Array, operands: tuple[Any, ...], otherwise: Any) -> Any:
        return jax.lax.cond(
            needed, lambda operands, _: function(*operands), lambda _, other: other, operands, otherwise
        )

    @call.def_vmap
    def lanes(size: int, batched: list[Any], needed: jax.Array, operands: tuple[Any, ...], otherwise: Any) -> Any:
        axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, batched[1])
        function_of_all = jax.vmap(function, axes, axis_size=size)
        others = jax.tree.map(
            lambda leaf, is_batched: leaf if is_batched else jnp.broadcast_to(leaf, (size, *leaf.shape)),
            otherwise,
            batched[2],
        )
        out = _if_any(jnp.any(needed), function_of_all, operands, others)
        return out, jax.tree.map(lambda _: True, out)

    return call(needed, operands, otherwise)


def make(
    name: str | Maker,
    *,
    history: int | None = None,
    integral_steps: float | None = None,
    goal: Goal | None = None,
    drawn: Ranges = (),
    reward: RewardConfig = rewards.PAPER,
    disturbances: Disturbances = UNDISTURBED,
    **overrides: Any,
) -> tuple[Environment, EnvParams]:
    """An environment on the training distribution, and its parameters.

    Args:
        name: the plant: a name for `jaxouter.plants.make`, FILE.py:NAME and the like, or your own maker or task.
        history, integral_steps: of the observation, see `Observer.of`.
        goal: reference generator; None: one set-point per episode, as in the paper.
        drawn: parameters to draw at each reset, see `jaxouter.plants.randomised`.
        reward: weights of the reward.
        disturbances: of each episode.
        **overrides: parameters of the plant.
    """
    name = name if isinstance(name, str) and base(name) in REGISTRY else add(name)
    plant, plant_params = make_plant(name, **overrides)
    if drawn:
        plant, plant_params = randomised(plant, plant_params, drawn)
    goal = SetPoint(*plant.setpoint_range) if goal is None else goal
    params = EnvParams(plant=plant_params, sensor=sensor.params(), reward=rewards.params(plant, reward))
    return Environment(plant, Observer.of(plant, history, integral_steps), goal, disturbances, params), params
