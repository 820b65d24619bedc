"""Gymnasium environments; needs the extra `gymnasium`.

    import gymnasium
    import jaxouter  # registers jaxouter/Pitch-v0 and jaxouter/Heaters-v0, if gymnasium was imported before

    env = gymnasium.make("jaxouter/Pitch-v0", tau=0.5)
    envs = gymnasium.make_vec("jaxouter/Pitch-v0", num_envs=64, tau=0.5)

They wrap `jaxouter.loop.environment` with NumPy in and out. Importing this module registers the ids too, whatever was
imported before. `gymnasium.make("jaxouter.runtime.gymnasium:jaxouter/Pitch-v0")` needs no import at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np

import jaxouter.identification  # noqa: F401 - for plants log:FILE
from jaxouter.loop.environment import Environment, EnvParams, EnvState, make
from jaxouter.runtime import registration

try:
    import gymnasium
    from gymnasium.utils import seeding
    from gymnasium.vector import AutoresetMode
except ImportError as error:
    raise ImportError(
        'jaxouter.runtime.gymnasium needs Gymnasium 1.1 or later: pip install "jaxouter[gymnasium]"'
    ) from error


def _seen(env: Environment, obs: jax.Array, state: EnvState) -> tuple[jax.Array, dict[str, jax.Array]]:
    """The observation clipped to its space, which rounding, sensor noise or a far set-point may exceed; and info."""
    info = {"r": state.r, "y": state.y_seen, "r_tilde": state.memory.r_tilde_past[0]}
    space = env.observation_space()
    return jnp.clip(obs, space.low, space.high), info


# Compiled once for all instances with the same plant, observer and goal, whatever their parameters.
@partial(jax.jit, static_argnums=0)
def _reset(env: Environment, params: EnvParams, seed: np.uint32) -> tuple[Any, Any]:
    key, key_reset = jax.random.split(jax.random.key(seed))
    obs, state = env.reset(key_reset, params)
    return (key, state), _seen(env, obs, state)


@partial(jax.jit, static_argnums=0)
def _step(
    env: Environment, params: EnvParams, carry: tuple[chex.PRNGKey, EnvState], action: np.ndarray
) -> tuple[Any, Any, Any]:
    key, key_step = jax.random.split(carry[0])
    low, high = env.plant.r_tilde_bounds
    r_tilde = (low + high) / 2 + (high - low) / 2 * jnp.asarray(action[0], float)
    obs, state, reward, terminated, truncated, _ = env.step_env(key_step, carry[1], r_tilde, params)
    return (key, state), _seen(env, obs, state), (reward, terminated, truncated)


@partial(jax.jit, static_argnums=0)
def _resets(env: Environment, params: EnvParams, seeds: np.ndarray, chosen: np.ndarray, before: Any) -> Any:
    """New episodes for the `chosen` loops, (n,) bool; `before` for the others. If `before` is None, for all."""
    new = jax.vmap(lambda seed: _reset(env, params, seed))(seeds)
    if before is None:
        return new
    return jax.vmap(lambda here, *both: jax.tree.map(partial(jnp.where, here), *both))(chosen, new, before)


@partial(jax.jit, static_argnums=0)
def _steps(env: Environment, params: EnvParams, carry: Any, actions: np.ndarray) -> Any:
    return jax.vmap(lambda carry, action: _step(env, params, carry, action))(carry, actions)


def _made(plant: str, render_mode: str | None, settings: dict[str, Any]) -> tuple[Environment, EnvParams]:
    if render_mode is not None:  # stable-baselines3 gives one, and tries again without it after a TypeError only
        raise TypeError(f"render_mode is {render_mode!r}; there is nothing to render, so it must be None")
    return make(plant, **settings)


def _spaces(env: Environment) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Observation space and action space of one loop."""
    space = env.observation_space()
    return gymnasium.spaces.Box(np.float32(space.low), np.float32(space.high)), gymnasium.spaces.Box(-1.0, 1.0, (1,))


