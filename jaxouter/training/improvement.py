"""Rounds of improvement by pairs: branch the environments, learn what changes gain, keep what is better."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax

from jaxouter.agents import Agent
from jaxouter.agents.noise import ornstein_uhlenbeck
from jaxouter.agents.pairs import SHARES, Pairs, PairsLearner, PairsState
from jaxouter.loop.bank import BaseLaw
from jaxouter.loop.environment import Environment, EnvParams, EnvState
from jaxouter.loop.references import Still
from jaxouter.training.environments import step_with
from jaxouter.training.gate import Comparison, compare
from jaxouter.training.policy import LearnedPolicy

GROWTH, CUT, LEAST = 1.3, 1 / 1.5, 1 / 32  # of the rate, where all of it is kept or not
THETA = 0.15  # of the exploration


@dataclass(frozen=True)
class Improvement:
    """Rounds of improvement of an actor, whichever agent learned it. Static and hashable."""

    env: Environment
    policy: LearnedPolicy
    agent: Agent
    learner: PairsLearner
    reward_scale: float
    compared: int
    """Episodes on which actors are compared."""

    def init(self, key: chex.PRNGKey, actor: Any) -> PairsState:
        """State before the first round."""
        return self.learner.init(key, actor)

    def round(
        self, state: PairsState, actor: Any, base: BaseLaw, params: EnvParams, key: chex.PRNGKey
    ) -> tuple[PairsState, Any, dict[str, jax.Array]]:
        """One round.

        Returns:
            The state, the actor that is kept, and metrics: pairs_loss of the critic; share of the new actor that was
            kept (0: none); gain in reward per step of the best candidate, its standard error, and the least gain of a
            stratum, in standard errors.
        """
        key_pairs, key_learn, key_gate = jax.random.split(key, 3)
        state = self.learner.add(state, self.pairs(actor, base, params, key_pairs))
        state, new, metrics = self.learner.learn(state, actor, key_learn)
        shares = jnp.asarray(SHARES, float)
        candidates = jax.vmap(lambda share: optax.incremental_update(new, actor, share))(shares)
        found = compare(self.env, self.policy, actor, candidates, base, params, key_gate, self.compared)
        best = jnp.argmax(jnp.where(found.better, found.gain, -jnp.inf))
        kept = jnp.any(found.better)
        actor = jax.tree.map(lambda old, new: jnp.where(kept, new[best], old), actor, candidates)
        rate = jnp.where(found.better[0], jnp.minimum(1.0, GROWTH * state.rate), jnp.maximum(LEAST, CUT * state.rate))
        best_of_all = jax.tree.map(lambda leaf: leaf[best], found)
        metrics |= {"kept": jnp.where(kept, shares[best], 0.0), "rate": state.rate}
        return state._replace(rate=rate), actor, metrics | Comparison(*best_of_all)._asdict()

    def better(
        self, before: Any, actor: Any, base: BaseLaw, params: EnvParams, key: chex.PRNGKey, errors: chex.Numeric
    ) -> tuple[Any, dict[str, jax.Array]]:
        """The actor if its gain over the one before is above so many standard errors, else the one before.

        Returns:
            That actor, and metrics: kept (1 or 0); gain, error and worst, as for a round.
        """
        one = jax.tree.map(lambda leaf: leaf[None], actor)
        found = compare(self.env, self.policy, before, one, base, params, key, self.compared)
        found = Comparison(*(leaf[0] for leaf in found))
        kept = found.gain > errors * found.error
        actor = jax.tree.map(lambda new, old: jnp.where(kept, new, old), actor, before)
        return actor, {"kept": jnp.where(kept, 1.0, 0.0), **found._asdict()}

    def pairs(self, actor: Any, base: BaseLaw, params: EnvParams, key: chex.PRNGKey) -> Pairs:
        """Pairs at random states of episodes with exploration."""
        config, env = self.learner.config, self.env
        key_run, key_pick, key_size, key_sign, key_pairs = jax.random.split(key, 5)
        sigma = jnp.geomspace(*config.noise_sigma, config.environments)
        keys = jax.random.split(key_run, config.environments)
        visited = jax.vmap(lambda sigma, key: self._visit(actor, base, params, sigma, key))(sigma, keys)
        flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), visited)
        picked = jax.random.randint(key_pick, (config.states,), 0, config.environments * env.plant.episode_steps)
        states, alive = jax.tree.map(lambda leaf: leaf[picked], flat)
        size = config.change * jax.random.uniform(key_size, (config.states,), float, 0.2, 1.0)
        change = jnp.where(alive, size * jax.random.rademacher(key_sign, (config.states,), float), 0.0)
        keys = jax.random.split(key_pairs, config.states)
        return jax.vmap(lambda *given: self.pair(actor, base, params, *given))(states, change, keys)

    def pair(
        self, actor: Any, base: BaseLaw, params: EnvParams, state: EnvState, change: jax.Array, key: chex.PRNGKey
    ) -> Pairs:
        """The pair of a state: r is held, and all but the first action's change is equal."""
        env, gamma = replace(self.env, goal=Still()), self.agent.data.discount
        obs = env.observer.features(state.memory, state.r, state.y_seen)
        keys = jax.random.split(key, self.learner.config.horizon)

        def come(change: jax.Array) -> jax.Array:
            def step(carry: Any, key: chex.PRNGKey) -> tuple[Any, jax.Array]:
                obs, state, change, weight = carry
                action = self.policy.action(actor, obs) + change
                obs, state, reward, terminated = step_with(env, self.policy, base, params, state, action, key)
                after = weight * gamma * jnp.where(terminated, 0.0, 1.0)
                return (obs, state, jnp.zeros_like(change), after), weight * reward

            begin = obs, state._replace(goal=state.r), change, jnp.ones_like(change)
            return self.reward_scale * jnp.sum(jax.lax.scan(step, begin, keys)[1])

        with_change, without = jax.vmap(come)(jnp.stack([change, jnp.zeros_like(change)]))
        return Pairs(obs, self.policy.action(actor, obs), change, with_change - without)

    def _visit(
        self, actor: Any, base: BaseLaw, params: EnvParams, sigma: jax.Array, key: chex.PRNGKey
    ) -> tuple[EnvState, jax.Array]:
        """The states of an episode with exploration, and whether y had not diverged before; (T, ...)."""
        key_reset, key_noise, key_run = jax.random.split(key, 3)
        obs, state = self.env.reset(key_reset, params)
        steps = self.env.plant.episode_steps

        def step(carry: Any, xs: Any) -> tuple[Any, Any]:
            obs, state, noise, alive = carry
            normal, key = xs
            noise = ornstein_uhlenbeck(noise, normal, THETA, sigma)
            action = jnp.clip(self.policy.action(actor, obs) + noise, -1.0, 1.0)
            obs, after, _, terminated = step_with(self.env, self.policy, base, params, state, action, key)
            return (obs, after, noise, alive & ~terminated), (state._replace(goal=()), alive)

        begin = obs, state, jnp.zeros(()), jnp.ones((), bool)
        xs = jax.random.normal(key_noise, (steps,), float), jax.random.split(key_run, steps)
        return jax.lax.scan(step, begin, xs)[1]
