"""Whitening of observations: consecutive samples of y differ little, but these differences tell the plant's state.

A network on whitened observations learns them all alike. The whitening is linear, so an actor's first layer can take it
in: exported, it is an actor on plain observations.
"""

from __future__ import annotations

from typing import Any, NamedTuple

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
