"""Trust region policy optimisation: one natural gradient step an unroll, as long as the KL divergence allows.

Source: Schulman et al., Trust region policy optimization, 2015, section 6 and appendix C.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import chex
import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from jaxouter.agents.adam import adam, descend
from jaxouter.agents.agent import AgentConfig, Experience, OnPolicy
from jaxouter.agents.gaussian import (
    GaussianPolicy,
    Sample,
    check_on_policy,
    divergence,
    draw,
    initial,
    log_probability,
    mean,
    normalised,
)
from jaxouter.agents.networks import Value
from jaxouter.agents.updates import RateDecay, averaged, of_batch, scheduled, where
from jaxouter.agents.whitening import Whitened, whitened


@dataclass(frozen=True)
class TRPOConfig(AgentConfig):
    """Settings of the learner."""

    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers of actor and critic."""
    critic_rate: float = 1e-3
    """Learning rate of the critic (Adam)."""
    rate_decay: RateDecay = "constant"
    """Schedule of that rate over the training; cosine ends at zero."""
    discount: float = 0.99
    """Discount per control step."""
    gae_lambda: float = 0.97
    """Lambda of generalised advantage estimation; 1: the whole return."""
    unroll: int = 200
    """Steps of each environment between steps of the policy."""
    epochs: int = 10
    """Passes of the critic over these steps."""
    minibatches: int = 8
    """Minibatches per pass, one update of the critic each."""
    kl: float = 0.01
    """Largest KL divergence of a step of the policy."""
    damping: float = 0.1
    """Multiple of the identity that is added to the Fisher matrix."""
    conjugate_gradients: int = 10
    """Steps of conjugate gradients for the natural gradient."""
    fisher_every: int = 5
    """The Fisher matrix is the mean over every so manieth step of an environment; 1: over all."""
    backtracks: int = 10
    """Largest number of halvings of a step, until the surrogate is better and the KL divergence within bounds."""
    entropy: float = 0.0
    """Weight of the policy's entropy in the objective."""
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
        """What the current policy has just done, in one batch."""
        of_all = {name: getattr(self, name) for name in OnPolicy.__dataclass_fields__}
        return OnPolicy(**{**of_all, "epochs": 1, "minibatches": 1})

    def build(self, obs_size: int, total_updates: int = 1, axis: str | None = None) -> TRPO | Whitened:
        """The learner."""
        return whitened(TRPO(self, obs_size, total_updates=total_updates, axis=axis), self.whiten)

    def check(self) -> None:
        """Raises ValueError if a setting is wrong; names the field, its value and what is allowed."""
        check_on_policy(self, ("kl", "conjugate_gradients", "fisher_every"), ("damping", "backtracks", "entropy"))


class TRPOState(NamedTuple):
    """State of the learner."""

    policy: GaussianPolicy
    critic: Any
    critic_optimiser: optax.OptState


class Search(NamedTuple):
    """State of the line search."""

    policy: Any  # flat
    share: jax.Array  # of the whole step, tried next
    tries: jax.Array  # int32
    accepted: jax.Array  # bool
    kl: jax.Array


def conjugate_gradients(product: Callable[[jax.Array], jax.Array], b: jax.Array, steps: int) -> jax.Array:
    """The solution (p,) of product(x) = b, nearly, by `steps` steps from zero."""

    def step(carry: tuple[jax.Array, ...], _: None) -> tuple[tuple[jax.Array, ...], None]:
        x, residual, direction, square = carry
        along = product(direction)
        length = square / jnp.maximum(direction @ along, 1e-20)
        x, residual = x + length * direction, residual - length * along
        after = residual @ residual
        return (x, residual, residual + after / jnp.maximum(square, 1e-20) * direction, after), None

    return jax.lax.scan(step, (jnp.zeros_like(b), b, b, b @ b), None, steps)[0][0]


