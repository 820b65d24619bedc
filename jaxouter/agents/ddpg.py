"""Deep deterministic policy gradient in functional style; TD3's three tricks are settings of the same learner.

Small functions take one transition; `update` vmaps them over a batch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, cast

import chex
import jax
import jax.numpy as jnp
import optax

from jaxouter.agents.adam import adam, descend
from jaxouter.agents.agent import AgentConfig, OffPolicy, Transitions
from jaxouter.agents.networks import Actor, Critic, QuadraticCritic
from jaxouter.agents.noise import ornstein_uhlenbeck
from jaxouter.agents.updates import RateDecay, of_batch, scheduled, where
from jaxouter.agents.whitening import Whitened, whitened


@dataclass(frozen=True)
class DDPGConfig(AgentConfig):
    """Settings of the learner; defaults are the paper's, or Lillicrap's where the paper gives none."""

    hidden: tuple[int, ...] = (400, 300)
    """Widths of the hidden layers of actor and critic; at least two."""
    critic: Literal["mlp", "quadratic"] = "mlp"
    """mlp: the action enters the critic at its second layer; quadratic: Q is concave in the action, see `networks`."""
    layer_norm: bool = False
    """LayerNorm in the critic mlp, before each ReLU."""
    actor_rate: float = 1e-4
    """Learning rate of the actor (Adam)."""
    critic_rate: float = 1e-3
    """Learning rate of the critic (Adam)."""
    rate_decay: RateDecay = "constant"
    """Schedule of both learning rates over the training; cosine ends at zero."""
    critic_l2: float = 1e-2
    """L2 penalty on the critic's weights: half this times their squared norm is added to the loss."""
    batch_size: int = 64
    """Transitions per update."""
    discount: float = 0.99
    """Discount per control step (the paper's gamma)."""
    polyak: float = 0.001
    """Step of the target networks towards the networks at each update (the paper's tau)."""
    n_step: int = 1
    """Steps of the return before bootstrapping."""
    saturation_penalty: float = 0.0
    """Penalty on the mean square of the actor's output before its tanh, to avoid saturation."""
    critics: Literal[1, 2] = 1
    """TD3: with two critics, the target takes the smaller value."""
    policy_delay: int = 1
    """TD3: critic updates per update of the actor and the targets."""
    actor_from: int = 0
    """Updates of the critic alone before the actor's first: an untrained critic would spoil a good actor."""
    target_noise: float = 0.0
    """TD3: standard deviation of the noise on the target action."""
    target_noise_clip: float = 0.5
    """TD3: bound on that noise."""
    updates: int = 1
    """Updates after each step of all environments; updates / environments is the update-to-data ratio."""
    prefill: int = 1_000
    """Environment steps with random actions, each held for a while, before the first update."""
    replay: int = 1_000_000
    """Environment steps the replay holds."""
    hold: bool = False
    """Learn as if the set-point stayed as it is. Its next value can't be known, and in the target of the critic it is
    but noise. An n-step return then ends where the set-point moves."""
    relabel: float = 0.0
    """Share of transitions that get another set-point, uniform in the plant's range; needs --agent.hold."""
    whiten: float = 0.0
    """Learn on whitened observations, as consecutive samples of y differ little; this is added, in squares, to each
    standard deviation, for the sake of noise. 0: on plain ones."""
    noise_theta: float = 0.15
    """Mean reversion rate of the Ornstein-Uhlenbeck exploration noise; 1 is white noise."""
    noise_sigma: tuple[float, float] = (0.2, 0.2)
    """Volatility of that noise in the first and the last environment, geometric in between; 1 is half the r~ range."""
    noise_end: float = 1.0
    """Factor on the volatility at the end of the training; it changes linearly from 1."""

    @property
    def data(self) -> OffPolicy:
        """Transitions from a replay."""
        return OffPolicy(**{name: getattr(self, name) for name in OffPolicy.__dataclass_fields__})

    def build(self, obs_size: int, total_updates: int = 1, axis: str | None = None) -> DDPG | Whitened:
        """The learner."""
        return whitened(DDPG(self, obs_size, total_updates=total_updates, axis=axis), self.whiten)

    def check(self) -> None:
        """Raises ValueError if a setting is wrong; names the field, its value and what is allowed."""
        positive = ("actor_rate", "critic_rate", "batch_size", "n_step", "policy_delay", "updates")
        not_negative = ("critic_l2", "saturation_penalty", "actor_from", "target_noise", "target_noise_clip", "whiten")
        for field in positive:
            if not getattr(self, field) > 0:
                raise ValueError(f"agent.{field} is {getattr(self, field)}; it must be positive")
        for field in not_negative:
            if not getattr(self, field) >= 0:
                raise ValueError(f"agent.{field} is {getattr(self, field)}; it must not be negative")
        if not 0 <= self.discount < 1:
            raise ValueError(f"agent.discount is {self.discount}; it must lie in [0, 1)")
        for field in ("polyak", "noise_theta"):
            if not 0 < getattr(self, field) <= 1:
                raise ValueError(f"agent.{field} is {getattr(self, field)}; it must lie in (0, 1]")
        if self.critic not in ("mlp", "quadratic") or (self.critic == "quadratic" and self.layer_norm):
            raise ValueError(
                f"agent.critic is {self.critic!r} and agent.layer_norm is {self.layer_norm}; the critic must be mlp, "
                "or quadratic without layer_norm"
            )
        if not 0 <= self.relabel <= 1 or (self.relabel and not self.hold):
            raise ValueError(
                f"agent.relabel is {self.relabel} and agent.hold is {self.hold}; relabel must lie in [0, 1], and be 0 "
                "without hold"
            )
        if self.critics not in (1, 2) or self.rate_decay not in ("constant", "cosine"):
            raise ValueError(
                f"agent.critics is {self.critics} and agent.rate_decay is {self.rate_decay!r}; "
                "they must be 1 or 2, and constant or cosine"
            )
        if min(self.noise_sigma) <= 0 or self.noise_end < 0:
            raise ValueError(
                f"agent.noise_sigma is {self.noise_sigma} and agent.noise_end is {self.noise_end}; "
                "they must be positive and not negative"
            )
        if len(self.hidden) < 2 or min(self.hidden) < 1:
            raise ValueError(f"agent.hidden is {self.hidden}; it must be at least two positive widths")


