"""The controller as StableHLO, serialised by `jax.export`: callable from JAX without this package.

    act = jax.export.deserialize(bytearray(path.read_bytes())).call
    r_tilde, y_past, r_tilde_past, integral = act(r, y, y_past, r_tilde_past, integral)

All are float32. Before the first step y_past (M,) is filled with the first y, r_tilde_past (M,) with that y clipped to
the bounds of r~, and integral is 0.

With a bank of L base laws three more arguments and results follow: mean_error (L,) and performance (L,), 0 before the
first step, and active, int32, -1 before it.
"""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
from jax import export

from jaxouter.loop.bank import Evidence
from jaxouter.loop.observation import Memory
from jaxouter.training.policy import LearnedParams, LearnedPolicy

try:
    import flatbuffers  # noqa: F401
except ImportError as error:
    raise ImportError("jax.export needs FlatBuffers to write files: pip install flatbuffers") from error

PLATFORMS = ("cpu", "cuda", "rocm", "tpu")


def exported(policy: LearnedPolicy, params: LearnedParams) -> export.Exported:
    """`policy.act` with its parameters as constants, for each of `PLATFORMS`."""
    numbers = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), params)
    laws = policy.observer.laws

    def outer_loop(
        r: jax.Array,
        y: jax.Array,
        y_past: jax.Array,
        r_tilde_past: jax.Array,
        integral: jax.Array,
        *evidence: jax.Array,
    ) -> tuple[jax.Array, ...]:
        carry = Memory(y_past, r_tilde_past, integral, Evidence(*evidence) if laws else ())
        memory, r_tilde = policy.act(numbers, carry, r, y)
        return r_tilde, memory.y_past, memory.r_tilde_past, memory.integral, *memory.evidence

    number = jax.ShapeDtypeStruct((), np.float32)
    past = jax.ShapeDtypeStruct((policy.observer.remembered,), np.float32)
    each = jax.ShapeDtypeStruct((laws,), np.float32)
    evidence = (each, each, jax.ShapeDtypeStruct((), np.int32)) if laws else ()
    with jax.default_matmul_precision("highest"):  # else GPUs and TPUs round the inputs of matrix products
        return export.export(jax.jit(outer_loop), platforms=PLATFORMS)(number, number, past, past, number, *evidence)


def save(policy: LearnedPolicy, params: LearnedParams, path: Path) -> None:
    """Write a file for `jax.export.deserialize`."""
    path.write_bytes(exported(policy, params).serialize())
