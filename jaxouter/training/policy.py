"""The learned policy: observer, actor, and the map from its action to r~."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxouter.agents.networks import Actor, act
from jaxouter.loop.bank import Bank, BaseLaw
from jaxouter.loop.observation import Memory, Observer
from jaxouter.loop.policy import unclipped


class LearnedParams(NamedTuple):
    """Parameters of the learned policy."""

    actor: Any
    base: BaseLaw  # r~ at zero action


@dataclass(frozen=True)
class LearnedPolicy:
    """r~ = clip(base(memory, r, y) + scale tanh(actor(observation))), whichever agent learned the actor."""

    observer: Observer
    hidden: tuple[int, ...]
    """Widths of the actor's hidden layers."""
    scale: float
    """Largest correction of the base law, in the unit of r~."""
    host: bool = False

    def init_actor(self, key: chex.PRNGKey) -> Any:
        """Random parameters of the actor."""
        return Actor(self.hidden, 1).init(key, jnp.zeros(self.observer.size))

    def action(self, actor: Any, obs: jax.Array) -> jax.Array:
        """Action in [-1, 1] (scalar) of an observation (n,)."""
        return act(self.hidden, actor, obs)[0]

    def r_tilde(self, base: BaseLaw, memory: Memory, r: jax.Array, y: jax.Array, action: jax.Array) -> jax.Array:
        """r~ (scalar, clipped to its bounds) of an action in [-1, 1] (scalar), at t_k."""
        base = base.law(memory.evidence) if isinstance(base, Bank) else base
        return jnp.clip(unclipped(base, memory, r, y) + self.scale * action, *self.observer.r_tilde_bounds)

    def trimmed(self, params: LearnedParams) -> tuple[LearnedPolicy, LearnedParams]:
        """The same policy and parameters without the base law's last coefficients that are zero."""
        if isinstance(params.base, Bank):
            return self, params
        used = [np.flatnonzero(np.asarray(each)) for each in (params.base.y_past, params.base.r_tilde_past)]
        n = 1 + max(int(each.max(initial=-1)) for each in used)
        base = params.base._replace(y_past=params.base.y_past[:n], r_tilde_past=params.base.r_tilde_past[:n])
        return replace(self, observer=replace(self.observer, lags=n)), params._replace(base=base)

    def without_switching(self, params: LearnedParams) -> LearnedParams:
        """The parameters with which the law of a bank that acts goes on to do so."""
        base = params.base
        return params._replace(base=base.without_switching()) if isinstance(base, Bank) else params

    def init(self, params: LearnedParams, r0: jax.Array, y0: jax.Array) -> Memory:
        """Memory before the first step."""
        memory = self.observer.init(r0, y0)
        return memory._replace(evidence=params.base.begin()) if isinstance(params.base, Bank) else memory

    def observe(self, base: BaseLaw, memory: Memory, r: jax.Array, y: jax.Array) -> tuple[Memory, jax.Array]:
        """At t_k: memory with r_k - y_k integrated and the evidence of y_k, and the observation (n,)."""
        if isinstance(base, Bank):
            memory = memory._replace(evidence=base.judge(memory.evidence, memory, y))
        return self.observer.observe(memory, r, y)

    def act(
        self, params: LearnedParams, carry: Memory, r: jax.Array, y: jax.Array, key: chex.PRNGKey | None = None
    ) -> tuple[Memory, jax.Array]:
        """Observe, act and update the memory; no exploration."""
        del key
        memory, obs = self.observe(params.base, carry, r, y)
        r_tilde = self.r_tilde(params.base, memory, r, y, self.action(params.actor, obs))
        return self.observer.record(memory, y, r_tilde), r_tilde