@dataclass(frozen=True)
class TD3Config(DDPGConfig):
    """Settings of DDPG with TD3's three tricks on.

    Source: Fujimoto et al., Addressing function approximation error in actor-critic methods, 2018.
    """

    critics: Literal[1, 2] = 2
    """With two critics, the target takes the smaller value."""
    policy_delay: int = 2
    """Critic updates per update of the actor and the targets."""
    target_noise: float = 0.2
    """Standard deviation of the noise on the target action."""


class Noise(NamedTuple):
    """State of the exploration noise, of one environment or of all."""

    x: jax.Array  # Ornstein-Uhlenbeck process
    sigma: jax.Array  # its volatility at the start of the training


class DDPGState(NamedTuple):
    """State of the learner."""

    actor: Any
    critics: tuple[Any, ...]
    target_actor: Any
    target_critics: tuple[Any, ...]
    actor_optimiser: optax.OptState
    critic_optimiser: optax.OptState
    updates: jax.Array  # int32


def td_target(reward: jax.Array, discount: jax.Array, next_q: jax.Array) -> jax.Array:
    """G = R + discount Q'(s', mu'(s')), with the smallest value of the target critics (paper eq. 4).

    Args:
        reward, discount: scalars; the discount is 0 where terminated.
        next_q: (critics,).
    """
    return reward + discount * jnp.min(next_q)


