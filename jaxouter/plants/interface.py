"""Checks that a plant implements the interface: shapes, types, purity."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxouter.plants import host
from jaxouter.plants.base import Plant, outputs
from jaxouter.plants.declaration import shown
from jaxouter.plants.errors import PlantError, said

LANES = 4  # plants under vmap
STEPS = 20  # steps compared
ROUNDING = 1e-4  # tolerance between two ways to compute the same y, as share of its range


def shapes(plant: Plant, params: Any) -> None:
    """Trace the functions of a plant; nothing is compiled.

    Raises:
        ValueError: a function fails, or returns something wrong; names it.
    """
    if not isinstance(plant, Plant):
        raise ValueError(f"a plant's maker must return a jaxouter.plants.Plant and its parameters, not {plant!r}")
    key, r_tilde = jax.random.key(0), jnp.zeros(())
    for leaf in jax.tree.leaves(params):
        if not isinstance(leaf, jax.Array | np.ndarray | np.generic | float | int):
            raise ValueError(f"parameters must be a pytree of arrays and numbers; one of them is {leaf!r}")
    state = _traced("init(key, params)", plant.init, key, params)
    starts = [state] if plant.start is None else [state, _traced("start(key, params)", plant.start, key, params)]
    given = jax.eval_shape(lambda: params)
    if plant.draw is not None:
        _same("draw(key, params)", "params", given, _traced("draw(key, params)", plant.draw, key, params))
    for begun in starts:
        after = _traced("step(params, state, r_tilde, key)", plant.step, params, begun, r_tilde, key)
        _same("step(params, state, r_tilde, key)", "state", state, after)
    float_ = jax.ShapeDtypeStruct((), jnp.result_type(float))
    y = _traced("output(params, state)", plant.output, params, state)
    if not isinstance(y, jax.ShapeDtypeStruct) or (y.shape, y.dtype) != (float_.shape, float_.dtype):
        raise ValueError(f"output(params, state) gave {_of(y)}; y must be one number of shape (), {float_.dtype}[]")
    _same("reuse(old, fresh)", "state", state, _traced("reuse(old, fresh)", plant.reuse, state, state))
    _same("noise_free(params)", "params", given, _traced("noise_free(params)", plant.noise_free, params))
    variables = _traced("variables(params, state)", plant.variables, params, state)
    settled = _traced("settled(params, state, variables)", plant.settled, params, state, variables)
    _same("settled(params, state, variables)", "state", state, settled)
    for term in plant.reward_terms:
        signature = f"{term.__name__}(r, y, y_before, r_tilde, r_tilde_before)"
        found = _traced(signature, term, *[r_tilde] * 5)
        if not isinstance(found, jax.ShapeDtypeStruct) or (found.shape, found.dtype) != (float_.shape, float_.dtype):
            raise ValueError(
                f"{signature} gave {_of(found)}; a reward must be one number of shape (), {float_.dtype}[]"
            )
    if plant.members is not None:
        each = _of(_traced("members(params, state)", plant.members, params, state))
        if not re.fullmatch(rf"{float_.dtype}\[\d+\]", each):
            raise ValueError(f"members(params, state) gave {each}; it must be one array of shape (n,), {float_.dtype}")


def _traced(name: str, function: Callable[..., Any], *args: Any) -> Any:
    try:
        return jax.eval_shape(function, *args)
    except PlantError as error:
        raise ValueError(f"{name} failed: {error.what}") from error
    except Exception as error:
        raise ValueError(f"{name} failed: {said(error)}") from error


def _same(name: str, what: str, wanted: Any, got: Any) -> None:
    if jax.tree.structure(wanted) != jax.tree.structure(got):
        raise ValueError(f"{name} returned {jax.tree.structure(got)}; it must have the form of {what}")
    for (path, old), new in zip(jax.tree.leaves_with_path(wanted), jax.tree.leaves(got), strict=True):
        if (old.shape, old.dtype) != (new.shape, new.dtype):
            where = jax.tree_util.keystr(path)
            raise ValueError(f"{name} made {what}{where} {_of(new)}; it must stay {_of(old)}")


def _of(value: Any) -> str:
    leaves = jax.tree.leaves(value)
    return ", ".join(f"{leaf.dtype}{list(leaf.shape)}" for leaf in leaves if hasattr(leaf, "dtype")) or shown(value)


def behaviour_steps(plant: Plant) -> int:
    """Control steps for which `behaviour` runs the plant."""
    return 2 * plant.episode_steps + (1 + 2 * LANES) * STEPS


def behaviour(plant: Plant, params: Any) -> Iterator[tuple[str, str | None]]:
    """Run the plant, and check that it behaves as a pure function of its arguments.

    Yields:
        The requirement, and what is wrong; None: it is met.
    """
    low, high = plant.r_tilde_bounds
    r_tilde = jax.random.uniform(jax.random.key(1), (plant.episode_steps,), float, low, high)
    keys = jax.random.split(jax.random.key(2), LANES)

    def run(params: Any, key: Any, r_tilde: Any) -> Any:
        key_start, key_run = jax.random.split(key)
        state = plant.training_start(key_start, params)
        return outputs(plant, params, state, r_tilde, jax.random.split(key_run, r_tilde.size))

    if (simulators := host.of(plant)) is not None:
        simulators.ended = None
    compiled = jax.jit(run)
    y = np.asarray(compiled(params, keys[0], r_tilde))
    wrong = np.flatnonzero(~np.isfinite(y))
    why = f": {simulators.ended}" if simulators is not None and simulators.ended else ""
    yield (
        "finite under random r~",
        f"y is {y[wrong[0]]} after {wrong[0] + 1} of {y.size} control steps{why}" if wrong.size else None,
    )
    again = np.asarray(compiled(params, keys[0], r_tilde))
    yield "the same again from the same key", None if np.array_equal(y, again, equal_nan=True) else _off(y, again)
    few = r_tilde[:STEPS]
    with jax.disable_jit(plant.differentiable):
        plain = np.asarray(run(params, keys[0], few))
    yield "the same when compiled", _compared(plant, y[:STEPS], plain)
    alone = np.stack([compiled(params, key, few) for key in keys])
    together = np.asarray(jax.jit(jax.vmap(partial(run, params), (0, None)))(keys, few))
    yield "the same side by side, under vmap", _compared(plant, alone, together)


def _compared(plant: Plant, wanted: np.ndarray, got: np.ndarray) -> str | None:
    range_ = max(plant.error_scale, float(np.nanmax(np.abs(wanted), initial=0.0)))
    return None if np.allclose(wanted, got, rtol=0.0, atol=ROUNDING * range_, equal_nan=True) else _off(wanted, got)


def _off(wanted: np.ndarray, got: np.ndarray) -> str:
    return f"y differs by up to {np.nanmax(np.abs(wanted - got)):.3g}"
