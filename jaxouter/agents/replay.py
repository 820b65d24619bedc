"""Replay: one ring buffer of rows per environment, sampled in windows of consecutive rows.

All rings share one float32 array. The last rows of a ring are mirrored in front of its first, so that every window is
one contiguous slice, even where the ring wraps around. A row has named fields. The field `age` (steps since the reset)
is required: it tells which rows of a window belong to one episode.
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
    """Names of the columns."""
    environments: int
    steps: int
    """Rows kept per environment."""
    lead: int
    """Extra rows in front of a window (the history of an observation)."""
    window: int = 1
    """Rows of a window that can be used as transitions (n of n-step returns)."""

    def __post_init__(self) -> None:
        if self.steps <= 2 * self.mirror:
            raise ValueError(
                f"the replay keeps {self.steps} steps of each of {self.environments} environments, "
                f"but windows are {self.mirror + 1} steps long; it must keep more than {2 * self.mirror}"
            )

    @property
    def mirror(self) -> int:
        """Rows that are stored twice."""
        return self.lead + self.window - 1

    def init(self) -> ReplayState:
        """An empty replay."""
        shape = (self.environments, self.mirror + self.steps, len(self.fields))
        return ReplayState(jnp.zeros(shape, jnp.float32), jnp.zeros((), jnp.int32))

    def write(self, state: ReplayState, rows: jax.Array) -> ReplayState:
        """Add one row per environment: rows (E, width)."""
        chex.assert_shape(rows, (self.environments, len(self.fields)))
        slab = rows.astype(jnp.float32)[:, None, :]
        position = state.written % self.steps + self.mirror
        twin = jnp.where(position >= self.steps, position - self.steps, position)
        buffer = jax.lax.dynamic_update_slice_in_dim(state.rows, slab, position, 1)
        buffer = jax.lax.dynamic_update_slice_in_dim(buffer, slab, twin, 1)
        return ReplayState(buffer, state.written + 1)

    def take_back(self, state: ReplayState) -> tuple[ReplayState, jax.Array]:
        """Undo the last `write`: the state before it, and its rows (E, width). Writing them again restores the state.

        From the returned state, `sample` draws what it drew before that `write`.
        """
        position = (state.written - 1) % self.steps + self.mirror
        rows = jax.lax.dynamic_slice_in_dim(state.rows, position, 1, 1)[:, 0]
        return state._replace(written=state.written - 1), rows.astype(float)

    def sample(self, state: ReplayState, bits: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Windows drawn uniformly, with replacement.

        At least `window` rows must have been written. Once the ring is full, a row is not drawn if its lead is already
        overwritten or will be by the next `write`.

        Args:
            state: contents.
            bits: (n, 2), uint32, as from `jax.random.bits`; they choose the environments and their rows.

        Returns:
            rows (n, lead + window, width) and `valid` (n, lead + window): whether a row is in the same episode as row
            `lead`, the first transition. Other rows hold other episodes, or nothing.
        """
        chex.assert_type(bits, jnp.uint32)
        oldest = jnp.maximum(self.window - 1, state.written - self.steps + self.mirror + 1)
        environment = (bits[:, 0] % jnp.uint32(self.environments)).astype(jnp.int32)
        # Index of a window's last row. The remainder favours early rows, by at most (number of rows) / 2^32.
        last = oldest + (bits[:, 1] % (state.written - oldest).astype(jnp.uint32)).astype(jnp.int32)
        size = (1, self.mirror + 1, len(self.fields))
        rows = jax.vmap(lambda e, i: jax.lax.dynamic_slice(state.rows, (e, i, jnp.zeros_like(i)), size)[0])(
            environment, last % self.steps
        )
        rows = rows.astype(float)  # the learner's float
        age = rows[:, :, self.fields.index("age")]
        offset = jnp.arange(self.mirror + 1, dtype=age.dtype) - self.lead
        return rows, age - age[:, self.lead, None] == offset[None, :]
