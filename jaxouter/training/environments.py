"""Parallel environments in which an agent explores, and the state of a training."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxouter.agents import Agent
from jaxouter.loop import bank
from jaxouter.loop.bank import BaseLaw
from jaxouter.loop.environment import Environment, EnvParams, EnvState
from jaxouter.loop.observation import Signals
from jaxouter.loop.policy import affine
from jaxouter.training.policy import LearnedPolicy

AXIS = "environments"  # mesh axis of a learner's shards
EPISODES = 16  # per diagnosis


class Kept(NamedTuple):
    """Actors of the agent's own epochs."""

    best: Any  # so far
    average: Any  # of the recent ones


class TrainState(NamedTuple):
    """All training state of one seed."""

    agent: Any
    data: Any  # of the driver: the replay, or ()
    env: EnvState  # (E, ...)
    obs: jax.Array  # (E, n)
    noise: Any  # (E, ...), state of the exploration noise
    base: BaseLaw  # base law of the policy
    key: chex.PRNGKey
    steps: jax.Array  # int32, environment steps of the agent so far
    pairs: Any = ()  # of the rounds of pairs
    kept: Kept | tuple[()] = ()  # () if the agent's own epochs compare no actors


def step_with(
    env: Environment,
    policy: LearnedPolicy,
    base: BaseLaw,
    params: EnvParams,
    state: EnvState,
    action: jax.Array,
    key: chex.PRNGKey,
) -> tuple[jax.Array, EnvState, jax.Array, jax.Array]:
    """One step of an environment, without reset, under an action in [-1, 1]: obs, state, reward, terminated."""
    r_tilde = policy.r_tilde(base, state.memory, state.r, state.y_seen, action)
    return env.step_env(key, state, r_tilde, params)[:4]


class Step(NamedTuple):
    """One step of every environment, (E, ...)."""

    signals: Signals
    action: jax.Array  # (E,)
    held: jax.Array  # (E,), control steps since r last changed
    y: jax.Array  # (E,), true output before the step
    y_next: jax.Array  # (E,), and after it, before any reset
    reward: jax.Array  # (E,), in the learner's scale
    terminated: jax.Array  # (E,), bool
    truncated: jax.Array  # (E,), bool
    plant_reward: jax.Array  # (E,), in the unit of y
    final_obs: jax.Array  # (E, n), before any reset


