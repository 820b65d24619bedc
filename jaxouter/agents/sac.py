"""Soft actor-critic: the policy earns entropy too, at a price (temperature) that is learned.

Source: Haarnoja et al., Soft actor-critic algorithms and applications, 2019, section 5 and algorithm 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, cast

import chex
import jax
import jax.numpy as jnp
import optax

from jaxouter.agents.adam import adam, descend
from jaxouter.agents.agent import AgentConfig, OffPolicy, Transitions
from jaxouter.agents.gaussian import log_probability
from jaxouter.agents.networks import Actor, Critic, QuadraticCritic
from jaxouter.agents.noise import ornstein_uhlenbeck
from jaxouter.agents.updates import RateDecay, of_batch, scheduled, where
from jaxouter.agents.whitening import Whitened, whitened

LOG_SIGMA = (-7.0, 1.0)  # bounds of the logarithm of the policy's standard deviation before the tanh


@dataclass(frozen=True)
class SACConfig(AgentConfig):
    """Settings of the learner."""

    hidden: tuple[int, ...] = (256, 256)
    """Widths of the hidden layers of actor and critics."""
    critic: Literal["mlp", "quadratic"] = "mlp"
    """mlp: the action enters the critic at its second layer; quadratic: Q is concave in the action, see `networks`."""
    actor_rate: float = 3e-4
    """Learning rate of the actor and of its standard deviation (Adam)."""
    critic_rate: float = 3e-4
    """Learning rate of the critics (Adam)."""
    temperature_rate: float = 3e-4
    """Learning rate of the temperature's logarithm (Adam)."""
    rate_decay: RateDecay = "constant"
    """Schedule of the learning rates over the training; cosine ends at zero."""
    temperature: float = 0.1
    """Price of entropy at first, in units of the reward that the agent learns from."""
    target_entropy: float = -1.0
    """Entropy that the temperature aims at; -1 is a standard deviation of 0.09 of the largest correction, -2.5 of
    0.02."""
    sigma: float = 0.1
    """Standard deviation of the action (before its tanh) at first."""
    noise_theta: float = 0.15
    """Mean reversion rate of the exploration noise, which keeps its distribution; 1 is white noise, as in the paper."""
    batch_size: int = 256
    """Transitions per update."""
    discount: float = 0.99
    """Discount per control step."""
    polyak: float = 0.005
    """Step of the target critics towards the critics at each update."""
    n_step: int = 1
    """Steps of the return before bootstrapping; entropies between don't count."""
    saturation_penalty: float = 0.0
    """Penalty on the mean square of the actor's output before its tanh, to avoid saturation."""
    updates: int = 1
    """Updates after each step of all environments; updates / environments is the update-to-data ratio."""
    prefill: int = 1_000
    """Environment steps with random actions, each held for a while, before the first update."""
    replay: int = 1_000_000
    """Environment steps the replay holds."""
    hold: bool = False
    """Learn as if the set-point stayed as it is. An n-step return then ends where the set-point moves."""
    relabel: float = 0.0
    """Share of transitions that get another set-point, uniform in the plant's range; needs --agent.hold."""
    whiten: float = 0.0
    """Learn on whitened observations; this is added, in squares, to each standard deviation. 0: on plain ones."""

    @property
    def data(self) -> OffPolicy:
        """Transitions from a replay."""
        return OffPolicy(**{name: getattr(self, name) for name in OffPolicy.__dataclass_fields__})

    def build(self, obs_size: int, total_updates: int = 1, axis: str | None = None) -> SAC | Whitened:
        """The learner."""
        return whitened(SAC(self, obs_size, total_updates=total_updates, axis=axis), self.whiten)

    def check(self) -> None:
        """Raises ValueError if a setting is wrong; names the field, its value and what is allowed."""
        for field in ("actor_rate", "critic_rate", "temperature_rate", "temperature", "sigma"):
            if not getattr(self, field) > 0:
                raise ValueError(f"agent.{field} is {getattr(self, field)}; it must be positive")
        for field in ("saturation_penalty", "whiten"):
            if not getattr(self, field) >= 0:
                raise ValueError(f"agent.{field} is {getattr(self, field)}; it must not be negative")
        for field in ("polyak", "noise_theta"):
            if not 0 < getattr(self, field) <= 1:
                raise ValueError(f"agent.{field} is {getattr(self, field)}; it must lie in (0, 1]")
        if self.critic not in ("mlp", "quadratic"):
            raise ValueError(f"agent.critic is {self.critic!r}; it must be mlp or quadratic")


