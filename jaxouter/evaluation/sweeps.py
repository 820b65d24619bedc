"""Sweeps: the MAE of a policy over one or two parameters of the plant that it was never told of.

A sweep is a scenario whose episodes are the points of a grid, row-major over its axes, times the noise seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from jaxouter import plants, tasks
from jaxouter.evaluation import scenarios
from jaxouter.evaluation.rollout import Traces
from jaxouter.evaluation.scenarios import Scenario
from jaxouter.tasks import Axis


@dataclass(frozen=True)
class Sweep:
    """A grid of episodes: that of point i (row-major) and noise seed j is number i * repeats + j."""

    id: str
    axes: tuple[Axis, ...]  # one or two
    scenario: Scenario
    repeats: int  # noise seeds a point

    def mae(self, traces: Traces) -> np.ndarray:
        """Mean of |r_k - y_(k+1)| at each point, of the grid's shape, over its repeats; nan where one is not finite."""
        with np.errstate(invalid="ignore", over="ignore"):
            each = np.mean(np.abs(traces.r - traces.y), axis=1, dtype=np.float64)
        grid = each.reshape(*(len(axis.values) for axis in self.axes), self.repeats).mean(-1)
        return np.where(np.isfinite(grid), grid, np.nan)


Builder = Callable[[bool], Sweep]


def _declared(plant: str, name: str, spec: tasks.Sweep) -> Builder:
    """The sweep of that name that the plant's task declares; of the coarse grid's axes some values only."""
    identifier = f"{plant}/{name}"

    def build(coarse: bool) -> Sweep:
        axes = [_around(axis, plants.parameters(plant).get(axis.name)) for axis in spec.axes]
        chosen = tuple(_thinned(axis, spec.stride) if coarse else axis for axis in axes)
        grids = np.meshgrid(*(axis.values for axis in chosen), indexing="ij")
        values = [jnp.asarray(np.repeat(grid.ravel(), spec.repeats), float) for grid in grids]
        base = scenarios.get(f"{plant}/{spec.scenario}", len(values[0]))
        if spec.vary is None:
            varied = replace(base, sensor=replace(base.sensor, noise=values[0]))
        else:
            varied = replace(base, params=spec.vary(base.params, spec.repeats, *values))
        # The same noise at each point, so that points differ by their parameters alone.
        keys = base.keys[jnp.arange(len(values[0])) % spec.repeats]
        return Sweep(identifier, chosen, replace(varied, id=identifier, keys=keys, paper=None), spec.repeats)

    return build


def _around(axis: Axis, value: float | None) -> Axis:
    """The axis with this nominal value, if any; it is added to the values."""
    return axis if value is None else replace(axis, nominal=value, values=tuple(sorted({*axis.values, value})))


def _thinned(axis: Axis, stride: int) -> Axis:
    """Every so many-th value, the nominal one among them."""
    return replace(axis, values=axis.values[axis.values.index(axis.nominal) % stride :: stride])


def catalogue(name: str) -> dict[str, Builder]:
    """Every sweep that a plant's task declares: id -> function of whether the grid is coarse.

    Raises:
        ValueError: there is no such plant; lists those that exist.
    """
    return {f"{name}/{key}": _declared(name, key, spec) for key, spec in tasks.of(name).sweeps.items()}


def builder(identifier: str) -> Builder:
    """The function that makes the sweep called `identifier`, such as `pitch/pilot-delay`.

    Raises:
        ValueError: there is no such plant or sweep; lists those that exist.
    """
    name = scenarios.plant_of(identifier)
    sweeps = catalogue(name)
    if identifier not in sweeps:
        raise ValueError(f"there is no sweep {identifier!r}; {name} has: {', '.join(sweeps) or 'none'}")
    return sweeps[identifier]


def identifiers(plant: str, names: Sequence[str]) -> list[str]:
    """Ids of sweeps of a plant, from ids as for `scenarios.identifiers`.

    Raises:
        ValueError: there is no such sweep, or it is another plant's.
    """
    found = scenarios.of_plant(plant, names)
    for name in found:
        builder(name)
    return found


def get(identifier: str, coarse: bool = False) -> Sweep:
    """The sweep called `identifier`.

    Args:
        identifier: plant/sweep.
        coarse: a few of its values only, for policies that solve a program at each step.

    Raises:
        ValueError: there is no such plant or sweep; lists those that exist.
    """
    return builder(identifier)(coarse)
