"""The policy protocol, and the two simplest policies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import chex
import jax
import jax.numpy as jnp

from jaxouter.plants import Plant


class Policy(Protocol):
    """An outer loop: sees r and y, chooses r~. Pure and jit-able, unless `host` is True: then plain NumPy or Python.

    A JAX policy must be hashable (a frozen dataclass); what is learned or tuned goes into `params`, a pytree.

    A host policy gets NumPy scalars and no key: one that draws keeps a generator of its own in the carry. Where it
    cannot decide it returns nan, or raises ArithmeticError or LinAlgError: that episode then counts as diverged.
    """

    @property
    def host(self) -> bool:
        """Whether it is plain NumPy or Python."""
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
    """r~ = offset + slope r, clipped: with slope 1 the inner loop alone, with 1 / gain the static prefilter."""

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
