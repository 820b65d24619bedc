"""Plants: physics only, no learning. A new plant is one file and one line in `REGISTRY`."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import chex
import jax

from jaxouter.plants import heaters, pitch, versions
from jaxouter.plants.base import Plant, outputs

__all__ = ["REGISTRY", "Plant", "Ranges", "make", "randomised", "resolve", "simulate"]

Ranges = tuple[tuple[str, float, float], ...]
"""(name, low, high) of each parameter that is drawn."""

versions.warn()
SHORT = 4  # longest vector whose elements have names
REGISTRY: dict[str, Callable[..., tuple[Plant, Any]]] = {"pitch": pitch.make, "heaters": heaters.make}


def resolve(name: str) -> Callable[..., tuple[Plant, Any]]:
    """The `make` function of the plant called `name`.

    Raises:
        ValueError: there is no such plant; lists the plants.
    """
    if name not in REGISTRY:
        raise ValueError(f"there is no plant {name!r}; the plants are: {', '.join(REGISTRY)}")
    return REGISTRY[name]


def make(name: str, **overrides: Any) -> tuple[Plant, Any]:
    """A plant and its parameters, by name.

    For example: `plant, params = make("pitch", tau=0.5, d1=0.57)`.

    Args:
        name: `pitch`, `heaters` or another key of `REGISTRY`.
        **overrides: keyword arguments of the plant's own `make`, such as `jaxouter.plants.pitch.make`.

    Raises:
        ValueError: unknown plant or override (lists the known ones), or a wrong value.
    """
    maker = resolve(name)
    known = list(inspect.signature(maker).parameters)
    unknown = [key for key in overrides if key not in known]
    if unknown:
        raise ValueError(f"plant {name!r} has no parameter {', '.join(unknown)}; it has: {', '.join(known)}")
    return maker(**overrides)


def numbers(params: Any) -> dict[str, tuple[int, tuple[int, ...]]]:
    """Scalar parameters of a plant, including elements of short vectors: name -> (leaf, index in it)."""
    found: dict[str, tuple[int, tuple[int, ...]]] = {}
    for i, (path, leaf) in enumerate(jax.tree_util.tree_leaves_with_path(params)):
        name = getattr(path[-1], "name", "")
        if jax.numpy.ndim(leaf) == 0:
            found[name] = i, ()
        elif jax.numpy.ndim(leaf) == 1 and len(leaf) <= SHORT:
            found |= {f"{name}[{j}]": (i, (j,)) for j in range(len(leaf))}
    return found


def randomised(plant: Plant, params: Any, ranges: Ranges) -> tuple[Plant, Any]:
    """The plant with some parameters drawn uniformly for each episode (domain randomisation).

    For example: `plant, params = randomised(*make("pitch"), (("gain", 0.8, 1.2), ("d1", 0.0, 0.7)))`.

    Args:
        plant, params: as `make` returns them.
        ranges: parameters such as `gain` or `W[1]`, each with its least and greatest value.

    Returns:
        The plant, now with a `draw`, and its parameters; those not drawn are unchanged.

    Raises:
        ValueError: a name is not a scalar parameter of the plant (lists those), or a range is not one.
    """
    if plant.identified:
        raise ValueError(f"plant {plant.name!r} has nothing to draw by a range; its models are drawn, see log:FILE")
    named = {name: (low, high) for name, low, high in ranges}
    known = numbers(params)
    for name, (low, high) in named.items():
        if name not in known:
            raise ValueError(f"plant {plant.name!r} has no number {name!r} to draw; it has: {', '.join(sorted(known))}")
        if not low <= high:
            raise ValueError(f"the range of {name} is {low:g} to {high:g}; the first must not be above the second")
    return _drawing(plant, tuple((*known[name], *ends) for name, ends in named.items())), plant.widened(params, named)


@cache
def _drawing(plant: Plant, drawn: tuple[tuple[int, tuple[int, ...], float, float], ...]) -> Plant:
    """The plant that draws these elements of these leaves; cached, so that it is compiled once."""

    def draw(key: chex.PRNGKey, params: Any) -> Any:
        leaves, structure = jax.tree.flatten(params)
        for share, (leaf, element, low, high) in zip(jax.random.uniform(key, (len(drawn),), float), drawn, strict=True):
            leaves[leaf] = leaves[leaf].at[element].set(low + (high - low) * share)
        return jax.tree.unflatten(structure, leaves)

    return replace(plant, draw=draw)


@partial(jax.jit, static_argnums=0)
def _simulate(plant: Plant, params: Any, state: Any, r_tilde: jax.Array, key: chex.PRNGKey) -> jax.Array:
    return outputs(plant, params, state, r_tilde, jax.random.split(key, r_tilde.shape[0]))


def simulate(plant: Plant, params: Any, r_tilde: Any, key: chex.PRNGKey, state: Any = None) -> jax.Array:
    """Run the plant alone on a sequence of modified references.

    Args:
        plant, params: as `make` returns them.
        r_tilde: (T,), in the plant's unit, each held for one control step.
        key: randomness of start and noise.
        state: initial state; None: at rest (heaters: the given temperatures).

    Returns:
        y (T,), the output after each control step.

    Raises:
        ValueError: r_tilde is not a sequence of numbers.
    """
    r_tilde = jax.numpy.asarray(r_tilde, dtype=float)
    if r_tilde.ndim != 1:
        raise ValueError(f"r_tilde has shape {r_tilde.shape}; it must be one sequence, of shape (T,)")
    key_start, key_noise = jax.random.split(key)
    state = plant.init(key_start, params) if state is None else state
    return _simulate(plant, params, state, r_tilde, key_noise)
