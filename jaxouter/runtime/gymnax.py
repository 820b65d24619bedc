"""The environment for learners that were written for gymnax 0.0, such as those of rejax and purejaxrl; needs no gymnax.

    env, params = jaxouter.runtime.gymnax.make("pitch", tau=0.5)
    obs, state = env.reset(key, params)
    obs, state, reward, done, info = env.step(key, state, action, params)

`jaxouter.make` has the interface of gymnax 1.0, where `step` returns `terminated` and `truncated` instead of `done`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import chex
import jax
from flax import struct

import jaxouter.identification  # noqa: F401 - for plants log:FILE
from jaxouter.loop import environment
from jaxouter.loop.environment import Environment, EnvState
from jaxouter.loop.spaces import Box


@struct.dataclass
class EnvParams(environment.EnvParams):
    """Parameters as gymnax has them, with the length of an episode."""

    max_steps_in_episode: int = struct.field(pytree_node=False)
    """For learners to read; what ends an episode is the plant's `episode_steps`."""


@dataclass(frozen=True)
class OuterLoop:
    """The outer loop around one plant. Static and hashable; one environment is unbatched.

    - Action, () or (1,): r~ scaled so that -1 and 1 are its bounds, as learners start with actions of order 1.
    - Observation, (3 + 2H,): that of `jaxouter.loop.observation.Observer`.
    """

    functional: Environment
    """The environment of gymnax 1.0."""
    reward_scale: float = 1.0
    """Multiplies the reward."""

    @property
    def name(self) -> str:
        """Name of the plant."""
        return self.functional.name

    @property
    def num_actions(self) -> int:
        """Length of an action."""
        return self.functional.num_actions

    @property
    def default_params(self) -> EnvParams:
        """The parameters that `make` returned with it; see `Environment.default_params`."""
        params = self.functional.default_params
        assert params is not None, "made by `make`"
        return EnvParams(params.plant, params.sensor, params.reward, self.functional.plant.episode_steps)

    def action_space(self, params: EnvParams | None = None) -> Box:
        """Scaled r~, (1,)."""
        return Box(-1.0, 1.0, (1,), self.functional.action_space(params).dtype)

    def observation_space(self, params: EnvParams | None = None) -> Box:
        """See `Environment.observation_space`."""
        return self.functional.observation_space(params)

    def reset(self, key: chex.PRNGKey, params: EnvParams) -> tuple[jax.Array, EnvState]:
        """Begin an episode; obs (3 + 2H,) and the state."""
        return self.functional.reset(key, params)

    def step(
        self, key: chex.PRNGKey, state: EnvState, action: jax.Array, params: EnvParams
    ) -> tuple[jax.Array, EnvState, jax.Array, jax.Array, dict[str, jax.Array]]:
        """One control step; when the episode ends, obs and state are those of a new one.

        Args:
            key: randomness of plant, sensor and a new episode.
            state: at t_k.
            action: scaled r~_k, () or (1,), clipped to [-1, 1].
            params: traced parameters.

        Returns:
            obs (3 + 2H,), state, scaled reward, done, and the info of `Environment.step` with `terminated` and
            `truncated`. A learner that looks at `done` alone does not bootstrap at the time limit.
        """
        low, high = self.functional.plant.r_tilde_bounds
        r_tilde = (low + high) / 2 + (high - low) / 2 * action
        obs, state, reward, terminated, truncated, info = self.functional.step(key, state, r_tilde, params)
        info = info | {"terminated": terminated, "truncated": truncated}
        return obs, state, self.reward_scale * reward, terminated | truncated, info


def make(name: str, *, reward_scale: float = 1.0, **settings: Any) -> tuple[OuterLoop, EnvParams]:
    """An environment on the training distribution, and its parameters.

    Args:
        name: plant, see `jaxouter.plants.make`.
        reward_scale: multiplies the reward.
        **settings: for `jaxouter.make`: history, integral_steps, goal, and parameters of the plant.
    """
    env = OuterLoop(environment.make(name, **settings)[0], reward_scale)
    return env, env.default_params