class SACState(NamedTuple):
    """State of the learner."""

    actor: Any
    deviation: Any  # network that gives the logarithm of the standard deviation, less that at first
    critics: tuple[Any, Any]
    target_critics: tuple[Any, Any]
    log_temperature: jax.Array
    actor_optimiser: optax.OptState  # of actor and deviation
    critic_optimiser: optax.OptState
    temperature_optimiser: optax.OptState


@dataclass(frozen=True)
class SAC:
    """The learner for observations of size `obs_size`. Static and hashable; its state is a pytree."""

    config: SACConfig
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
        """The network of the actor, and that of the deviation."""
        return Actor(self.config.hidden, self.action_size)

    @property
    def critic(self) -> Critic | QuadraticCritic:
        """The critic network."""
        hidden = self.config.hidden
        return QuadraticCritic(hidden) if self.config.critic == "quadratic" else Critic(hidden, layer_norm=False)

    def _optimiser(self, rate: float) -> optax.GradientTransformation:
        return adam(scheduled(rate, self.config.rate_decay, self.total_updates))

    def init(self, key: chex.PRNGKey) -> SACState:
        """Random networks, and targets equal to them."""
        key_actor, key_deviation, *keys = jax.random.split(key, 4)
        obs, action = jnp.zeros(self.obs_size), jnp.zeros(self.action_size)
        actor, deviation = (self.network.init(each, obs) for each in (key_actor, key_deviation))
        critics = self.critic.init(keys[0], obs, action), self.critic.init(keys[1], obs, action)
        log_temperature = jnp.log(jnp.asarray(self.config.temperature, float))
        return SACState(
            actor=actor,
            deviation=deviation,
            critics=critics,
            target_critics=jax.tree.map(jnp.copy, critics),  # a copy: the state is donated, and no buffer may be twice
            log_temperature=log_temperature,
            actor_optimiser=self._optimiser(self.config.actor_rate).init((actor, deviation)),
            critic_optimiser=self._optimiser(self.config.critic_rate).init(critics),
            temperature_optimiser=self._optimiser(self.config.temperature_rate).init(log_temperature),
        )

    def actor(self, state: SACState) -> Any:
        """Parameters of the actor network, which gives the mean before the tanh."""
        return state.actor

    def with_actor(self, state: SACState, actor: Any) -> SACState:
        """The state with another actor."""
        return state._replace(actor=actor)

    def noise(self, environments: int) -> jax.Array:
        """Standard normal numbers of the step before, (E, m)."""
        return jnp.zeros((environments, self.action_size))

    def explore(
        self, state: SACState, noise: jax.Array, obs: jax.Array, normal: jax.Array, first: jax.Array, progress: Any
    ) -> tuple[jax.Array, jax.Array, tuple[()]]:
        """A random action whose noise is correlated over time, and anew in each episode; see `Agent.explore`.

        Source: Eberhard et al., Pink noise is all you need: colored noise exploration in deep RL, 2023.
        """
        del progress
        theta = self.config.noise_theta
        noise = jnp.where(first, normal, ornstein_uhlenbeck(noise, normal, theta, (theta * (2.0 - theta)) ** 0.5))
        return self.draw((state.actor, state.deviation), obs, noise)[0], noise, ()

    def draw(
        self, policy: tuple[Any, Any], obs: jax.Array, normal: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Random actions: obs (..., n), standard normal numbers (..., m).

        Returns:
            actions tanh u (..., m), their log-density (...), and the mean of u (..., m); appendix C.
        """
        mu, deviation = (cast(jax.Array, self.network.apply(each, obs)) for each in policy)
        log_sigma = jnp.clip(deviation + jnp.log(self.config.sigma), *LOG_SIGMA)
        u = mu + jnp.exp(log_sigma) * normal
        log_slope = 2.0 * (jnp.log(2.0) - u - jax.nn.softplus(-2.0 * u))  # log(1 - tanh^2 u)
        return jnp.tanh(u), log_probability(u, mu, log_sigma) - jnp.sum(log_slope, -1), mu

    def value(self, state: SACState, obs: jax.Array) -> jax.Array:
        """Q of the policy without exploration, of the first critic: obs (..., n) -> (...)."""
        action = jnp.tanh(cast(jax.Array, self.network.apply(state.actor, obs)))
        return cast(jax.Array, self.critic.apply(state.critics[0], obs, action))

    def least(self, critics: tuple[Any, Any], obs: jax.Array, action: jax.Array) -> jax.Array:
        """The smaller Q of two critics: (B, n), (B, m) -> (B,)."""
        one, two = (cast(jax.Array, self.critic.apply(critic, obs, action)) for critic in critics)
        return jnp.minimum(one, two)

    def diagnose(self, state: SACState, batch: Transitions, key: chex.PRNGKey) -> dict[str, jax.Array]:
        """Norms of the gradients of critics and actor on a batch."""
        _, found = self.update(state, batch, key, norms=True)
        return {name: found[name] for name in ("critic_gradient", "actor_gradient")}

    def update(
        self, state: SACState, batch: Transitions, key: chex.PRNGKey, norms: bool = False
    ) -> tuple[SACState, dict[str, Any]]:
        """One gradient step of critics, actor, temperature and targets.

        Args:
            state: of the learner.
            batch: transitions (B, ...).
            key: for the actions of the policy.
            norms: also report the norms of the gradients.

        Returns:
            The next state, and scalars critic_loss, actor_loss, q, entropy, temperature, saturation (share of
            |action| > 0.99) and skipped: 1 where a loss is not finite; it is then reported as zero, and nothing is
            updated. With `norms` also critic_gradient and actor_gradient.
        """
        config = self.config
        temperature = jnp.exp(state.log_temperature)
        normal, next_normal = jax.random.normal(key, (2, *batch.action.shape), batch.action.dtype)
        next_action, next_log, _ = self.draw((state.actor, state.deviation), batch.next_obs, next_normal)
        soft_value = self.least(state.target_critics, batch.next_obs, next_action) - temperature * next_log
        target = batch.reward + batch.discount * soft_value

        def critic_loss(critics: tuple[Any, Any]) -> tuple[jax.Array, jax.Array]:
            q = jnp.stack([cast(jax.Array, self.critic.apply(critic, batch.obs, batch.action)) for critic in critics])
            return jnp.mean(jnp.sum((target[None] - q) ** 2, 0)), jnp.mean(q)

        (of_critics, q), gradient = jax.value_and_grad(critic_loss, has_aux=True)(state.critics)
        of_critics, gradient, critic_finite = of_batch((of_critics, gradient), self.axis)
        critics, critic_optimiser = descend(
            self._optimiser(config.critic_rate), gradient, state.critic_optimiser, state.critics
        )
        norm = {"critic_gradient": optax.tree.norm(gradient)} if norms else {}

        def actor_loss(policy: tuple[Any, Any]) -> tuple[jax.Array, Any]:
            action, log, mu = self.draw(policy, batch.obs, normal)
            gain = self.least(critics, batch.obs, action) - temperature * log
            loss = -jnp.mean(gain) + config.saturation_penalty * jnp.mean(mu**2)
            return loss, (-jnp.mean(log), jnp.mean(jnp.where(jnp.abs(action) > 0.99, 1.0, 0.0)))

        policy = state.actor, state.deviation
        (of_actor, (entropy, saturation)), gradient = jax.value_and_grad(actor_loss, has_aux=True)(policy)
        of_actor, (gradient, entropy), finite = of_batch((of_actor, (gradient, entropy)), self.axis)
        finite &= critic_finite
        (actor, deviation), actor_optimiser = descend(
            self._optimiser(config.actor_rate), gradient, state.actor_optimiser, policy
        )
        norm |= {"actor_gradient": optax.tree.norm(gradient)} if norms else {}
        log_temperature, temperature_optimiser = descend(
            self._optimiser(config.temperature_rate),
            entropy - config.target_entropy,
            state.temperature_optimiser,
            state.log_temperature,
        )
        after = SACState(
            actor=actor,
            deviation=deviation,
            critics=critics,
            target_critics=cast(Any, optax.incremental_update(critics, state.target_critics, config.polyak)),
            log_temperature=log_temperature,
            actor_optimiser=actor_optimiser,
            critic_optimiser=critic_optimiser,
            temperature_optimiser=temperature_optimiser,
        )
        metrics = dict(critic_loss=of_critics, actor_loss=of_actor, q=q, entropy=entropy, saturation=saturation)
        metrics = {name: jnp.where(finite, value, 0.0) for name, value in metrics.items()}
        metrics |= dict(temperature=temperature, skipped=jnp.where(finite, 0.0, 1.0))
        return where(finite, after, state), metrics | norm
