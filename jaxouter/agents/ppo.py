"""Proximal policy optimisation: several epochs of minibatches on the clipped surrogate objective.

Source: Schulman et al., Proximal policy optimization algorithms, 2017.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import chex
import jax
import jax.numpy as jnp
import optax

from jaxouter.agents.adam import adam, descend
from jaxouter.agents.agent import AgentConfig, Experience, OnPolicy
from jaxouter.agents.gaussian import (
    GaussianPolicy,
    Sample,
    check_on_policy,
    draw,
    initial,
    log_probability,
    mean,
    normalised,
)
from jaxouter.agents.networks import Value
from jaxouter.agents.updates import RateDecay, of_batch, scheduled, where
from jaxouter.agents.whitening import Whitened, whitened


@dataclass(frozen=True)
class PPOConfig(AgentConfig):
    """Settings of the learner."""

    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers of actor and critic."""
    actor_rate: float = 3e-4
    """Learning rate of the policy (Adam)."""
    critic_rate: float = 1e-3
    """Learning rate of the critic (Adam)."""
    rate_decay: RateDecay = "cosine"
    """Schedule of both learning rates over the training; cosine ends at zero."""
    discount: float = 0.99
    """Discount per control step."""
    gae_lambda: float = 0.95
    """Lambda of generalised advantage estimation; 1: the whole return."""
    unroll: int = 200
    """Steps of each environment between updates."""
    epochs: int = 10
    """Passes over these steps."""
    minibatches: int = 8
    """Minibatches per pass, one update each."""
    clip: float = 0.2
    """Ratios of probabilities count no further than 1 - clip and 1 + clip."""
    kl: float = 0.02
    """KL divergence from the policy that acted at which the policy rests until the next unroll; 0: never."""
    value_clip: float = 0.0
    """Largest change of a value that counts in the critic's loss; 0: any."""
    entropy: float = 0.0
    """Weight of the policy's entropy in the objective."""
    gradient_norm: float = 0.5
    """Gradients are scaled down to this norm, of policy and critic each; 0: never."""
    sigma: float = 0.1
    """Standard deviation of the action (before its tanh) at first; 1 is the largest correction."""
    hold: bool = False
    """Learn as if the set-point stayed as it is: where it moves the return ends, with the value it would have had."""
    whiten: float = 0.0
    """Learn on whitened observations; this is added, in squares, to each standard deviation. 0: on plain ones."""
    prefill: int = 0
    """Environment steps before the first update, from which observations are whitened."""

    @property
    def data(self) -> OnPolicy:
        """What the current policy has just done."""
        return OnPolicy(**{name: getattr(self, name) for name in OnPolicy.__dataclass_fields__})

    def build(self, obs_size: int, total_updates: int = 1, axis: str | None = None) -> PPO | Whitened:
        """The learner."""
        return whitened(PPO(self, obs_size, total_updates=total_updates, axis=axis), self.whiten)

    def check(self) -> None:
        """Raises ValueError if a setting is wrong; names the field, its value and what is allowed."""
        check_on_policy(self, ("clip",), ("kl", "value_clip", "entropy", "gradient_norm"))


class PPOState(NamedTuple):
    """State of the learner."""

    policy: GaussianPolicy
    critic: Any
    policy_optimiser: optax.OptState
    critic_optimiser: optax.OptState
    updates: jax.Array  # int32
    rests: jax.Array  # bool, whether the policy waits for the next unroll


