"""Driver for off-policy learners: prefill, then epochs of roll-outs and updates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxouter.agents.agent import OffPolicy, OffPolicyAgent, Transitions
from jaxouter.agents.replay import Replay, ReplayState
from jaxouter.agents.returns import n_step_return
from jaxouter.agents.whitening import prepared
from jaxouter.loop import rewards
from jaxouter.loop.bank import BaseLaw
from jaxouter.loop.environment import EnvParams
from jaxouter.loop.observation import Signals
from jaxouter.loop.policy import LinearLaw
from jaxouter.loop.rewards import RewardParams
from jaxouter.plants import Plant
from jaxouter.training.environments import AXIS, Environments, Step, TrainState
from jaxouter.training.policy import LearnedPolicy

FIELDS = (*Signals._fields, "action", "reward", "terminated", "truncated", "held", "y_true", "y_true_next")
MOVED = 0.02  # share of the set-point range by which r moves at least where a window ends
HOLD = 0.1  # probability per step that the random action of the prefill is redrawn


@dataclass(frozen=True)
class Windows:
    """Builds transitions from windows of a replay. Static and hashable."""

    replay: Replay
    data: OffPolicy  # with the batch size of one shard
    policy: LearnedPolicy
    plant: Plant
    reward_scale: float

    def batch(self, replay: ReplayState, base: BaseLaw, price: RewardParams, bits: jax.Array) -> Transitions:
        """Transitions chosen by random bits (B, `data.bits`), uint32; `base` and `price` serve those that are held."""
        windows, _ = self.replay.sample(replay, bits)
        return jax.vmap(lambda rows, bits: self._transition(rows, bits, base, price))(windows, bits)

    def _transition(self, rows: jax.Array, bits: jax.Array, base: BaseLaw, price: RewardParams) -> Transitions:
        assert isinstance(base, LinearLaw)  # a bank is for pretraining alone
        field = dict(zip(FIELDS, rows.T, strict=True))
        first, observer = self.replay.lead, self.policy.observer
        window = Signals(*(field[name] for name in Signals._fields))
        reward, action = field["reward"][first:], field["action"][first]
        terminated, cut = field["terminated"][first:] > 0, field["truncated"][first:] > 0
        if self.data.hold:
            r = self._set_point(window.r[first], bits)
            action = action - base.r * (r - window.r[first]) / self.policy.scale
            cut |= jnp.abs(window.r_next[first:] - r) > MOVED * np.ptp(self.plant.setpoint_range)
            reward = self._rewards(field, r, price)
            window = observer.held(window, first, r)
        total, bootstrap, used = n_step_return(reward, terminated, cut, self.data.discount)
        obs, next_obs = observer.before_and_after(window, first, first + used)
        return Transitions(obs, action[None], total, bootstrap, next_obs)

    def _set_point(self, r: jax.Array, bits: jax.Array) -> jax.Array:
        """The set-point of a transition: r, or another one."""
        if not self.data.relabel:
            return r
        low, high = self.plant.setpoint_range
        chance, share = bits[2:].astype(r.dtype) / 2.0**32
        return jnp.where(chance < self.data.relabel, low + share * (high - low), r)

    def _rewards(self, field: dict[str, jax.Array], r: jax.Array, price: RewardParams) -> jax.Array:
        """Rewards of the window's steps, as if the set-point had stayed r."""
        first, plant = self.replay.lead, self.plant
        y, y_next, r_tilde = (field[name][first:] for name in ("y_true", "y_true_next", "r_tilde"))
        begins = field["age"][first:] == 0
        before = jnp.where(begins, jnp.clip(y, *plant.r_tilde_bounds), field["r_tilde"][first - 1 : -1])
        held = field["held"][first] + jnp.arange(len(y), dtype=y.dtype)

        def reward(*of_step: jax.Array) -> jax.Array:
            y_next, y, r_tilde, before, held = of_step
            return rewards.reward(price, r, y_next, y, r_tilde, before, plant.reward_terms, held)

        found = jax.vmap(reward)(y_next, y, r_tilde, before, held)
        return self.reward_scale * (found + jnp.where(field["terminated"][first:] > 0, price.divergence, 0.0))


