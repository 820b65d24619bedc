"""The learner interface and the data a learner learns from. A learner knows nothing of plants, files or devices.

`explore` takes one environment; the drivers in `jaxouter.training` vmap it. Whatever else a learner learns, its policy
is one MLP, `jaxouter.agents.networks.Actor`, followed by tanh. Exports, pretraining, stability analysis and the live
loop need nothing else of a learner.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import chex
import jax


@dataclass(frozen=True)
class OffPolicy:
    """Learns from transitions in a replay, whichever policy acted."""

    batch_size: int
    """Transitions per update."""
    n_step: int
    """Steps of the return before bootstrapping."""
    discount: float
    """Discount per control step."""
    updates: int
    """Updates after each step of all environments."""
    prefill: int
    """Environment steps with random actions before the first update."""
    replay: int
    """Environment steps the replay holds."""
    hold: bool = False
    """Transitions are as if the set-point had stayed as it was at their first step."""
    relabel: float = 0.0
    """Share of transitions that get another set-point; needs `hold`."""

    @property
    def bits(self) -> int:
        """Random numbers from which a transition is drawn."""
        return 4 if self.relabel else 2

    @property
    def before(self) -> int:
        """Environment steps before the first epoch."""
        return self.prefill

    def total_updates(self, steps: int, environments: int) -> int:
        """Updates in `steps` environment steps, of which the first `prefill` have none."""
        return max(0, steps - self.prefill) // environments * self.updates

    def check(self, steps: int, epoch: int, environments: int, shards: int) -> None:
        """Check that these settings fit together.

        Raises:
            ValueError: names the field, its value and what is allowed.
        """
        if self.batch_size % shards:
            raise ValueError(
                f"agent.batch_size is {self.batch_size}; it must be a multiple of the {shards} devices of each seed"
            )
        for name, value in (("agent.prefill", self.prefill), ("epoch", epoch)):
            _multiple(name, value, environments, f"the {environments} environments")
        if self.prefill < self.batch_size or 0 < steps <= self.prefill:
            most = f" and less than the {steps} steps" if steps else ""
            raise ValueError(
                f"agent.prefill is {self.prefill}; it must be at least the batch size, {self.batch_size}{most}"
            )
        if self.prefill <= self.n_step * environments:
            raise ValueError(
                f"agent.prefill is {self.prefill}; it must hold more than agent.n_step = {self.n_step} steps of each "
                "environment"
            )
        if self.replay < self.batch_size:
            raise ValueError(f"agent.replay is {self.replay}; it must hold at least a batch of {self.batch_size}")


@dataclass(frozen=True)
class OnPolicy:
    """Learns from what the current policy has just done."""

    unroll: int
    """Steps of each environment between updates."""
    epochs: int
    """Passes over these steps."""
    minibatches: int
    """Minibatches per pass, one update each."""
    discount: float
    """Discount per control step."""
    gae_lambda: float
    """Lambda of generalised advantage estimation (Schulman et al. 2016); 1: the whole return."""
    hold: bool = False
    """Where the set-point moves the return ends, with the value that it would have gone on with had it stayed."""
    prefill: int = 0
    """Environment steps before the first update, from which observations are whitened."""

    @property
    def before(self) -> int:
        """Environment steps before the first epoch."""
        return self.prefill

    def total_updates(self, steps: int, environments: int) -> int:
        """Updates in `steps` environment steps, of which the first `prefill` have none."""
        return max(0, steps - self.prefill) // (self.unroll * environments) * self.epochs * self.minibatches

    def check(self, steps: int, epoch: int, environments: int, shards: int) -> None:
        """Check that these settings fit together.

        Raises:
            ValueError: names the field, its value and what is allowed.
        """
        each = self.unroll * environments
        _multiple("agent.prefill", self.prefill, environments, f"the {environments} environments")
        learned = "steps minus agent.prefill" if self.prefill else "steps"
        for name, value in (("epoch", epoch), (learned, steps - self.prefill if steps else 0)):
            _multiple(name, value, each, f"{each}: agent.unroll = {self.unroll} steps of {environments} environments")
        _multiple("agent.unroll times environments", each // shards, self.minibatches, "agent.minibatches")


def _multiple(name: str, value: int, of: int, what: str) -> None:
    if value % of:
        raise ValueError(f"{name} is {value}; it must be a multiple of {what}")


class AgentConfig(ABC):
    """Base class of a learner's settings: a frozen dataclass whose fields become the options `--agent.*`.

    It must have the field `hidden`, the widths of the actor's hidden layers.
    """

    hidden: tuple[int, ...]

    @property
    @abstractmethod
    def data(self) -> OffPolicy | OnPolicy:
        """What it learns from."""

    def check(self) -> None:  # noqa: B027 - there may be nothing to check
        """Raises ValueError if a setting is wrong; names the field, its value and what is allowed."""

    @abstractmethod
    def build(self, obs_size: int, total_updates: int = 1, axis: str | None = None) -> Agent:
        """The learner.

        Args:
            obs_size: length of an observation.
            total_updates: updates in the whole training, for schedules.
            axis: mapped axis over which gradients are averaged: each member updates on its part of the batch.
        """


class Transitions(NamedTuple):
    """A batch for an off-policy learner, (B, ...)."""

    obs: jax.Array  # (B, n)
    action: jax.Array  # (B, m), in [-1, 1]
    reward: jax.Array  # (B,), discounted sum over the n steps
    discount: jax.Array  # (B,), of the bootstrapped value; 0 where terminated
    next_obs: jax.Array  # (B, n)


class Experience(NamedTuple):
    """A batch for an on-policy learner, (B, ...)."""

    obs: jax.Array  # (B, n)
    action: jax.Array  # (B, m), in [-1, 1]
    extras: Any  # as returned by `explore`
    advantage: jax.Array  # (B,), generalised, not normalised
    value_target: jax.Array  # (B,)


class Agent(Protocol):
    """A learner. Frozen and hashable; its state is a pytree."""

    @property
    def data(self) -> OffPolicy | OnPolicy:
        """What it learns from."""
        ...

    def init(self, key: chex.PRNGKey) -> Any:
        """State before the first update."""
        ...

    def actor(self, state: Any) -> Any:
        """Parameters of the actor network."""
        ...

    def with_actor(self, state: Any, actor: Any) -> Any:
        """The state with another actor; its target network is replaced too."""
        ...

    def noise(self, environments: int) -> Any:
        """Initial state of the exploration noise, each leaf (E, ...)."""
        ...

    def explore(
        self, state: Any, noise: Any, obs: jax.Array, normal: jax.Array, first: jax.Array, progress: jax.Array
    ) -> tuple[jax.Array, Any, Any]:
        """An action of one environment, with exploration.

        Args:
            state: of the learner.
            noise: state of this environment's noise.
            obs: (n,).
            normal: standard normal numbers (m,), drawn outside the loop.
            first: bool, whether this is the first step of an episode.
            progress: share of the training that is done.

        Returns:
            action (m,) in [-1, 1], the next noise, and extras: what else an on-policy learner needs for its update.
        """
        ...

    def update(self, state: Any, batch: Any, key: chex.PRNGKey) -> tuple[Any, dict[str, jax.Array]]:
        """One gradient step on `Transitions` or `Experience`; metrics are scalars."""
        ...

    def value(self, state: Any, obs: jax.Array) -> jax.Array:
        """Expected discounted return from obs (..., n); (...)."""
        ...


class OffPolicyAgent(Agent, Protocol):
    """What the off-policy driver needs in addition."""

    def diagnose(self, state: Any, batch: Transitions, key: chex.PRNGKey) -> dict[str, jax.Array]:
        """Diagnostics on one batch, such as gradient norms."""
        ...


class LiveAgent(OffPolicyAgent, Protocol):
    """What the live loop needs in addition."""

    def endless(self, warm_up: int) -> LiveAgent:
        """The same learner for a loop without end; its actor is frozen for the first `warm_up` updates."""
        ...

    def restarted(self, state: Any) -> Any:
        """The same networks, with fresh targets, optimisers and counters."""
        ...
