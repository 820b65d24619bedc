"""The learned policy: observer, actor, and the map from its action to r~."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxouter.agents.networks import Actor, act
from jaxouter.loop.observation import Memory, Observer
from jaxouter.loop.policy import AffineParams


class LearnedParams(NamedTuple):
    """Parameters of the learned policy."""

    actor: Any
    base: AffineParams  # base law, r~ at zero action: the middle of the range, or the static prefilter


@dataclass(frozen=True)
class LearnedPolicy:
    """r~ = clip(base(r) + half the range of r~ times tanh(actor(observation))), whichever agent learned the actor."""

    observer: Observer
    hidden: tuple[int, ...]
    """Widths of the actor's hidden layers."""
    host: bool = False

    def init_actor(self, key: chex.PRNGKey) -> Any:
        """Random parameters of the actor."""
        return Actor(self.hidden, 1).init(key, jnp.zeros(self.observer.size))

    def action(self, actor: Any, obs: jax.Array) -> jax.Array:
        """Action in [-1, 1] (scalar) of an observation (n,)."""
        return act(self.hidden, actor, obs)[0]

    def r_tilde(self, base: AffineParams, r: jax.Array, action: jax.Array) -> jax.Array:
        """r~ (scalar, clipped to its bounds) of an action in [-1, 1] (scalar)."""
        low, high = self.observer.r_tilde_bounds
        return jnp.clip(base.offset + base.slope * r + (high - low) / 2 * action, low, high)

    def init(self, params: LearnedParams, r0: jax.Array, y0: jax.Array) -> Memory:
        """Memory before the first step."""
        del params
        return self.observer.init(r0, y0)

    def act(
        self, params: LearnedParams, carry: Memory, r: jax.Array, y: jax.Array, key: chex.PRNGKey | None = None
    ) -> tuple[Memory, jax.Array]:
        """Observe, act and update the memory; no exploration."""
        del key
        memory, obs = self.observer.observe(carry, r, y)
        r_tilde = self.r_tilde(params.base, r, self.action(params.actor, obs))
        return self.observer.record(memory, y, r_tilde), r_tilde
