"""Plants: physics only, no learning. A new plant is one file and one line in `REGISTRY`."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial, wraps
from typing import Any

import chex
import jax
import numpy as np

from jaxouter.plants import declaration, heaters, pitch
from jaxouter.plants.base import Plant, outputs
from jaxouter.plants.errors import Raised, said

__all__ = ["REGISTRY", "Plant", "Ranges", "make", "randomised", "resolve", "simulate", "with_parameters"]

Ranges = tuple[tuple[str, float, float], ...]
"""(name, low, high) of each parameter that is drawn."""

SHORT = 4  # longest vector whose elements have names
REGISTRY: dict[str, Callable[..., tuple[Plant, Any]]] = {"pitch": pitch.make, "heaters": heaters.make}


def resolve(name: str) -> Callable[..., tuple[Plant, Any]]:
    """The `make` function of the plant called `name`.

    Raises:
        ValueError: there is no such plant; lists the plants.
    """
    if base(name) not in REGISTRY:
        raise ValueError(f"there is no plant {name!r}; the plants are: {', '.join(REGISTRY)}")
    return REGISTRY[name] if name in REGISTRY else _derived(name)


def base(name: str) -> str:
    """The registered name in a plant's name: that of `pitch(tau=0.7)` is `pitch`."""
    return name.partition("(")[0]


def parameters(name: str) -> dict[str, Any]:
    """The parameters that a plant's name sets: those of `pitch(tau=0.7)` are `{"tau": 0.7}`.

    Raises:
        ValueError: they can't be read.
    """
    _, opened, inner = name.partition("(")
    if not opened:
        return {}
    try:
        call = ast.parse(f"plant({inner}", mode="eval").body
        if not isinstance(call, ast.Call) or call.args or any(each.arg is None for each in call.keywords):
            raise ValueError(name)
        return {str(each.arg): ast.literal_eval(each.value) for each in call.keywords}
    except (ValueError, SyntaxError):
        raise ValueError(f"{name!r} is not a plant's name with parameters, such as pitch(tau=0.7)") from None


def with_parameters(name: str, settings: Mapping[str, Any]) -> str:
    """The name of a plant with parameters set, by which it is made like any other.

    For example: `with_parameters("pitch", {"tau": 0.7})` is `"pitch(tau=0.7)"`. Scenarios and sweeps that give a
    parameter another value keep that.

    Args:
        name: a plant's name; those parameters that it sets already are kept.
        settings: numbers, or nested lists or arrays of numbers, by the name that the plant's maker has for them.

    Raises:
        ValueError: unknown plant or parameter (lists the known ones), or a wrong value.
    """
    if not settings:
        return name
    values = parameters(name) | {key: _literal(key, value) for key, value in settings.items()}
    known = list(inspect.signature(resolve(name)).parameters)
    ordered = {key: values[key] for key in (*known, *values) if key in values}
    named = f"{base(name)}({', '.join(f'{key}={value!r}' for key, value in ordered.items())})"
    try:
        make(base(name), **ordered)
    except ValueError:
        raise
    except Raised as error:
        raise ValueError(f"{named} can't be made: {said(error)}") from error
    return named


def slug(name: str) -> str:
    """A plant's name as part of a file's name: that of `pitch(tau=0.7)` is `pitch-tau-0.7`."""
    return re.sub(r"[^\w.+-]+", "-", name).rstrip("-")


def _literal(name: str, value: Any) -> Any:
    """A parameter's value as plain Python numbers and tuples."""

    def of(value: Any) -> Any:
        return tuple(map(of, np.asarray(value))) if getattr(value, "ndim", 0) else declaration.plain(value)

    plain = of(value)
    try:
        if ast.literal_eval(repr(plain)) == plain:
            return plain
    except (ValueError, SyntaxError):
        pass
    raise ValueError(f"{name} is {value!r}; it must be a finite number, or a list or array of finite numbers")


@cache
def _derived(name: str) -> Callable[..., tuple[Plant, Any]]:
    """The maker of a plant whose name sets parameters."""
    maker, values = REGISTRY[base(name)], parameters(name)

    @cache
    def renamed(plant: Plant) -> Plant:  # cached, so that it is compiled once
        return replace(plant, name=name)

    @cache
    def nominal() -> tuple[Plant, Any]:  # likewise, where the maker gives another plant each time
        return maker(**values)

    @wraps(maker)
    def made(**overrides: Any) -> tuple[Plant, Any]:
        plant, params = maker(**values | overrides) if overrides else nominal()
        return renamed(plant), params

    return made


def make(name: str, **overrides: Any) -> tuple[Plant, Any]:
    """A plant and its parameters, by name.

    For example: `plant, params = make("pitch", tau=0.5, d1=0.57)`.

    Args:
        name: `pitch`, `heaters` or another key of `REGISTRY`; or one with parameters, such as `pitch(tau=0.7)`.
        **overrides: keyword arguments of the plant's own `make`, such as `jaxouter.plants.pitch.make`.

    Raises:
        ValueError: unknown plant or override (lists the known ones), or a wrong value.
    """
    maker = resolve(name)
    known = list(inspect.signature(maker).parameters)
    unknown = [key for key in overrides if key not in known]
    if unknown:
        there = f"it has: {', '.join(known)}" if known else "its maker takes none"
        raise ValueError(f"plant {name!r} has no parameter {', '.join(unknown)}; {there}")
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
        shares = jax.random.uniform(key, (len(drawn),), float)
        values = [low + (high - low) * share for share, (_, _, low, high) in zip(shares, drawn, strict=True)]
        return _with(params, [(*each[:2], value) for each, value in zip(drawn, values, strict=True)])

    return replace(plant, draw=draw)


def with_numbers(params: Any, values: Mapping[str, float]) -> Any:
    """Parameters of a plant with other numbers, such as `W[1]`, by names that `numbers` knows."""
    known = numbers(params)
    return _with(params, [(*known[name], value) for name, value in values.items()])


def _with(params: Any, values: Sequence[tuple[int, tuple[int, ...], Any]]) -> Any:
    """The parameters with these elements of these leaves."""
    leaves, structure = jax.tree.flatten(params)
    for leaf, element, value in values:
        leaves[leaf] = leaves[leaf].at[element].set(value)
    return jax.tree.unflatten(structure, leaves)


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
