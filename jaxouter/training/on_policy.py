"""Driver for on-policy learners: roll out the current policy, update from the experience, discard it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import chex
import jax
import jax.numpy as jnp

from jaxouter.agents.agent import Agent, Experience, OnPolicy
from jaxouter.agents.returns import generalised_advantage
from jaxouter.agents.whitening import prepared
from jaxouter.loop.environment import EnvParams
from jaxouter.training.environments import AXIS, Environments, Step, TrainState
from jaxouter.training.off_policy import step_metrics


@dataclass(frozen=True)
class OnPolicyDriver:
    """The pure functions of an on-policy training, or of one shard of it. Static and hashable."""

    environments: Environments
    agent: Agent
    data: OnPolicy

    def fresh(self, key: chex.PRNGKey, params: EnvParams) -> TrainState:
        """State before the first epoch."""
        return self.environments.fresh(key, params, ())

    @staticmethod
    def layout(seed: Any, environment: Any) -> tuple[()]:
        """There is no data between epochs."""
        del seed, environment
        return ()

    def batch_of(self, state: TrainState, params: EnvParams) -> Experience:
        """Shapes of the batch of an update."""
        del params
        every, size = self.environments, self.data.unroll * self.environments.count // self.data.minibatches
        normal = jax.ShapeDtypeStruct((every.count,), state.obs.dtype)
        _, _, extras, _ = jax.eval_shape(every.explore, state, normal)

        def of(leaf: Any) -> Any:
            return jax.ShapeDtypeStruct((size, *leaf.shape[1:]), leaf.dtype)

        scalar, action = of(normal), cast(Any, jax.ShapeDtypeStruct((size, 1), normal.dtype))
        return Experience(of(state.obs), action, jax.tree.map(of, extras), scalar, scalar)

    def prefill(self, state: TrainState, params: EnvParams) -> TrainState:
        """Explore without learning, for the observations alone."""
        steps = self.data.prefill // self.environments.total
        if not steps:
            return state
        state, (obs, *_) = self._explore(state, params, *self.environments.keys(state, steps, 2))
        return state._replace(agent=prepared(self.agent, state.agent, obs))

    def epoch(self, state: TrainState, params: EnvParams, steps: int) -> tuple[TrainState, dict[str, jax.Array]]:
        """Explore and learn for `steps` environment steps (over all environments of all shards), in whole unrolls.

        Returns:
            The state, and means over the epoch as in `OffPolicyDriver.epoch`.
        """

        def iteration(state: TrainState, _: None) -> tuple[TrainState, dict[str, jax.Array]]:
            return self._iteration(state, params)

        state, metrics = jax.lax.scan(iteration, state, None, steps // (self.data.unroll * self.environments.total))
        metrics = jax.tree.map(jnp.mean, metrics)
        return state, metrics if self.environments.shards == 1 else jax.lax.pmean(metrics, AXIS)

    def _explore(
        self, state: TrainState, params: EnvParams, keys_noise: chex.PRNGKey, keys_env: chex.PRNGKey
    ) -> tuple[TrainState, tuple[jax.Array, Any, Step, dict[str, jax.Array]]]:
        """Steps of every environment: the state; observations, extras, steps and metrics, each (steps, ...)."""
        every = self.environments

        def step(state: TrainState, xs: tuple[jax.Array, chex.PRNGKey]) -> tuple[TrainState, Any]:
            obs = state.obs
            action, noise, extras, finite = every.explore(state, xs[0])
            state, taken = every.step(state, params, action, xs[1])
            return state._replace(noise=noise), (obs, extras, taken, step_metrics(taken, finite))

        return jax.lax.scan(step, state, (every.normals(keys_noise), every.each(keys_env)))

    def _iteration(self, state: TrainState, params: EnvParams) -> tuple[TrainState, dict[str, jax.Array]]:
        """One unroll, and the updates from it."""
        every, data = self.environments, self.data
        *keys, keys_update = every.keys(state, data.unroll, 3)
        state, (obs, extras, taken, metrics) = self._explore(state, params, *keys)
        final_obs, ended = taken.final_obs, taken.terminated | taken.truncated
        if data.hold:
            moved = taken.signals.r_next - taken.signals.r
            final_obs, ended = every.env.observer.had_r_been(final_obs, -moved), ended | (moved != 0.0)
        value, next_value = (self.agent.value(state.agent, each) for each in (obs, final_obs))
        advantage = jax.vmap(partial(generalised_advantage, discount=data.discount, gae_lambda=data.gae_lambda), 1, 1)(
            taken.reward, value, next_value, taken.terminated, ended
        )
        experience = Experience(obs, taken.action[..., None], extras, advantage, advantage + value)
        flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), experience)
        size = data.unroll * every.count

        def update(learned: Any, xs: tuple[jax.Array, chex.PRNGKey]) -> tuple[Any, dict[str, jax.Array]]:
            rows, key = xs
            return self.agent.update(learned, jax.tree.map(lambda leaf: leaf[rows], flat), key)

        def one_pass(learned: Any, key: chex.PRNGKey) -> tuple[Any, dict[str, jax.Array]]:
            key_order, key_update = jax.random.split(key)
            order = jax.random.permutation(key_order, size).reshape(data.minibatches, -1)
            return jax.lax.scan(update, learned, (order, jax.random.split(key_update, data.minibatches)))

        learned, of_updates = jax.lax.scan(one_pass, state.agent, jax.random.split(keys_update[0], data.epochs))
        return state._replace(agent=learned), jax.tree.map(jnp.mean, {**of_updates, **metrics})

    def diagnose(self, state: TrainState, params: EnvParams, key: chex.PRNGKey) -> dict[str, jax.Array]:
        """`Environments.expectations`, from the state of all shards, which is not changed."""
        return self.environments.expectations(key, state, params)
