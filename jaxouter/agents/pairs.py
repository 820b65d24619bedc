"""Learning from pairs: what a change of one action gains, measured by branching the simulator.

Near a good policy the error of a value function dwarfs what a better action gains, so its gradient leads nowhere. A
pair is one state with the same noise, load and set-point, once under the policy and once with its first action changed;
the difference of the two discounted returns holds no such error. The critic learns it as a concave function of the
change, and the actor follows the critic's gradient.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, cast

import chex
import jax
import jax.numpy as jnp
import optax

from jaxouter.agents.adam import adam, descend
from jaxouter.agents.networks import AdvantageCritic, before_tanh
from jaxouter.agents.whitening import Whitening

SHARES = (1.0, 0.3, 0.1)  # of what the actor learned in a round, of which the best is kept


@dataclass(frozen=True)
class PairsConfig:
    """Rounds of learning from pairs, after the agent's own steps; only a better actor is kept."""

    rounds: int = 0
    """Rounds; 0: none."""
    states: int = 8_192
    """Pairs per round, each at a state of an episode with exploration."""
    environments: int = 64
    """Episodes with exploration per round."""
    wander: bool = True
    """In these episodes, and in those on which actors are compared, set-points also walk and wander, as in the
    pretraining; else they are redrawn as in the agent's own episodes."""
    horizon: int = 40
    """Control steps of a pair."""
    change: float = 0.5
    """Largest change of the action; 1 is the largest correction."""
    kept: int = 4
    """Rounds whose pairs are kept."""
    updates: int = 300
    """Updates of the critic, and then of the actor, per round."""
    batch_size: int = 256
    """Pairs per update."""
    critic_rate: float = 1e-3
    """Learning rate of the critic (Adam)."""
    actor_rate: float = 1e-3
    """Learning rate of the actor (Adam); it is lower while actors are refused."""
    saturation_penalty: float = 1e-3
    """Penalty on the mean square of the actor's output before its tanh."""
    noise_sigma: tuple[float, float] = (0.005, 0.1)
    """Volatility of the exploration (Ornstein-Uhlenbeck) in the first and the last episode, geometric in between."""

    @property
    def updates_per_round(self) -> int:
        """Updates of critic and actor."""
        return 2 * self.updates

    def steps(self, episode_steps: int) -> int:
        """Control steps of the plant per round, without those that compare actors."""
        return self.environments * episode_steps + 2 * self.states * self.horizon

    def check(self) -> None:
        """Raises ValueError if a setting is wrong; names the field, its value and what is allowed."""
        for name in ("rounds", "saturation_penalty"):
            if getattr(self, name) < 0:
                raise ValueError(f"pairs.{name} is {getattr(self, name)}; it must not be negative")
        for name in (
            "states", "environments", "horizon", "change", "kept", "updates", "batch_size", "critic_rate",
            "actor_rate",
        ):  # fmt: skip
            if not getattr(self, name) > 0:
                raise ValueError(f"pairs.{name} is {getattr(self, name)}; it must be positive")
        if not 0 < self.noise_sigma[0] <= self.noise_sigma[1]:
            raise ValueError(f"pairs.noise_sigma is {self.noise_sigma}; it must be two positive numbers, ascending")


class Pairs(NamedTuple):
    """Pairs, (N, ...)."""

    obs: jax.Array  # (N, n)
    action: jax.Array  # (N,), of the policy
    change: jax.Array  # (N,), of that action
    gain: jax.Array  # (N,), of the discounted return, by the change


class PairsState(NamedTuple):
    """State of the learning from pairs, beside the actor."""

    critic: Any
    critic_optimiser: optax.OptState
    actor_optimiser: optax.OptState
    pairs: Pairs  # (kept x states, ...)
    scale: jax.Array  # standard deviation of the gains of the first round
    white: Whitening  # of its observations, on which both networks learn
    rate: jax.Array  # share of the actor's learning rate
    rounds: jax.Array  # int32, so far


