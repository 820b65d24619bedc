"""Records of a plant under random r~, the data for identification."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxouter.loop.references import telegraph
from jaxouter.plants import Plant, host, simulate
from jaxouter.plants.base import RUN_ONCE


class Record(NamedTuple):
    """Signals of excited episodes, oldest first."""

    r_tilde: np.ndarray  # (episodes, T), held over each control step
    y: np.ndarray  # (episodes, T + 1), y_0 to y_T


def record(plant: Plant, params: Any, key: chex.PRNGKey, episodes: int) -> Record:
    """Record r~ and y under random levels of r~ over its whole range.

    Each episode starts like a training episode and has its own rate of redrawing the level, log-uniform from four times
    per episode to every other step.
    """
    keys, n = jax.random.split(key, episodes), host.side_by_side(plant) or episodes
    parts = [_episodes(plant, params, keys[i : i + n]) for i in range(0, episodes, n)]
    return Record(*(np.concatenate(column).astype(np.float64) for column in zip(*parts, strict=True)))


@partial(jax.jit, static_argnums=0, compiler_options=RUN_ONCE)
def _episodes(plant: Plant, params: Any, keys: chex.PRNGKey) -> tuple[jax.Array, jax.Array]:
    """r~ (episodes, T) and y (episodes, T + 1)."""

    def episode(key: chex.PRNGKey) -> tuple[jax.Array, jax.Array]:
        key_start, key_rate, key_levels, key_run = jax.random.split(key, 4)
        steps = plant.episode_steps
        rate = jnp.exp(jax.random.uniform(key_rate, (), float, jnp.log(4.0 / steps), jnp.log(0.5)))
        r_tilde = telegraph(key_levels, steps, *plant.r_tilde_bounds, rate)
        state = plant.training_start(key_start, params)
        y0 = plant.output(params, state)
        y = simulate(plant, params, r_tilde, key_run, state)
        return r_tilde, jnp.concatenate([y0[None], y])

    return jax.vmap(episode)(keys)


def within(data: Record, bounds: tuple[float, float], beyond: float = 4.0) -> Record:
    """The record with y replaced by nan from where it leaves the bounds by more than `beyond` times their range."""
    low, high = bounds
    far = beyond * (high - low)
    gone = np.maximum.accumulate(~((data.y >= low - far) & (data.y <= high + far)), axis=1)
    return data._replace(y=np.where(gone, np.nan, data.y))