@dataclass(frozen=True)
class OffPolicyDriver:
    """The pure functions of a training from a replay, or of one shard of it. Static and hashable."""

    environments: Environments
    agent: OffPolicyAgent
    windows: Windows  # of one shard

    @property
    def data(self) -> OffPolicy:
        """What is learned from, with the batch size of one shard."""
        return self.windows.data

    @property
    def replay(self) -> Replay:
        """The layout of the replay of one shard."""
        return self.windows.replay

    def fresh(self, key: chex.PRNGKey, params: EnvParams) -> TrainState:
        """State before the prefill, with an empty replay."""
        return self.environments.fresh(key, params, self.replay.init())

    @staticmethod
    def layout(seed: Any, environment: Any) -> ReplayState:
        """The mesh axes of each part of the replay."""
        return ReplayState(rows=environment, written=seed)

    @staticmethod
    def row(step: Step) -> jax.Array:
        """Rows (E, width) of the replay."""
        flags = [flag.astype(step.reward.dtype) for flag in (step.terminated, step.truncated)]
        return jnp.stack([*step.signals, step.action, step.reward, *flags, step.held, step.y, step.y_next], -1)

    def batch_of(self, state: TrainState, params: EnvParams) -> Transitions:
        """Shapes of the batch of an update."""
        bits = jax.ShapeDtypeStruct((self.data.batch_size, self.data.bits), jnp.uint32)
        return jax.eval_shape(self.batch, state, params, bits)

    def batch(self, state: TrainState, params: EnvParams, bits: jax.Array) -> Transitions:
        """A batch of transitions built from windows of signals, chosen by random bits (B, `data.bits`), uint32."""
        return self.windows.batch(state.data, state.base, params.reward, bits)

    def prefill(self, state: TrainState, params: EnvParams) -> TrainState:
        """Fill the replay with random actions, each held for ten steps on average."""
        every = self.environments
        steps = self.data.prefill // every.total
        keys_redraw, keys_action, keys_env = every.keys(state, steps, 3)
        redraw = jax.vmap(lambda key: jax.random.uniform(key, (every.count,), float) < HOLD)(keys_redraw)
        fresh = jax.vmap(lambda key: jax.random.uniform(key, (every.count,), float, -1.0, 1.0))(keys_action)
        held = jax.lax.cummax(jnp.where(redraw, jnp.arange(steps)[:, None], 0))  # the step of the last redraw
        actions = jnp.take_along_axis(fresh, held, 0)

        def step(state: TrainState, xs: tuple[jax.Array, chex.PRNGKey]) -> tuple[TrainState, jax.Array]:
            after, taken = every.step(state, params, *xs)
            return after._replace(data=self.replay.write(after.data, self.row(taken))), state.obs

        state, obs = jax.lax.scan(step, state, (actions, every.each(keys_env)))
        return state._replace(agent=prepared(self.agent, state.agent, obs))

    def epoch(self, state: TrainState, params: EnvParams, steps: int) -> tuple[TrainState, dict[str, jax.Array]]:
        """Explore and learn for `steps` environment steps (over all environments of all shards).

        The updates of a step draw from the rows of all steps except the current and the previous one. The replay must
        hold more than one step.

        Returns:
            The state, and means over the epoch: the agent's metrics, `reward` (per step, with exploration), `diverged`
            (share of steps at which y diverged) and `no_action` (share of actions that were not finite and became
            zero).
        """
        every, data = self.environments, self.data
        keys_noise, keys_env, keys_batch, keys_update = every.keys(state, steps // every.total, 4)
        shape = (data.updates, data.batch_size, data.bits)
        bits = jax.vmap(lambda key: jax.random.bits(key, shape, jnp.uint32))(keys_batch)
        gathered = jax.vmap(lambda replay, bits: self.windows.batch(replay, state.base, params.reward, bits), (None, 0))
        xs = (
            every.normals(keys_noise),
            every.each(keys_env),
            jnp.roll(bits, -1, 0),  # of the next step
            jax.vmap(lambda key: jax.random.split(key, data.updates))(keys_update),
        )

        # Writing a step's rows is delayed to the next step, and batches are gathered one step ahead. So environments,
        # updates and batches do not depend on each other within a step, and run at the same time.
        def step(carry: tuple[TrainState, jax.Array, Transitions], xs: Any) -> tuple[Any, dict[str, jax.Array]]:
            state, rows, batches = carry
            normal, keys_env, bits, keys_update = xs
            learned, replay = state.agent, self.replay.write(state.data, rows)
            action, noise, _, finite = every.explore(state, normal)
            state, taken = every.step(state, params, action, keys_env)

            def update(learned: Any, xs: tuple[Transitions, chex.PRNGKey]) -> tuple[Any, Any]:
                return self.agent.update(learned, *xs)

            learned, metrics = jax.lax.scan(update, learned, (batches, keys_update))
            state = state._replace(agent=learned, data=replay, noise=noise)
            metrics = {**jax.tree.map(jnp.mean, metrics), **step_metrics(taken, finite)}
            return (state, self.row(taken), gathered(replay, bits)), metrics

        replay, rows = self.replay.take_back(state.data)
        carry = state._replace(data=replay), rows, gathered(replay, bits[0])
        (state, rows, _), metrics = jax.lax.scan(step, carry, xs)
        state = state._replace(data=self.replay.write(state.data, rows))
        metrics = jax.tree.map(jnp.mean, metrics)
        return state, metrics if every.shards == 1 else jax.lax.pmean(metrics, AXIS)

    def diagnose(self, state: TrainState, params: EnvParams, key: chex.PRNGKey) -> dict[str, jax.Array]:
        """Diagnostics of the learning, from the state of all shards, which is not changed.

        Returns:
            The agent's diagnostics on one batch; replay_age: mean age of sampled transitions, in environment steps;
            and `Environments.expectations`.
        """
        key_batch, key_update, key_run = jax.random.split(key, 3)
        bits = jax.random.bits(key_batch, (self.data.batch_size, self.data.bits), jnp.uint32)
        found = self.agent.diagnose(state.agent, self.batch(state, params, bits), key_update)
        expected = self.environments.expectations(key_run, state, params)
        rows = jnp.minimum(state.data.written, self.replay.steps).astype(expected["q_start"].dtype)
        return found | {"replay_age": self.environments.count * (rows - 1.0) / 2.0} | expected


def step_metrics(taken: Step, finite: jax.Array) -> dict[str, jax.Array]:
    """Means over the environments of reward, divergence and non-finite actions."""
    return {
        "reward": jnp.mean(taken.plant_reward),
        "diverged": jnp.mean(jnp.where(taken.terminated, 1.0, 0.0)),
        "no_action": jnp.mean(jnp.where(finite, 0.0, 1.0)),
    }