@dataclass(frozen=True)
class TRPO:
    """The learner for observations of size `obs_size`. Static and hashable; its state is a pytree."""

    config: TRPOConfig
    obs_size: int
    action_size: int = 1
    total_updates: int = 1
    """Updates of the whole training, for the decay of the critic's learning rate."""
    axis: str | None = None
    """Mapped axis over which gradients are averaged: each of its members updates on its part of the batch."""

    @property
    def data(self) -> OnPolicy:
        """What it learns from."""
        return self.config.data

    @property
    def _optimiser(self) -> optax.GradientTransformation:
        config = self.config
        return adam(
            scheduled(config.critic_rate, config.rate_decay, self.total_updates * config.epochs * config.minibatches)
        )

    def init(self, key: chex.PRNGKey) -> TRPOState:
        """Random networks."""
        policy, critic = initial(self.config.hidden, self.config.sigma, self.obs_size, self.action_size, key)
        return TRPOState(policy, critic, self._optimiser.init(critic))

    def actor(self, state: TRPOState) -> Any:
        """Parameters of the actor network."""
        return state.policy.actor

    def with_actor(self, state: TRPOState, actor: Any) -> TRPOState:
        """The state with another actor."""
        return state._replace(policy=state.policy._replace(actor=actor))

    def noise(self, environments: int) -> tuple[()]:
        """None: each step's is drawn anew."""
        del environments
        return ()

    def explore(
        self, state: TRPOState, noise: tuple[()], obs: jax.Array, normal: jax.Array, first: Any, progress: Any
    ) -> tuple[jax.Array, tuple[()], Sample]:
        """A random action; see `Agent.explore`."""
        del first, progress
        action, sample = draw(self.config.hidden, state.policy, obs, normal)
        return action, noise, sample

    def value(self, state: TRPOState, obs: jax.Array) -> jax.Array:
        """V(s): obs (..., n) -> (...)."""
        return cast(jax.Array, Value(self.config.hidden).apply(state.critic, obs))

    def surrogate(self, policy: GaussianPolicy, batch: Experience) -> jax.Array:
        """Mean over the batch of the ratio of probabilities times the advantage (eq. 14), and the entropy."""
        log_ratio = log_probability(batch.extras.u, mean(self.config.hidden, policy, batch.obs), policy.log_sigma)
        ratio = jnp.exp(log_ratio - batch.extras.log_probability)
        return jnp.mean(ratio * batch.advantage) + self.config.entropy * jnp.sum(policy.log_sigma)

    def divergence(self, policy: GaussianPolicy, other: GaussianPolicy, obs: jax.Array) -> jax.Array:
        """Mean KL divergence of the other policy from `policy` over observations (B, n)."""
        mus = (mean(self.config.hidden, each, obs) for each in (policy, other))
        return jnp.mean(divergence(next(mus), policy.log_sigma, next(mus), other.log_sigma))

    def fisher_product(self, policy: GaussianPolicy, obs: jax.Array, vector: jax.Array) -> jax.Array:
        """Fisher matrix over observations (B, n), the Hessian of the divergence (appendix C.1), times a vector (p,)."""
        flat, unravel = ravel_pytree(policy)

        def gradient(flat: jax.Array) -> jax.Array:
            return jax.grad(lambda other: self.divergence(policy, unravel(other), obs))(flat)

        return averaged(jax.jvp(gradient, (flat,), (vector,))[1], self.axis)

    def update(self, state: TRPOState, batch: Experience, key: chex.PRNGKey) -> tuple[TRPOState, dict[str, Any]]:
        """One step of the policy, and as many of the critic as are configured.

        Returns:
            The next state, and scalars surrogate (its gain), kl, share (of the whole step; 0: none was better), sigma,
            critic_loss, and skipped: 1 where something is not finite, and nothing is updated.
        """
        batch = batch._replace(advantage=normalised(batch.advantage, self.axis))
        policy, search, gain = self.step(state.policy, batch)
        critic, optimiser, loss = self._critic(state, batch, key)
        finite = averaged(jnp.where(jnp.isfinite(gain) & jnp.isfinite(loss), 1.0, 0.0), self.axis) == 1.0
        after = where(finite, TRPOState(policy, critic, optimiser), state)
        metrics = dict(surrogate=gain, kl=search.kl, share=search.share, critic_loss=loss)
        metrics = {name: jnp.where(finite, value, 0.0) for name, value in metrics.items()}
        sigma, skipped = jnp.mean(jnp.exp(after.policy.log_sigma)), jnp.where(finite, 0.0, 1.0)
        return after, metrics | dict(sigma=sigma, skipped=skipped)

    def step(self, policy: GaussianPolicy, batch: Experience) -> tuple[GaussianPolicy, Search, jax.Array]:
        """The policy after a step, the line search that ended there, and the gain of the surrogate."""
        config = self.config
        begin, unravel = ravel_pytree(policy)

        def surrogate(flat: jax.Array) -> jax.Array:
            return self.surrogate(unravel(flat), batch)

        before, gradient = averaged(jax.value_and_grad(surrogate)(begin), self.axis)
        some = batch.obs[:: config.fisher_every]  # the batch is in random order

        def damped(vector: jax.Array) -> jax.Array:
            return self.fisher_product(policy, some, vector) + config.damping * vector

        direction = conjugate_gradients(damped, gradient, config.conjugate_gradients)
        whole = direction * jnp.sqrt(2.0 * config.kl / jnp.maximum(direction @ damped(direction), 1e-20))

        def attempt(search: Search) -> Search:
            flat = begin + search.share * whole
            found = surrogate(flat), self.divergence(policy, unravel(flat), batch.obs)
            after, kl = averaged(found, self.axis)
            accepted = (after > before) & (kl <= config.kl)
            share = jnp.where(accepted, search.share, 0.5 * search.share)
            return Search(where(accepted, flat, begin), share, search.tries + 1, accepted, jnp.where(accepted, kl, 0.0))

        zero = jnp.zeros_like(before)
        search = Search(begin, zero + 1.0, jnp.zeros((), jnp.int32), jnp.zeros((), bool), zero)
        search = jax.lax.while_loop(lambda s: ~s.accepted & (s.tries <= config.backtracks), attempt, search)
        search = search._replace(share=jnp.where(search.accepted, search.share, 0.0))
        return unravel(search.policy), search, averaged(surrogate(search.policy), self.axis) - before

    def _critic(self, state: TRPOState, batch: Experience, key: chex.PRNGKey) -> tuple[Any, Any, jax.Array]:
        """Critic and optimiser after its updates, and their mean loss."""
        config, size = self.config, len(batch.obs)

        def update(carry: tuple[Any, Any], rows: jax.Array) -> tuple[tuple[Any, Any], jax.Array]:
            def loss(critic: Any) -> jax.Array:
                value = self.value(state._replace(critic=critic), batch.obs[rows])
                return jnp.mean((value - batch.value_target[rows]) ** 2)

            found, gradient, _ = of_batch(jax.value_and_grad(loss)(carry[0]), self.axis)
            return descend(self._optimiser, gradient, carry[1], carry[0]), found

        keys = jax.random.split(key, config.epochs)
        rows = jax.vmap(lambda key: jax.random.permutation(key, size))(keys)
        rows = rows.reshape(config.epochs * config.minibatches, -1)
        (critic, optimiser), losses = jax.lax.scan(update, (state.critic, state.critic_optimiser), rows)
        return critic, optimiser, jnp.mean(losses)