@dataclass(frozen=True)
class DDPG:
    """The learner for observations of size `obs_size`. Static and hashable; its state is a pytree."""

    config: DDPGConfig
    obs_size: int
    action_size: int = 1
    total_updates: int = 1
    """Updates of the whole training, for the decay of the learning rates."""
    axis: str | None = None
    """Mapped axis over which gradients are averaged: each of its members updates on its part of the batch."""

    @property
    def data(self) -> OffPolicy:
        """What it learns from."""
        return self.config.data

    @property
    def network(self) -> Actor:
        """The actor network."""
        return Actor(self.config.hidden, self.action_size)

    @property
    def critic(self) -> Critic | QuadraticCritic:
        """The critic network."""
        hidden = self.config.hidden
        return QuadraticCritic(hidden) if self.config.critic == "quadratic" else Critic(hidden, self.config.layer_norm)

    def _rate(self, rate: float) -> float | optax.Schedule:
        return scheduled(rate, self.config.rate_decay, self.total_updates)

    @property
    def actor_optimiser(self) -> optax.GradientTransformation:
        """Adam."""
        rate, first = self._rate(self.config.actor_rate), self.config.actor_from
        if first == 0:
            return adam(rate)
        return adam(lambda steps: jnp.where(jnp.asarray(steps) < first, 0.0, rate(steps) if callable(rate) else rate))

    @property
    def critic_optimiser(self) -> optax.GradientTransformation:
        """Adam on the gradient of loss plus L2 penalty; biases are not penalised."""
        plain = adam(self._rate(self.config.critic_rate))
        if self.config.critic_l2 == 0:
            return plain

        def kernels(params: Any) -> Any:
            return jax.tree.map(lambda leaf: leaf.ndim > 1, params)

        return optax.chain(optax.add_decayed_weights(self.config.critic_l2, kernels), plain)

    def init(self, key: chex.PRNGKey) -> DDPGState:
        """Random networks, and targets equal to them."""
        key_actor, *key_critics = jax.random.split(key, 1 + self.config.critics)
        obs, action = jnp.zeros(self.obs_size), jnp.zeros(self.action_size)
        actor = self.network.init(key_actor, obs)
        critics = tuple(self.critic.init(k, obs, action) for k in key_critics)
        return self._begin(actor, critics)

    def _begin(self, actor: Any, critics: tuple[Any, ...]) -> DDPGState:
        """These networks, with fresh targets, optimisers and counters."""
        return DDPGState(
            actor=actor,
            critics=critics,
            target_actor=jax.tree.map(jnp.copy, actor),  # copies: the state is donated, and no buffer may be twice
            target_critics=jax.tree.map(jnp.copy, critics),
            actor_optimiser=self.actor_optimiser.init(actor),
            critic_optimiser=self.critic_optimiser.init(critics),
            updates=jnp.zeros((), jnp.int32),
        )

    def restarted(self, state: DDPGState) -> DDPGState:
        """The same networks, with fresh targets, optimisers and counters."""
        return self._begin(state.actor, state.critics)

    def actor(self, state: DDPGState) -> Any:
        """Parameters of the actor network."""
        return state.actor

    def with_actor(self, state: DDPGState, actor: Any) -> DDPGState:
        """The state with another actor; its target network is replaced too."""
        return state._replace(actor=actor, target_actor=jax.tree.map(jnp.copy, actor))

    def endless(self, warm_up: int) -> DDPG:
        """The same learner for a loop without end; its actor is frozen for the first `warm_up` updates."""
        config = replace(self.config, n_step=1, rate_decay="constant", actor_from=warm_up)
        return DDPG(config, self.obs_size, self.action_size)

    def noise(self, environments: int) -> Noise:
        """Zero noise, with the volatility of each environment."""
        low, high = self.config.noise_sigma
        sigma = jnp.geomspace(low, high, environments) if environments > 1 else jnp.full(1, high)
        return Noise(jnp.zeros(environments), sigma)

    def explore(
        self, state: DDPGState, noise: Noise, obs: jax.Array, normal: jax.Array, first: jax.Array, progress: jax.Array
    ) -> tuple[jax.Array, Noise, tuple[()]]:
        """mu(s) plus Ornstein-Uhlenbeck noise that restarts with each episode; see `Agent.explore`."""
        sigma = noise.sigma * (1.0 + (self.config.noise_end - 1.0) * progress)
        x = ornstein_uhlenbeck(jnp.where(first, 0.0, noise.x), normal[0], self.config.noise_theta, sigma)
        return jnp.clip(self.act(state.actor, obs) + x[None], -1.0, 1.0), noise._replace(x=x), ()

    def act(self, actor: Any, obs: jax.Array) -> jax.Array:
        """mu(s): obs (..., n) -> action (..., m) in [-1, 1]."""
        return jnp.tanh(self.before_tanh(actor, obs))

    def before_tanh(self, actor: Any, obs: jax.Array) -> jax.Array:
        """The actor's output before its tanh: obs (..., n) -> (..., m)."""
        return cast(jax.Array, self.network.apply(actor, obs))

    def value(self, state: DDPGState, obs: jax.Array) -> jax.Array:
        """Q(s, mu(s)) of the first critic: obs (..., n) -> (...)."""
        return cast(jax.Array, self.critic.apply(state.critics[0], obs, self.act(state.actor, obs)))

    def values(self, critics: tuple[Any, ...], obs: jax.Array, action: jax.Array) -> jax.Array:
        """Q of each critic: (B, n), (B, m) -> (B, critics)."""
        return jnp.stack([cast(jax.Array, self.critic.apply(critic, obs, action)) for critic in critics], -1)

    def diagnose(self, state: DDPGState, batch: Transitions, key: chex.PRNGKey) -> dict[str, jax.Array]:
        """Norms of the gradients of critic and actor on a batch."""
        about_to_move = state._replace(updates=jnp.full_like(state.updates, self.config.policy_delay - 1))
        _, found = self.update(about_to_move, batch, key, norms=True)
        return {name: found[name] for name in ("critic_gradient", "actor_gradient")}

    def update(
        self, state: DDPGState, batch: Transitions, key: chex.PRNGKey, norms: bool = False
    ) -> tuple[DDPGState, dict[str, Any]]:
        """One gradient step of critic, actor and targets (paper eq. 2 to 5, algorithm 1).

        Args:
            state: of the learner.
            batch: transitions (B, ...).
            key: for TD3's target noise.
            norms: also report the norms of the gradients, which costs another pass over each.

        Returns:
            The next state, and scalars critic_loss, actor_loss, q, saturation (share of |action| > 0.99) and skipped.
            skipped is 1 where a loss is not finite; it is then reported as zero, and neither its network nor the
            targets are updated. With `norms` also critic_gradient and actor_gradient.
        """
        cfg = self.config
        chex.assert_rank([batch.obs, batch.action, batch.reward, batch.discount], [2, 2, 1, 1])
        next_action = self.act(state.target_actor, batch.next_obs)
        if cfg.target_noise > 0:
            noise = cfg.target_noise * jax.random.normal(key, next_action.shape, next_action.dtype)
            noise = jnp.clip(noise, -cfg.target_noise_clip, cfg.target_noise_clip)
            next_action = jnp.clip(next_action + noise, -1.0, 1.0)
        next_q = self.values(state.target_critics, batch.next_obs, next_action)
        target = jax.vmap(td_target)(batch.reward, batch.discount, next_q)

        def critic_loss(critics: tuple[Any, ...]) -> tuple[jax.Array, jax.Array]:
            q = self.values(critics, batch.obs, batch.action)
            return jnp.mean(jnp.sum((target[:, None] - q) ** 2, -1)), jnp.mean(q)

        (critic_value, q), gradient = jax.value_and_grad(critic_loss, has_aux=True)(state.critics)
        critic_value, gradient, critic_finite = of_batch((critic_value, gradient), self.axis)
        of_critics = optax.tree.norm(gradient) if norms else None
        before = state.critics, state.critic_optimiser
        critics, critic_optimiser = where(
            critic_finite, descend(self.critic_optimiser, gradient, before[1], before[0]), before
        )
        state = state._replace(critics=critics, critic_optimiser=critic_optimiser, updates=state.updates + 1)

        def move_actor(state: DDPGState) -> tuple[DDPGState, tuple[Any, ...]]:
            def actor_loss(actor: Any) -> tuple[jax.Array, jax.Array]:
                before_tanh = self.before_tanh(actor, batch.obs)
                action = jnp.tanh(before_tanh)
                value = self.values(state.critics[:1], batch.obs, action)
                loss = -jnp.mean(value) + cfg.saturation_penalty * jnp.mean(before_tanh**2)
                return loss, jnp.mean(jnp.where(jnp.abs(action) > 0.99, 1.0, 0.0))

            (loss, saturation), gradient = jax.value_and_grad(actor_loss, has_aux=True)(state.actor)
            loss, gradient, finite = of_batch((loss, gradient), self.axis)
            finite &= critic_finite
            actor, optimiser = descend(self.actor_optimiser, gradient, state.actor_optimiser, state.actor)
            moved = state._replace(
                actor=actor,
                actor_optimiser=optimiser,
                target_actor=optax.incremental_update(actor, state.target_actor, cfg.polyak),
                target_critics=optax.incremental_update(state.critics, state.target_critics, cfg.polyak),
            )
            state = where(finite, moved, state)
            return state, (loss, saturation, finite, optax.tree.norm(gradient) if norms else None)

        if cfg.policy_delay == 1:
            state, (actor_value, saturation, actor_finite, of_actor) = move_actor(state)
        else:
            zero = jnp.zeros_like(critic_value)
            still = (zero, zero, jnp.ones_like(critic_finite), zero if norms else None)
            state, (actor_value, saturation, actor_finite, of_actor) = jax.lax.cond(
                state.updates % cfg.policy_delay == 0, move_actor, lambda s: (s, still), state
            )
        skipped = jnp.where(critic_finite & actor_finite, 0.0, 1.0)
        q = jnp.where(critic_finite, q, 0.0)
        metrics = dict(critic_loss=critic_value, actor_loss=actor_value, q=q, saturation=saturation, skipped=skipped)
        return state, metrics | (dict(critic_gradient=of_critics, actor_gradient=of_actor) if norms else {})
