"""The policy protocol, and policies that are linear: base laws."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import chex
import jax
import jax.numpy as jnp

from jaxouter.plants import Plant


class Policy(Protocol):
    """An outer loop: sees r and y, chooses r~. Pure and jittable JAX, or plain NumPy or Python if `host` is True.

    A JAX policy must be hashable (a frozen dataclass). What is learned or tuned goes into `params`, a pytree.

    A host policy gets NumPy scalars and no key; if it needs random numbers, its carry holds a generator. If it cannot
    decide, it returns nan or raises ArithmeticError or LinAlgError: that episode then counts as diverged.
    """

    @property
    def host(self) -> bool:
        """Whether it is plain NumPy or Python instead of JAX."""
        ...

    def init(self, params: Any, r0: Any, y0: Any) -> Any:
        """Carry before the first step, from the first reference and output."""
        ...

    def act(self, params: Any, carry: Any, r: Any, y: Any, key: chex.PRNGKey | None = None) -> tuple[Any, Any]:
        """At t_k, from r_k and y_k: the next carry and r~_k (scalar, within its bounds)."""
        ...


class LinearLaw(NamedTuple):
    """A base law: r~, before it is clipped, linear in r, y and the last n of both y and r~.

    r~_k = offset + r r_k + y y_k + sum over i from 1 to n of y_past_i (y_(k-i) - y_k) + r_tilde_past_i r~_(k-i)
    """

    offset: jax.Array
    r: jax.Array
    y: jax.Array
    y_past: jax.Array  # (n,), newest first
    r_tilde_past: jax.Array  # (n,), newest first


class Past(NamedTuple):
    """The last n of both y and r~."""

    y_past: jax.Array  # (n,), y_(k-1), y_(k-2), ...
    r_tilde_past: jax.Array  # (n,), r~_(k-1), r~_(k-2), ...

    @classmethod
    def of(cls, y0: jax.Array, lags: int, r_tilde_bounds: tuple[float, float]) -> Past:
        """The past of a loop at rest at y_0: r~ was y_0, clipped to its bounds."""
        return cls(jnp.full(lags, y0), jnp.full(lags, jnp.clip(y0, *r_tilde_bounds)))

    def then(self, y: jax.Array, r_tilde: jax.Array) -> Past:
        """The past one control step later."""
        pushed = ((y, self.y_past), (r_tilde, self.r_tilde_past))
        return Past(*(jnp.concatenate([new[None], old])[: len(old)] for new, old in pushed))


def affine(slope: Any, offset: Any, lags: int = 0) -> LinearLaw:
    """r~ = offset + slope r. Slope 1 is the inner loop alone, slope 1 / gain the static prefilter."""
    nothing = jnp.zeros(lags)
    return LinearLaw(jnp.asarray(offset, float), jnp.asarray(slope, float), jnp.zeros(()), nothing, nothing)


def padded(law: LinearLaw, lags: int) -> LinearLaw:
    """The same law in JAX numbers, with zeros for further lags."""
    offset, r, y, *pasts = (jnp.asarray(each, float) for each in law)
    return LinearLaw(offset, r, y, *(jnp.pad(each, (0, lags - len(each))) for each in pasts))


def unclipped(law: LinearLaw, past: Any, r: jax.Array, y: jax.Array) -> jax.Array:
    """r~ of a base law before it is clipped; `past` is a `Past`, or a `Memory`, of n samples or more."""
    n, r_tilde = law.y_past.shape[0], law.offset + law.r * r
    if not n:
        return r_tilde
    return r_tilde + law.y * y + law.y_past @ (past.y_past[:n] - y) + law.r_tilde_past @ past.r_tilde_past[:n]


@dataclass(frozen=True)
class Linear:
    """A base law as a policy; its past holds what was applied."""

    r_tilde_bounds: tuple[float, float]
    host: bool = False

    def init(self, params: LinearLaw, r0: jax.Array, y0: jax.Array) -> Past:
        """As if the loop were at rest at y_0."""
        del r0
        return Past.of(y0, params.y_past.shape[0], self.r_tilde_bounds)

    def act(
        self, params: LinearLaw, carry: Past, r: jax.Array, y: jax.Array, key: chex.PRNGKey | None = None
    ) -> tuple[Past, jax.Array]:
        """The law, clipped."""
        del key
        r_tilde = jnp.clip(unclipped(params, carry, r, y), *self.r_tilde_bounds)
        return carry.then(y, r_tilde), r_tilde


def none(plant: Plant) -> tuple[Linear, LinearLaw]:
    """The inner loop alone: r~ = r."""
    return Linear(plant.r_tilde_bounds), affine(1.0, 0.0)
