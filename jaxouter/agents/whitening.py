"""Whitening of observations: consecutive samples of y differ little, but these differences tell the plant's state.

A network on whitened observations learns them all alike. The whitening is linear, so an actor's first layer can take it
in: exported, it is an actor on plain observations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

FLOOR = 1e-2  # least standard deviation


class Whitening(NamedTuple):
    """(obs - mean) @ matrix has nearly unit covariance."""

    mean: jax.Array  # (n,)
    matrix: jax.Array  # (n, n), symmetric

    @classmethod
    def none(cls, n: int) -> Whitening:
        """Observations as they are."""
        return cls(jnp.zeros(n), jnp.eye(n))

    @classmethod
    def of(cls, obs: jax.Array, floor: float = FLOOR) -> Whitening:
        """The whitening of observations like these (N, n); `floor` is added to each standard deviation, in squares."""
        variance, axes = jnp.linalg.eigh(jnp.cov(obs, rowvar=False))
        return cls(obs.mean(0), (axes / jnp.sqrt(jnp.maximum(variance, 0.0) + floor**2)[None]) @ axes.T)

    def __call__(self, obs: jax.Array) -> jax.Array:
        """Whitened observations (..., n)."""
        return (obs - jnp.broadcast_to(self.mean, obs.shape)) @ self.matrix

    def folded(self, actor: Any) -> Any:
        """The actor on plain observations, from one whose first layer takes whitened ones."""
        layers, first = actor["params"], min(actor["params"])
        kernel = self.matrix @ layers[first]["kernel"]
        return {"params": layers | {first: {"kernel": kernel, "bias": layers[first]["bias"] - self.mean @ kernel}}}

    def unfolded(self, actor: Any) -> Any:
        """The inverse of `folded`."""
        layers, first = actor["params"], min(actor["params"])
        bias = layers[first]["bias"] + self.mean @ layers[first]["kernel"]
        kernel = jnp.linalg.solve(self.matrix, layers[first]["kernel"])
        return {"params": layers | {first: {"kernel": kernel, "bias": bias}}}


class WhitenedState(NamedTuple):
    """State of `Whitened`."""

    learner: Any
    white: Whitening


@dataclass(frozen=True)
class Whitened:
    """A learner that sees whitened observations. Static and hashable.

    The actor that it gives, and that it is given, takes plain ones. Methods are those of the learner.
    """

    learner: Any  # has `obs_size` and `axis`
    floor: float

    @property
    def data(self) -> Any:
        """What it learns from."""
        return self.learner.data

    def init(self, key: chex.PRNGKey) -> WhitenedState:
        """State before the first update; observations are whitened once it is prepared."""
        return WhitenedState(self.learner.init(key), Whitening.none(self.learner.obs_size))

    def prepared(self, state: WhitenedState, obs: jax.Array) -> WhitenedState:
        """The same policy, from now on on observations that are whitened as these (N, n)."""
        axis = self.learner.axis
        obs = obs if axis is None else jax.lax.all_gather(obs, axis, tiled=True)
        return self.with_actor(state._replace(white=Whitening.of(obs, self.floor)), self.actor(state))

    def restarted(self, state: WhitenedState) -> WhitenedState:
        """The same networks, with fresh targets, optimisers and counters."""
        return state._replace(learner=self.learner.restarted(state.learner))

    def endless(self, warm_up: int) -> Whitened:
        """The same learner for a loop without end."""
        return replace(self, learner=self.learner.endless(warm_up))

    def actor(self, state: WhitenedState) -> Any:
        """Parameters of the actor network, on plain observations."""
        return state.white.folded(self.learner.actor(state.learner))

    def with_actor(self, state: WhitenedState, actor: Any) -> WhitenedState:
        """The state with another actor, on plain observations."""
        return state._replace(learner=self.learner.with_actor(state.learner, state.white.unfolded(actor)))

    def noise(self, environments: int) -> Any:
        """Initial state of the exploration noise."""
        return self.learner.noise(environments)

    def explore(
        self, state: WhitenedState, noise: Any, obs: jax.Array, normal: jax.Array, first: jax.Array, progress: jax.Array
    ) -> tuple[jax.Array, Any, Any]:
        """An action of one environment, with exploration."""
        return self.learner.explore(state.learner, noise, state.white(obs), normal, first, progress)

    def update(self, state: WhitenedState, batch: Any, key: chex.PRNGKey) -> tuple[WhitenedState, dict[str, Any]]:
        """One gradient step."""
        learner, metrics = self.learner.update(state.learner, _whitened(batch, state.white), key)
        return state._replace(learner=learner), metrics

    def diagnose(self, state: WhitenedState, batch: Any, key: chex.PRNGKey) -> dict[str, jax.Array]:
        """Diagnostics on one batch."""
        return self.learner.diagnose(state.learner, _whitened(batch, state.white), key)

    def value(self, state: WhitenedState, obs: jax.Array) -> jax.Array:
        """Expected discounted return."""
        return self.learner.value(state.learner, state.white(obs))


def _whitened(batch: Any, white: Whitening) -> Any:
    """A batch with its observations whitened."""
    return batch._replace(**{name: white(getattr(batch, name)) for name in ("obs", "next_obs") if hasattr(batch, name)})


def whitened(learner: Any, floor: float) -> Any:
    """The learner on whitened observations, to whose standard deviations `floor` is added; as it is if that is 0."""
    return Whitened(learner, floor) if floor else learner


def prepared(agent: Any, state: Any, obs: jax.Array) -> Any:
    """The agent's state once observations (N, n) of the plant are known; its policy is the same."""
    return agent.prepared(state, obs.reshape(-1, obs.shape[-1])) if isinstance(agent, Whitened) else state