@dataclass(frozen=True)
class PairsLearner:
    """Critic and actor of pairs. Static and hashable."""

    config: PairsConfig
    hidden: tuple[int, ...]  # of actor and critic
    obs_size: int

    @property
    def critic(self) -> AdvantageCritic:
        """The critic network."""
        return AdvantageCritic(self.hidden)

    def gain(self, critic: Any, obs: jax.Array, change: jax.Array) -> jax.Array:
        """Expected gain of changes, in standard deviations of those of the first round: (N, n), (N,) -> (N,)."""
        return cast(jax.Array, self.critic.apply(critic, obs, change / self.config.change))

    @property
    def optimiser(self) -> optax.GradientTransformation:
        """Adam of the critic."""
        return adam(self.config.critic_rate)

    def init(self, key: chex.PRNGKey, actor: Any) -> PairsState:
        """A random critic, and no pairs."""
        size = self.config.kept * self.config.states
        critic = self.critic.init(key, jnp.zeros(self.obs_size), jnp.zeros(()))
        nothing = jnp.zeros(size)
        return PairsState(
            critic=critic,
            critic_optimiser=self.optimiser.init(critic),
            actor_optimiser=adam(self.config.actor_rate).init(actor),
            pairs=Pairs(jnp.zeros((size, self.obs_size)), nothing, nothing, nothing),
            scale=jnp.ones(()),
            white=Whitening.none(self.obs_size),
            rate=jnp.ones(()),
            rounds=jnp.zeros((), jnp.int32),
        )

    def add(self, state: PairsState, pairs: Pairs) -> PairsState:
        """With the pairs of one more round, in place of the oldest."""
        at = state.rounds % self.config.kept * self.config.states

        def put(old: jax.Array, new: jax.Array) -> jax.Array:
            return jax.lax.dynamic_update_slice_in_dim(old, new, at, 0)

        first = jnp.maximum(jnp.std(pairs.gain), 1e-12), Whitening.of(pairs.obs)
        scale, white = jax.tree.map(partial(jnp.where, state.rounds == 0), first, (state.scale, state.white))
        pairs = jax.tree.map(put, state.pairs, pairs)
        return state._replace(pairs=pairs, scale=scale, white=white, rounds=state.rounds + 1)

    def learn(self, state: PairsState, actor: Any, key: chex.PRNGKey) -> tuple[PairsState, Any, dict[str, jax.Array]]:
        """Updates of the critic, then of the actor, from the pairs that are kept.

        Returns:
            The state, the new actor, and the mean loss of the critic's last updates.
        """
        config = self.config
        most = jnp.minimum(state.rounds, config.kept) * config.states
        shape = (2, config.updates, config.batch_size)
        rows = jax.random.randint(key, shape, 0, most)

        def drawn(rows: jax.Array) -> Pairs:
            batch = jax.tree.map(lambda leaf: leaf[rows], state.pairs)
            return batch._replace(obs=state.white(batch.obs))

        def update_critic(state: PairsState, rows: jax.Array) -> tuple[PairsState, jax.Array]:
            batch = drawn(rows)

            def loss(critic: Any) -> jax.Array:
                return jnp.mean((self.gain(critic, batch.obs, batch.change) - batch.gain / state.scale) ** 2)

            value, gradient = jax.value_and_grad(loss)(state.critic)
            critic, optimiser = descend(self.optimiser, gradient, state.critic_optimiser, state.critic)
            return state._replace(critic=critic, critic_optimiser=optimiser), value

        state, losses = jax.lax.scan(update_critic, state, rows[0])

        of_actor = adam(lambda steps: config.actor_rate * state.rate)

        def update_actor(carry: Any, rows: jax.Array) -> tuple[Any, None]:
            actor, optimiser = carry
            batch = drawn(rows)

            def loss(actor: Any) -> jax.Array:
                output = before_tanh(self.hidden, actor, batch.obs)[:, 0]
                gain = self.gain(state.critic, batch.obs, jnp.tanh(output) - batch.action)
                return config.saturation_penalty * jnp.mean(output**2) - jnp.mean(gain)

            return descend(of_actor, jax.grad(loss)(actor), optimiser, actor), None

        begin = state.white.unfolded(actor), state.actor_optimiser
        (actor, optimiser), _ = jax.lax.scan(update_actor, begin, rows[1])
        return (
            state._replace(actor_optimiser=optimiser),
            state.white.folded(actor),
            {"pairs_loss": jnp.mean(losses[-20:])},
        )
