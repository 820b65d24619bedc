"""One environment for learners that step through Gymnasium; needs the extra `gymnasium`.

    env = OuterLoop("pitch", tau=0.5)
    obs, info = env.reset(seed=0)
    obs, reward, terminated, truncated, info = env.step(env.action_space.sample())

It is `jaxouter.loop.environment` with NumPy at its edges. Training on many environments at once is faster on that one.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxouter.loop.environment import Environment, EnvParams, EnvState, make
from jaxouter.loop.observation import Memory

try:
    import gymnasium
except ImportError as error:
    raise ImportError('jaxouter.deploy.gymnasium needs Gymnasium: pip install "jaxouter[gymnasium]"') from error


def observation_bounds(env: Environment) -> tuple[jax.Array, jax.Array]:
    """Least and greatest observation while r and y lie within the plant's `divergence_bounds`; each (3 + 2H,).

    An episode ends where y leaves them. The leaky integral is a running mean of r - y from 0, so it has its bounds.
    """
    limits = jnp.asarray(env.plant.divergence_bounds, float)
    r_tilde = jnp.asarray(env.plant.r_tilde_bounds, float)
    shape = (env.observer.history,)

    def extreme(r: jax.Array, y: jax.Array, r_tilde: jax.Array) -> jax.Array:
        # Every feature is monotone: it rises with r, past y, past r~ and the integral, and falls with y.
        return env.observer.features(Memory(jnp.full(shape, r), jnp.full(shape, r_tilde), r - y), r, y)

    return extreme(limits[0], limits[1], r_tilde[0]), extreme(limits[1], limits[0], r_tilde[1])


def _seen(env: Environment, obs: jax.Array, state: EnvState) -> tuple[jax.Array, dict[str, jax.Array]]:
    """The observation within its bounds, which rounding, sensor noise or a far goal may pass, and info."""
    info = {"r": state.r, "y": state.y_seen, "r_tilde": state.memory.r_tilde_past[0]}
    return jnp.clip(obs, *observation_bounds(env)), info


# Compiled once for all instances with the same plant, observer and goal, whatever their parameters.
@partial(jax.jit, static_argnums=0)
def _reset(env: Environment, params: EnvParams, seed: np.uint32) -> tuple[Any, Any]:
    key, key_reset = jax.random.split(jax.random.key(seed))
    obs, state = env.reset(key_reset, params)
    return (key, state), _seen(env, obs, state)


@partial(jax.jit, static_argnums=0)
def _step(
    env: Environment, params: EnvParams, carry: tuple[chex.PRNGKey, EnvState], action: np.ndarray
) -> tuple[Any, Any]:
    key, key_step = jax.random.split(carry[0])
    low, high = env.plant.r_tilde_bounds
    r_tilde = (low + high) / 2 + (high - low) / 2 * jnp.asarray(action[0], float)
    obs, state, reward, terminated, truncated, _ = env.step_env(key_step, carry[1], r_tilde, params)
    return (key, state), (*_seen(env, obs, state), reward, terminated, truncated)


def _array(obs: np.ndarray) -> np.ndarray:
    """A copy that the caller may write to, in the type of the space also under x64."""
    return np.array(obs, np.float32)


class OuterLoop(gymnasium.Env[np.ndarray, np.ndarray]):
    """The outer loop around one plant: sees r and y, chooses r~.

    - Action, (1,): r~ scaled such that -1 and 1 are its bounds in the plant. Learners of continuous actions explore and
      saturate on that scale, and Gymnasium's checker asks for it. For r~ in the plant's unit:
      `gymnasium.wrappers.RescaleAction(env, *np.float32(env.functional.plant.r_tilde_bounds))`.
    - Observation, (3 + 2H,): that of `jaxouter.loop.observation.Observer`, clipped to `observation_bounds`.
    - End: `terminated` where y diverged, `truncated` at the plant's `episode_steps` (bootstrap there), so it needs no
      `gymnasium.wrappers.TimeLimit`. It does not reset itself.
    - Info: r and y as in the observation, and the r~ that led there, in the plant's unit. The reward is of the true y.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - as Gymnasium declares it
        "render_modes": [],
        "autoreset_mode": gymnasium.vector.AutoresetMode.DISABLED,
    }

    functional: Environment
    """The environment without state."""
    params: EnvParams
    """Its parameters; others of the same structure (sensor noise, say) may take their place, without recompilation."""

    def __init__(self, plant: str, **settings: Any) -> None:
        """Nothing is drawn before `reset`.

        Args:
            plant: see `jaxouter.plants.make`.
            **settings: of `jaxouter.make`: history, integral_steps, goal, and parameters of the plant.

        Raises:
            ValueError: unknown plant or parameter (lists what exists), or a value that does not fit.
        """
        self.functional, self.params = make(plant, **settings)
        low, high = (np.asarray(bound, np.float32) for bound in observation_bounds(self.functional))
        self.observation_space = gymnasium.spaces.Box(low, high)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
        self._carry: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """A new episode: parameters, start and reference are drawn.

        Args:
            seed: of this and all later episodes; None: go on with the one before.
            options: there are none.

        Returns:
            obs (3 + 2H,) float32 and info.
        """
        super().reset(seed=seed)
        del options
        draw = self.np_random.integers(2**32, dtype=np.uint32)
        self._carry, seen = _reset(self.functional, self.params, draw)
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
        if self._carry is None:
            raise gymnasium.error.ResetNeeded("step was called before the first reset; call reset first")
        action = np.asarray(action)
        if action.shape != (1,) or not np.isfinite(action[0]):
            raise ValueError(f"action is {action!r}; it must be one finite number in an array of shape (1,)")
        self._carry, seen = _step(self.functional, self.params, self._carry, action)
        obs, info, reward, terminated, truncated = jax.device_get(seen)
        return _array(obs), float(reward), bool(terminated), bool(truncated), _floats(info)


def _floats(info: dict[str, np.ndarray]) -> dict[str, Any]:
    return {name: float(value) for name, value in info.items()}
