"""What the agent sees: current and past r, y, r~ and functions of them, nothing else (paper section II).

Environment, policy and replay use the same functions. The replay stores signals and builds observations from windows
of them, so what is not in `Signals` cannot reach the agent or the critic.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxouter.loop.policy import Past
from jaxouter.plants import Plant

HISTORY = 15  # past samples by default


class Memory(NamedTuple):
    """Memory of the outer loop between two control steps."""

    y_past: jax.Array  # (M,), y_(k-1), y_(k-2), ...; M >= H
    r_tilde_past: jax.Array  # (M,), r~_(k-1), r~_(k-2), ...
    integral: jax.Array  # leaky integral of r - y, a running mean over `integral_time`
    evidence: Any = ()  # of a bank of base laws, see `jaxouter.loop.bank`


class Signals(NamedTuple):
    """One control step as stored in the replay; each (W,) in a window, oldest first."""

    r: jax.Array
    y: jax.Array
    integral: jax.Array
    r_tilde: jax.Array
    age: jax.Array  # control steps since the reset
    r_next: jax.Array
    y_next: jax.Array


@dataclass(frozen=True)
class Observer:
    """Builds observations with a fixed scaling. Static and hashable."""

    history: int
    """H, past samples of y and of r~."""
    integral_steps: float
    """Time constant of the leaky integral, in control steps."""
    y_middle: float
    y_scale: float
    r_tilde_bounds: tuple[float, float]
    lags: int = 0
    """Past samples that the base law needs in the memory."""
    laws: int = 0
    """Laws in the bank of base laws, of which the observation shows which one acts; 0: there is no bank."""

    @classmethod
    def of(
        cls, plant: Plant, history: int | None = None, integral_steps: float | None = None, lags: int = 0
    ) -> Observer:
        """The observer of a plant.

        Args:
            plant: gives the scaling.
            history: None: as the plant declares, or 15.
            integral_steps: None: a quarter of an episode.
            lags: past samples that the base law needs.

        Raises:
            ValueError: history below 1 or integral_steps below 1.
        """
        history = next(h for h in (history, plant.history, HISTORY) if h is not None)
        integral_steps = plant.episode_steps / 4 if integral_steps is None else integral_steps
        if history < 1 or integral_steps < 1:
            raise ValueError(f"history is {history} and integral_steps is {integral_steps}; both must be at least 1")
        low, high = plant.setpoint_range
        return cls(history, integral_steps, (low + high) / 2, (high - low) / 2, plant.r_tilde_bounds, lags)

    @property
    def remembered(self) -> int:
        """M, past samples in the memory, of which the newest H are observed."""
        return max(self.history, self.lags)

    @property
    def size(self) -> int:
        """Length of the observation."""
        return 3 + 2 * self.history + self.laws

    def init(self, r0: jax.Array, y0: jax.Array) -> Memory:
        """Memory before t_0: histories filled with y_0 and r~_(-1), which is y_0 clipped to the bounds of r~."""
        del r0  # only the present r is seen
        return Memory(*Past.of(y0, self.remembered, self.r_tilde_bounds), jnp.zeros_like(y0))

    def observe(self, memory: Memory, r: jax.Array, y: jax.Array) -> tuple[Memory, jax.Array]:
        """At t_k: memory with r_k - y_k integrated, and the observation (n,)."""
        memory = memory._replace(integral=memory.integral + (r - y - memory.integral) / self.integral_steps)
        return memory, self.features(memory, r, y)

    def record(self, memory: Memory, y: jax.Array, r_tilde: jax.Array) -> Memory:
        """After r~_k is chosen: y_k and r~_k enter the past."""
        past = Past(memory.y_past, memory.r_tilde_past).then(y, r_tilde)
        return memory._replace(**past._asdict())

    def features(self, memory: Memory, r: jax.Array, y: jax.Array) -> jax.Array:
        """[r, r - y, leaky integral, past y minus y, past r~], scaled, and which law acts, if there is a bank; (n,)."""
        chex.assert_rank([r, y], 0)
        low, high = self.r_tilde_bounds
        present = jnp.stack([r - self.y_middle, r - y, memory.integral]) / self.y_scale
        y_past = (memory.y_past[: self.history] - y) / self.y_scale
        r_tilde_past = (memory.r_tilde_past[: self.history] - (low + high) / 2) / ((high - low) / 2)
        which = [jax.nn.one_hot(memory.evidence.active, self.laws, dtype=present.dtype)] if self.laws else []
        return jnp.concatenate([present, y_past, r_tilde_past, *which])

    def memory_at(self, window: Signals, i: jax.Array | int) -> Memory:
        """The newest H of the memory at t_i (its error integrated), from a window that starts H steps earlier or more.

        Args:
            window: Signals of W consecutive steps of one environment; there may be a reset among those before i.
            i: index in the window, H <= i < W.
        """
        back = jnp.arange(1, self.history + 1)
        i = jnp.asarray(i).astype(back.dtype)
        age = window.age[i].astype(back.dtype)
        y0 = window.y[jnp.maximum(i - age, 0)]
        within = back <= age
        return Memory(
            jnp.where(within, window.y[i - back], y0),
            jnp.where(within, window.r_tilde[i - back], jnp.clip(y0, *self.r_tilde_bounds)),
            window.integral[i],
        )

    def held(self, window: Signals, i: int, r: jax.Array) -> Signals:
        """The window as if the reference had been r from t_i on, and all else as it was.

        Args:
            window: as for `memory_at`; what follows a reset after t_i has no meaning.
            i: index in the window.
            r: reference, scalar.
        """
        k = jnp.arange(len(window.r))
        later = k >= i
        since = (k[:, None] - k[None]).astype(r.dtype)
        decay = (1.0 - 1.0 / self.integral_steps) ** jnp.maximum(since, 0.0)
        weights = jnp.where((since >= 0) & later[None], decay, 0.0) / self.integral_steps
        return window._replace(
            r=jnp.where(later, r, window.r),
            integral=window.integral + weights @ (r - window.r),
            r_next=jnp.where(later, r, window.r_next),
        )

    def had_r_been(self, obs: jax.Array, more: jax.Array) -> jax.Array:
        """The observation (..., n) if the present reference were larger by `more` (...), and all before as it was."""
        of_each = jnp.asarray([1.0, 1.0, 1.0 / self.integral_steps], obs.dtype) / self.y_scale
        return obs.at[..., :3].add(jnp.multiply.outer(more, of_each))

    def before_and_after(self, window: Signals, i: jax.Array | int, j: jax.Array | int) -> tuple[jax.Array, jax.Array]:
        """Observations at t_i and at t_(j+1), j >= i, the latter before any reset; each (3 + 2H,)."""
        at_i = self.features(self.memory_at(window, i), window.r[i], window.y[i])
        memory = self.record(self.memory_at(window, j), window.y[j], window.r_tilde[j])
        return at_i, self.observe(memory, window.r_next[j], window.y_next[j])[1]