def _draw(generator: np.random.Generator) -> np.uint32:
    """A seed for an episode's key."""
    return generator.integers(2**32, dtype=np.uint32)


def _checked(carry: Any, action: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The action, after checks that a step is possible."""
    if carry is None:
        raise gymnasium.error.ResetNeeded("step was called before the first reset; call reset first")
    action = np.asarray(action)
    if action.shape != shape or not np.isfinite(action).all():
        raise ValueError(f"action is {action!r}; it must be finite numbers in an array of shape {shape}")
    return action


def _array(obs: np.ndarray) -> np.ndarray:
    """A writable copy with the dtype of the space, also under x64."""
    return np.array(obs, np.float32)


class OuterLoop(gymnasium.Env[np.ndarray, np.ndarray]):
    """The outer loop around one plant: sees r and y, chooses r~.

    - Action, (1,): r~ scaled so that -1 and 1 are its bounds. Learners with continuous actions explore and saturate on
      that scale, and Gymnasium's checker asks for it. For r~ in the plant's unit:
      `gymnasium.wrappers.RescaleAction(env, *np.float32(env.functional.plant.r_tilde_bounds))`.
    - Observation, (3 + 2H,): that of `jaxouter.loop.observation.Observer`, clipped to the space.
    - End: `terminated` if y diverged, `truncated` at the plant's `episode_steps` (bootstrap there), so it needs no
      `gymnasium.wrappers.TimeLimit`. It does not reset itself.
    - Info: r and y as in the observation, and the r~ before it, in the plant's unit. The reward uses the true y.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - as Gymnasium declares it
        "render_modes": [],
        "autoreset_mode": AutoresetMode.DISABLED,
    }

    functional: Environment
    """The functional environment."""
    params: EnvParams
    """Its parameters. They may be replaced by others of the same structure (e.g. sensor noise) without recompiling."""

    def __init__(self, plant: str, *, render_mode: str | None = None, **settings: Any) -> None:
        """Nothing is drawn before `reset`.

        Args:
            plant: see `jaxouter.plants.make`.
            render_mode: must be None.
            **settings: for `jaxouter.make`: history, integral_steps, goal, and parameters of the plant.

        Raises:
            ValueError: unknown plant or parameter (lists the known ones), or a wrong value.
            TypeError: a render_mode is given.
        """
        self.functional, self.params = _made(plant, render_mode, settings)
        self.observation_space, self.action_space = _spaces(self.functional)
        self._carry: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode: draw parameters, start and reference.

        Args:
            seed: for this and all later episodes; None: continue with the random numbers.
            options: not used.

        Returns:
            obs (3 + 2H,) float32 and info.
        """
        super().reset(seed=seed)
        del options
        self._carry, seen = _reset(self.functional, self.params, _draw(self.np_random))
        obs, info = jax.device_get(seen)
        return _array(obs), _floats(info)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control step.

        Args:
            action: (1,), scaled r~, clipped to [-1, 1].

        Returns:
            obs (3 + 2H,) float32, reward, terminated, truncated, info.

        Raises:
            gymnasium.error.ResetNeeded: before the first `reset`.
            ValueError: action is not one finite number in an array of shape (1,).
        """
        action = _checked(self._carry, action, (1,))
        self._carry, *after = _step(self.functional, self.params, self._carry, action)
        (obs, info), (reward, terminated, truncated) = jax.device_get(after)
        return _array(obs), float(reward), bool(terminated), bool(truncated), _floats(info)


def _floats(info: dict[str, np.ndarray]) -> dict[str, Any]:
    return {name: float(value) for name, value in info.items()}


