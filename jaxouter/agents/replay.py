"""Replay: a ring of rows for each of E environments, in one float32 array, sampled in windows of consecutive rows.

The last rows of the ring stand once more in front of the first, so that every window is one contiguous slice, also
where the ring wraps around. A row is a record of named fields; the field `age` (steps since the reset) is required: it
tells which rows of a window belong to one episode.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp


class ReplayState(NamedTuple):
    """Contents of the replay."""

    rows: jax.Array  # (E, mirror + steps, width), float32
    written: jax.Array  # int32, rows written so far in each environment


@dataclass(frozen=True)
class Replay:
    """Layout of a replay. Static and hashable."""

    fields: tuple[str, ...]
    """Names of a row's columns."""
    environments: int
    steps: int
    """Rows kept for each environment."""
    lead: int
    """Rows before the first one of a window that come with it (the history of an observation)."""
    window: int = 1
    """Rows of a window that may be used as transitions (n of n-step returns)."""

    def __post_init__(self) -> None:
        if self.steps <= 2 * self.mirror:
            raise ValueError(
                f"the replay keeps {self.steps} steps of each of {self.environments} environments, "
                f"but windows are {self.mirror + 1} steps long; it must keep more than {2 * self.mirror}"
            )

    @property
    def mirror(self) -> int:
        """Rows that stand twice."""
        return self.lead + self.window - 1

    def init(self) -> ReplayState:
        """An empty replay."""
        shape = (self.environments, self.mirror + self.steps, len(self.fields))
        return ReplayState(jnp.zeros(shape, jnp.float32), jnp.zeros((), jnp.int32))

    def write(self, state: ReplayState, rows: jax.Array) -> ReplayState:
        """Add one row (width,) of each environment: rows (E, width)."""
        chex.assert_shape(rows, (self.environments, len(self.fields)))
        slab = rows.astype(jnp.float32)[:, None, :]
        position = state.written % self.steps + self.mirror
        twin = jnp.where(position >= self.steps, position - self.steps, position)
        buffer = jax.lax.dynamic_update_slice_in_dim(state.rows, slab, position, 1)
        buffer = jax.lax.dynamic_update_slice_in_dim(buffer, slab, twin, 1)
        return ReplayState(buffer, state.written + 1)

    def take_back(self, state: ReplayState) -> tuple[ReplayState, jax.Array]:
        """The state without the rows (E, width) of the last `write`, and these; writing them again gives it back.

        What `sample` draws from it is what it drew before that `write`.
        """
        position = (state.written - 1) % self.steps + self.mirror
        rows = jax.lax.dynamic_slice_in_dim(state.rows, position, 1, 1)[:, 0]
        return state._replace(written=state.written - 1), rows.astype(float)

    def sample(self, state: ReplayState, bits: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Windows drawn uniformly, with replacement.

        At least `window` rows must have been written. Once the ring is full, rows whose lead is already overwritten,
        or will be by the next `write`, are not drawn.

        Args:
            state: contents.
            bits: random, (n, 2), uint32, as of `jax.random.bits`: which environments, and which of their rows.

        Returns:
            rows (n, lead + window, width) and `valid` (n, lead + window): which rows lie in the same episode as row
            `lead`, the first transition. Rows that are not valid hold other episodes, or nothing.
        """
        chex.assert_type(bits, jnp.uint32)
        oldest = jnp.maximum(self.window - 1, state.written - self.steps + self.mirror + 1)
        environment = (bits[:, 0] % jnp.uint32(self.environments)).astype(jnp.int32)
        # Number of a window's last row. The remainder favours early rows by at most their number over 2^32.
        last = oldest + (bits[:, 1] % (state.written - oldest).astype(jnp.uint32)).astype(jnp.int32)
        size = (1, self.mirror + 1, len(self.fields))
        rows = jax.vmap(lambda e, i: jax.lax.dynamic_slice(state.rows, (e, i, jnp.zeros_like(i)), size)[0])(
            environment, last % self.steps
        )
        rows = rows.astype(float)  # the float of the learner
        age = rows[:, :, self.fields.index("age")]
        offset = jnp.arange(self.mirror + 1, dtype=age.dtype) - self.lead
        return rows, age - age[:, self.lead, None] == offset[None, :]