@dataclass(frozen=True)
class Environments:
    """The environments of one training run, or of one of its shards. Static and hashable.

    Shards are members of the mapped axis `AXIS`; agent, key and counters are the same in all.
    """

    env: Environment
    policy: LearnedPolicy
    agent: Agent
    count: int
    """Environments of this shard."""
    steps: int
    """Environment steps of the whole training, over all environments."""
    reward_scale: float
    """Factor from the plant's reward to the learner's, which makes it independent of the unit of y."""
    shards: int = 1

    @property
    def total(self) -> int:
        """Environments over all shards."""
        return self.count * self.shards

    def fresh(self, key: chex.PRNGKey, params: EnvParams, data: Any) -> TrainState:
        """Random networks, reset environments; a zero action is the middle of the range of r~."""
        key, key_agent, key_env = jax.random.split(key, 3)
        obs, env = jax.vmap(self.env.reset, (0, None))(jax.random.split(key_env, self.count), params)
        return TrainState(
            agent=self.agent.init(key_agent),
            data=data,
            env=env,
            obs=obs,
            noise=self.agent.noise(self.count),
            base=self._middle(),
            key=key,
            steps=jnp.zeros((), jnp.int32),
        )

    def _middle(self) -> BaseLaw:
        """The base law whose r~ is the middle of its range, or a bank of it."""
        observer = self.policy.observer
        middle = affine(0.0, sum(observer.r_tilde_bounds) / 2, observer.lags)
        if not observer.laws:
            return middle
        nothing = jnp.zeros((observer.laws, observer.lags))
        return bank.of([middle] * observer.laws, nothing, nothing, observer.y_scale)

    def keys(self, state: TrainState, steps: int, n: int) -> list[chex.PRNGKey]:
        """`n` arrays of keys (steps,), for the next `steps` steps of all environments; differ between shards.

        A key depends on the number of the step, not on where an epoch began. Random numbers are drawn for all steps at
        once, before the loop, as each draw inside it would cost as much as a small matrix product.
        """
        numbers = state.steps + self.total * jnp.arange(steps, dtype=state.steps.dtype)
        key = state.key if self.shards == 1 else jax.random.fold_in(state.key, jax.lax.axis_index(AXIS))
        return list(jax.vmap(lambda i: jax.random.split(jax.random.fold_in(key, i), n), out_axes=1)(numbers))

    def each(self, keys: chex.PRNGKey) -> chex.PRNGKey:
        """One key per environment: keys (steps,) -> (steps, E)."""
        return jax.vmap(lambda key: jax.random.split(key, self.count))(keys)

    def normals(self, keys: chex.PRNGKey) -> jax.Array:
        """Standard normal numbers for exploration: keys (steps,) -> (steps, E)."""
        return jax.vmap(lambda key: jax.random.normal(key, (self.count,), float))(keys)

    def explore(self, state: TrainState, normal: jax.Array) -> tuple[jax.Array, Any, Any, jax.Array]:
        """The agent's action in every environment.

        An action that is not finite becomes zero, which keeps a broken actor out of the data. (Elsewhere NaN is treated
        otherwise: the environment passes r through, and a roll-out counts as diverged.)

        Returns:
            actions (E,), the next noise, extras, and whether each action was finite (E,).
        """
        progress = state.steps.astype(float) / self.steps
        first = state.env.k == 0
        explore = jax.vmap(self.agent.explore, (None, 0, 0, 0, 0, None))
        action, noise, extras = explore(state.agent, state.noise, state.obs, normal[:, None], first, progress)
        finite = jnp.isfinite(action[:, 0])
        return jnp.where(finite, action[:, 0], 0.0), noise, extras, finite

    def step(
        self, state: TrainState, params: EnvParams, action: jax.Array, keys: chex.PRNGKey
    ) -> tuple[TrainState, Step]:
        """One step of every environment, given actions (E,) and keys (E,)."""
        before = state.env
        of_each = jax.vmap(self.policy.r_tilde, (None, 0, 0, 0, 0))
        r_tilde = of_each(state.base, before.memory, before.r, before.y_seen, action)
        obs, env, reward, terminated, truncated, info = jax.vmap(self.env.step, (0, 0, 0, None))(
            keys, before, r_tilde, params
        )
        signals = Signals(
            r=before.r,
            y=before.y_seen,
            integral=before.memory.integral,
            r_tilde=r_tilde,
            age=before.k.astype(reward.dtype),
            r_next=info["r"],
            y_next=info["y"],
        )
        state = state._replace(env=env, obs=obs, steps=state.steps + self.total)
        scaled = reward * self.reward_scale
        outputs = before.held.astype(reward.dtype), before.y, info["y_true"]
        ended = terminated, truncated, reward, info["final_observation"]
        return state, Step(signals, action, *outputs, scaled, *ended)

    def expectations(self, key: chex.PRNGKey, state: TrainState, params: EnvParams) -> dict[str, jax.Array]:
        """Expected and actual return of fresh training episodes.

        Returns:
            q_start, return_start: means over episodes, discounted, in the learner's scale, without exploration;
            return_start is bootstrapped at the time limit.
        """
        expected, came = jax.vmap(self._episode, (0, None, None))(jax.random.split(key, EPISODES), state, params)
        return {"q_start": jnp.mean(expected), "return_start": jnp.mean(came)}

    def _episode(self, key: chex.PRNGKey, state: TrainState, params: EnvParams) -> tuple[jax.Array, jax.Array]:
        """The agent's value of an episode's start, and the actual discounted return."""
        gamma, actor = self.agent.data.discount, self.agent.actor(state.agent)

        def step(carry: Any, key: chex.PRNGKey) -> tuple[Any, jax.Array]:
            obs, env, weight = carry
            action = self.policy.action(actor, obs)
            obs, env, reward, terminated = step_with(self.env, self.policy, state.base, params, env, action, key)
            return (obs, env, weight * gamma * jnp.where(terminated, 0.0, 1.0)), weight * reward

        key_reset, key_run = jax.random.split(key)
        obs, env = self.env.reset(key_reset, params)
        keys = jax.random.split(key_run, self.env.plant.episode_steps)
        (last, _, weight), rewards = jax.lax.scan(step, (obs, env, jnp.ones_like(env.y)), keys)
        came = self.reward_scale * jnp.sum(rewards) + weight * self.agent.value(state.agent, last)
        return self.agent.value(state.agent, obs), came
