"""REINFORCE (Williams 1992), the smallest on-policy learner: its state is its actor."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from jaxouter.agents import AgentConfig, OnPolicy
from jaxouter.agents.networks import Actor, act


@dataclass(frozen=True)
class Reinforce(AgentConfig):
    hidden: tuple[int, ...] = (16,)
    rate: float = 0.02
    sigma: float = 0.1
    unroll: int = 20
    data = property(lambda self: OnPolicy(self.unroll, epochs=1, minibatches=1, discount=0.9, gae_lambda=1.0))

    def build(self, obs_size, total_updates=1, axis=None):
        return Learner(self, obs_size, axis)


@dataclass(frozen=True)
class Learner:
    config: Reinforce
    obs_size: int
    axis: str | None
    data = property(lambda self: self.config.data)

    def init(self, key):
        return Actor(self.config.hidden, 1).init(key, jnp.zeros(self.obs_size))

    def actor(self, state):
        return state

    def with_actor(self, state, actor):
        return actor

    def noise(self, environments):
        return ()

    def explore(self, state, noise, obs, normal, first, progress):
        sample = act(self.config.hidden, state, obs) + self.config.sigma * normal
        return jnp.clip(sample, -1.0, 1.0), noise, sample

    def update(self, state, batch, key):
        def loss(actor):  # minus the log-probability of what was drawn, weighted by its advantage over the mean
            scaled = (batch.extras - act(self.config.hidden, actor, batch.obs)) / self.config.sigma
            return jnp.mean(0.5 * jnp.sum(scaled**2, -1) * (batch.advantage - jnp.mean(batch.advantage)))

        value, gradient = jax.value_and_grad(loss)(state)
        gradient = gradient if self.axis is None else jax.lax.pmean(gradient, self.axis)
        return jax.tree.map(lambda p, g: p - self.config.rate * g, state, gradient), {"loss": value}

    def value(self, state, obs):
        return jnp.zeros(obs.shape[:-1])
