"""The policy protocol, and the two simplest policies."""

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


class AffineParams(NamedTuple):
    """r~ = offset + slope * r."""

    slope: jax.Array
    offset: jax.Array


@dataclass(frozen=True)
class Affine:
    """r~ = offset + slope r, clipped. Slope 1 is the inner loop alone, slope 1 / gain the static prefilter."""

    r_tilde_bounds: tuple[float, float]
    host: bool = False

    def init(self, params: AffineParams, r0: jax.Array, y0: jax.Array) -> tuple[()]:
        """Nothing to remember."""
        del params, r0, y0
        return ()

    def act(
        self, params: AffineParams, carry: tuple[()], r: jax.Array, y: jax.Array, key: chex.PRNGKey | None = None
    ) -> tuple[tuple[()], jax.Array]:
        """The affine map."""
        del y, key
        return carry, jnp.clip(params.offset + params.slope * r, *self.r_tilde_bounds)


def none(plant: Plant) -> tuple[Affine, AffineParams]:
    """The inner loop alone: r~ = r."""
    return Affine(plant.r_tilde_bounds), AffineParams(jnp.ones(()), jnp.zeros(()))