@dataclass(frozen=True)
class PPO:
    """The learner for observations of size `obs_size`. Static and hashable; its state is a pytree."""

    config: PPOConfig
    obs_size: int
    action_size: int = 1
    total_updates: int = 1
    """Updates of the whole training, for the decay of the learning rates."""
    axis: str | None = None
    """Mapped axis over which gradients are averaged: each of its members updates on its part of the batch."""

    @property
    def data(self) -> OnPolicy:
        """What it learns from."""
        return self.config.data

    def _optimiser(self, rate: float) -> optax.GradientTransformation:
        config = self.config
        plain = adam(scheduled(rate, config.rate_decay, self.total_updates))
        return optax.chain(optax.clip_by_global_norm(config.gradient_norm), plain) if config.gradient_norm else plain

    def init(self, key: chex.PRNGKey) -> PPOState:
        """Random networks."""
        policy, critic = initial(self.config.hidden, self.config.sigma, self.obs_size, self.action_size, key)
        return PPOState(
            policy=policy,
            critic=critic,
            policy_optimiser=self._optimiser(self.config.actor_rate).init(cast(Any, policy)),
            critic_optimiser=self._optimiser(self.config.critic_rate).init(critic),
            updates=jnp.zeros((), jnp.int32),
            rests=jnp.zeros((), bool),
        )

    def actor(self, state: PPOState) -> Any:
        """Parameters of the actor network."""
        return state.policy.actor

    def with_actor(self, state: PPOState, actor: Any) -> PPOState:
        """The state with another actor."""
        return state._replace(policy=state.policy._replace(actor=actor))

    def noise(self, environments: int) -> tuple[()]:
        """None: each step's is drawn anew."""
        del environments
        return ()

    def explore(
        self, state: PPOState, noise: tuple[()], obs: jax.Array, normal: jax.Array, first: Any, progress: Any
    ) -> tuple[jax.Array, tuple[()], Sample]:
        """A random action; see `Agent.explore`."""
        del first, progress
        action, sample = draw(self.config.hidden, state.policy, obs, normal)
        return action, noise, sample

    def value(self, state: PPOState, obs: jax.Array) -> jax.Array:
        """V(s): obs (..., n) -> (...)."""
        return cast(jax.Array, Value(self.config.hidden).apply(state.critic, obs))

    def policy_loss(self, policy: GaussianPolicy, batch: Experience) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        """Minus the clipped surrogate and the entropy (eq. 9).

        Beside it the KL divergence from the policy that acted, nearly, and the share of ratios beyond the clip.
        """
        config = self.config
        mu = mean(config.hidden, policy, batch.obs)
        change = log_probability(batch.extras.u, mu, policy.log_sigma) - batch.extras.log_probability
        objective = jnp.mean(surrogate(change, batch.advantage, config.clip))
        beyond = jnp.abs(jnp.expm1(change)) > config.clip
        about = jnp.mean(jnp.expm1(change) - change), jnp.mean(jnp.where(beyond, 1.0, 0.0))
        return -objective - config.entropy * jnp.sum(policy.log_sigma), about

    def critic_loss(self, critic: Any, batch: Experience) -> jax.Array:
        """Mean square of the value's error."""
        clip, value = self.config.value_clip, cast(jax.Array, Value(self.config.hidden).apply(critic, batch.obs))
        error = (value - batch.value_target) ** 2
        if clip:
            before = batch.value_target - batch.advantage
            error = jnp.maximum(error, (before + jnp.clip(value - before, -clip, clip) - batch.value_target) ** 2)
        return jnp.mean(error)

    def update(self, state: PPOState, batch: Experience, key: chex.PRNGKey) -> tuple[PPOState, dict[str, Any]]:
        """One gradient step of policy and critic on a minibatch.

        Returns:
            The next state, and scalars policy_loss, critic_loss, kl (from the policy that acted), clipped (share of
            ratios beyond the clip), sigma, and skipped: 1 where a loss is not finite, and nothing is updated.
        """
        del key
        config, data = self.config, self.config.data
        critic_loss, gradient = jax.value_and_grad(self.critic_loss)(state.critic, batch)
        critic_loss, gradient, critic_finite = of_batch((critic_loss, gradient), self.axis)
        optimiser = self._optimiser(config.critic_rate)
        critic, critic_optimiser = descend(optimiser, gradient, state.critic_optimiser, state.critic)

        batch = batch._replace(advantage=normalised(batch.advantage, self.axis))
        (policy_loss, about), gradient = jax.value_and_grad(self.policy_loss, has_aux=True)(state.policy, batch)
        policy_loss, (gradient, kl, clipped), finite = of_batch((policy_loss, (gradient, *about)), self.axis)
        rests = state.rests & (state.updates % (data.epochs * data.minibatches) > 0)
        rests |= (kl > config.kl) if config.kl else False
        before, optimiser = (state.policy, state.policy_optimiser), self._optimiser(config.actor_rate)
        policy, policy_optimiser = where(rests, before, descend(optimiser, gradient, before[1], before[0]))

        finite &= critic_finite
        after = PPOState(policy, critic, policy_optimiser, critic_optimiser, state.updates, rests)
        after = where(finite, after, state)._replace(updates=state.updates + 1)
        metrics = dict(policy_loss=policy_loss, critic_loss=critic_loss, kl=kl, clipped=clipped)
        metrics = {name: jnp.where(finite, value, 0.0) for name, value in metrics.items()}
        sigma, skipped = jnp.mean(jnp.exp(after.policy.log_sigma)), jnp.where(finite, 0.0, 1.0)
        return after, metrics | dict(sigma=sigma, skipped=skipped)


def surrogate(change: jax.Array, advantage: jax.Array, clip: float) -> jax.Array:
    """min(ratio A, clip(ratio) A), with the log-probabilities' change (...); (...).

    Source: Schulman et al. 2017, eq. 7.
    """
    ratio = jnp.exp(change)
    return jnp.minimum(ratio * advantage, jnp.clip(ratio, 1.0 - clip, 1.0 + clip) * advantage)
