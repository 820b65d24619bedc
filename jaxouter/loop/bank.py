"""A bank of base laws with switching: the law acts whose model has predicted y best lately.

Each law is made for a plant that was identified beforehand, and that plant's model predicts y one control step ahead. A
performance index sums the squared prediction errors of each model, with forgetting. Another law takes over once its
index is lower by more than the hysteresis.

Source: Narendra and Balakrishnan, Adaptive control using multiple models, 1997.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxouter.loop.policy import LinearLaw, padded

FORGETTING = 0.97  # factor per control step on squared errors of the past
RATE = 0.05  # of the running mean of the errors: what a load or an offset adds to each of them
HYSTERESIS = 1.2  # factor by which another index must be lower
FLOOR = 0.003  # error that counts as none, in half set-point ranges; its square is added to each index


class Evidence(NamedTuple):
    """What a bank remembers between two control steps."""

    mean_error: jax.Array  # (L,), running mean of each model's prediction error, in the unit of y
    performance: jax.Array  # (L,), performance index of each model, in the unit of y squared; lower is better
    active: jax.Array  # int32, number of the law that acts; -1: none yet


class Bank(NamedTuple):
    """Base laws, and the models by which one of them is chosen; the first acts at first.

    Each model predicts y_k = sum over i from 1 to n of a_i y_(k-i) + b_i r~_(k-i).
    """

    laws: LinearLaw  # (L, ...)
    a: jax.Array  # (L, n)
    b: jax.Array  # (L, n)
    floor: jax.Array  # added to each index before they are compared, in the unit of y squared

    def begin(self) -> Evidence:
        """Before the first step."""
        nothing = jnp.zeros(len(self.a), self.a.dtype)
        return Evidence(nothing, nothing, jnp.full((), -1, jnp.int32))

    def judge(self, evidence: Evidence, past: Any, y: jax.Array) -> Evidence:
        """At t_k: how well y_k was predicted, and the law that acts from now on. It is not differentiated.

        Args:
            evidence: of the step before.
            past: a `Past`, or a `Memory`, of n samples or more.
            y: y_k, scalar.
        """
        past, y = jax.lax.stop_gradient((past, y))
        n = self.a.shape[1]
        error = y - self.a @ past.y_past[:n] - self.b @ past.r_tilde_past[:n]
        mean = jnp.where(evidence.active < 0, error, evidence.mean_error)  # the first errors are of the start
        error, active = error - mean, jnp.maximum(evidence.active, 0)
        performance = FORGETTING * evidence.performance + error**2 / (1.0 + jnp.sum(self.a**2, 1))
        best, compared = jnp.argmin(performance).astype(jnp.int32), performance + self.floor
        active = jnp.where(HYSTERESIS * compared[best] < compared[active], best, active)
        return Evidence(mean + RATE * error, performance, active)

    def law(self, evidence: Evidence) -> LinearLaw:
        """The law that acts."""
        return jax.tree.map(lambda leaf: jnp.take(leaf, evidence.active, 0), self.laws)

    def without_switching(self) -> Bank:
        """The bank in which the law that acts goes on to do so."""
        return self._replace(floor=jnp.full_like(self.floor, jnp.inf))

    def all_of(self, law: LinearLaw) -> Bank:
        """The bank with this law in every place."""
        one = padded(law, self.laws.y_past.shape[1])
        return self._replace(laws=jax.tree.map(lambda leaf, like: jnp.broadcast_to(leaf, like.shape), one, self.laws))


BaseLaw = LinearLaw | Bank


def of(laws: Sequence[LinearLaw], a: Any, b: Any, half: float) -> Bank:
    """The bank of some laws and models (L, n), for a plant whose set-point range is twice `half`."""
    a, b = jnp.asarray(a, float), jnp.asarray(b, float)
    alike = [padded(law, a.shape[1]) for law in laws]
    return Bank(jax.tree.map(lambda *leaves: jnp.stack(leaves), *alike), a, b, jnp.asarray((FLOOR * half) ** 2, float))