class OuterLoops(gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many outer loops of one kind, each drawn separately, stepped in one compiled call.

    Results equal those of `gymnasium.vector.SyncVectorEnv` over as many `OuterLoop` in its mode `SAME_STEP`: when an
    episode ends, the observation is the first of the next one; the last of the old one is in `infos["final_obs"]`
    (bootstrap from it unless terminated), and its info in `infos["final_info"]`.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - as Gymnasium declares it
        "render_modes": [],
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    functional: Environment
    """The functional environment of one loop."""
    params: EnvParams
    """Its parameters, of all loops."""

    def __init__(self, plant: str, num_envs: int = 1, *, render_mode: str | None = None, **settings: Any) -> None:
        """Nothing is drawn before `reset`.

        Args:
            plant, render_mode, **settings: as for `OuterLoop`.
            num_envs: n, number of loops.

        Raises:
            ValueError: as for `OuterLoop`, or num_envs is below 1.
            TypeError: a render_mode is given.
        """
        if num_envs < 1:
            raise ValueError(f"num_envs is {num_envs}; it must be at least 1")
        self.num_envs = num_envs
        self.functional, self.params = _made(plant, render_mode, settings)
        self.single_observation_space, self.single_action_space = _spaces(self.functional)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, num_envs)
        self._generators = [seeding.np_random()[0] for _ in range(num_envs)]
        self._carry: Any = None

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode in every loop.

        Args:
            seed: loop i gets seed + i; or one seed per loop; None: continue with the random numbers.
            options: not used.

        Returns:
            obs (n, 3 + 2H) float32 and infos.

        Raises:
            ValueError: the number of seeds is not that of the loops.
        """
        del options
        seeds = [seed] * self.num_envs if seed is None else seed
        seeds = [seeds + i for i in range(self.num_envs)] if isinstance(seeds, int) else seeds
        if len(seeds) != self.num_envs:
            raise ValueError(
                f"seed has {len(seeds)} elements; it must be one number or one for each of {self.num_envs}"
            )
        self._generators = [
            generator if seed is None else seeding.np_random(seed)[0]
            for generator, seed in zip(self._generators, seeds, strict=True)
        ]
        obs, info = self._restart(np.ones(self.num_envs, bool), None)
        return _array(obs), _infos(info, np.ones(self.num_envs, bool))

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control step of all loops.

        Args:
            actions: (n, 1), scaled r~, clipped to [-1, 1].

        Returns:
            obs (n, 3 + 2H) float32, reward (n,), terminated (n,), truncated (n,), infos.

        Raises:
            gymnasium.error.ResetNeeded: before the first `reset`.
            ValueError: actions are not finite numbers in an array of shape (n, 1).
        """
        actions = _checked(self._carry, actions, (self.num_envs, 1))
        self._carry, seen, outcome = _steps(self.functional, self.params, self._carry, actions)
        (obs, info), (reward, terminated, truncated) = jax.device_get((seen, outcome))
        ended, infos = terminated | truncated, {}
        if ended.any():
            infos = _batched({"final_obs": _rows(_array(obs), ended), "final_info": _infos(info, ended)}, ended)
            obs, info = self._restart(ended, (self._carry, seen))
        infos |= _infos(info, np.ones(self.num_envs, bool))
        return _array(obs), np.array(reward, float), np.array(terminated), np.array(truncated), infos

    def _restart(self, chosen: np.ndarray, before: Any) -> Any:
        """Observations and infos after starting new episodes in the `chosen` loops."""
        seeds = np.zeros(self.num_envs, np.uint32)
        for i in np.flatnonzero(chosen):
            seeds[i] = _draw(self._generators[i])
        self._carry, seen = _resets(self.functional, self.params, seeds, chosen, before)
        return jax.device_get(seen)


def _rows(array: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """The chosen rows as objects, None elsewhere; (n,)."""
    rows = np.full(len(array), None, object)
    for i in np.flatnonzero(chosen):
        rows[i] = array[i]
    return rows


def _infos(info: dict[str, np.ndarray], chosen: np.ndarray) -> dict[str, Any]:
    return _batched({name: np.where(chosen, np.array(value, float), 0.0) for name, value in info.items()}, chosen)


def _batched(values: dict[str, Any], chosen: np.ndarray) -> dict[str, Any]:
    """Gymnasium's form of infos: each value has a mask that tells which loops have it."""
    return values | {f"_{name}": chosen.copy() for name in values}


registration.register()
