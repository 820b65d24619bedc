"""Sweeps: the MAE of a policy over one or two parameters of the plant that it was never told of.

A sweep is a scenario whose episodes are the points of a grid, row-major over its axes, times the noise seeds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxouter.evaluation import scenarios
from jaxouter.evaluation.rollout import Traces
from jaxouter.evaluation.scenarios import Scenario
from jaxouter.plants import resolve

HOUSES = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0, 10000.0)


@dataclass(frozen=True)
class Axis:
    """One parameter and the values that it takes."""

    name: str
    unit: str
    values: tuple[float, ...]
    nominal: float

    def __post_init__(self) -> None:
        if self.nominal not in self.values:
            raise ValueError(f"axis {self.name!r}: nominal is {self.nominal}; it must be one of {self.values}")


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
Vary = Callable[..., Scenario]
"""`vary(base, repeats, *values)`: the base scenario with each axis' values (episodes,)."""


def _axis(name: str, unit: str, low: float, high: float, count: int, nominal: float) -> Axis:
    return Axis(name, unit, tuple(np.linspace(low, high, count).round(6).tolist()), nominal)


def _sweep(base: str, name: str, axes: tuple[Axis, ...], stride: int, repeats: int, vary: Vary) -> tuple[str, Builder]:
    """Id and builder; of the coarse grid's axes each has every `stride`-th value only."""
    identifier = f"{base.split('/')[0]}/{name}"

    def build(coarse: bool) -> Sweep:
        chosen = tuple(replace(axis, values=axis.values[:: stride if coarse else 1]) for axis in axes)
        grids = np.meshgrid(*(axis.values for axis in chosen), indexing="ij")
        values = [jnp.asarray(np.repeat(grid.ravel(), repeats), float) for grid in grids]
        scenario = vary(scenarios.get(base, len(values[0])), repeats, *values)
        # The same noise at each point, so that points differ by their parameters alone.
        keys = scenario.keys[jnp.arange(len(values[0])) % repeats]
        return Sweep(identifier, chosen, replace(scenario, id=identifier, keys=keys, paper=None), repeats)

    return identifier, build


def _parameters(*names: str, **static: Any) -> Vary:
    """Vary fields of the plant's own parameters; `static` ones are set once."""

    def vary(base: Scenario, repeats: int, *values: jax.Array) -> Scenario:
        del repeats
        return replace(base, params=base.params.replace(**dict(zip(names, values, strict=True)), **static))

    return vary


def _noise(base: Scenario, repeats: int, noise: jax.Array) -> Scenario:
    """Measurement noise, in the unit of y."""
    del repeats
    return replace(base, sensor=replace(base.sensor, noise=noise))


def _houses(base: Scenario, repeats: int, houses: jax.Array) -> Scenario:
    """So many houses count; the others, there for one shape to serve all, have no weight."""
    del repeats
    counts = jnp.arange(int(max(HOUSES)), dtype=houses.dtype)[None, :] < houses[:, None]
    return replace(base, params=base.params.replace(weights=jnp.where(counts, 1.0 / houses[:, None], 0.0)))


def _x_out(base: Scenario, repeats: int, x_out: jax.Array) -> Scenario:
    del repeats
    return replace(base, params=base.params.replace(house=base.params.house.replace(x_out=x_out)))


def _heterogeneity(base: Scenario, repeats: int, spread: jax.Array) -> Scenario:
    """Ca and Ua uniform within `spread` % from house to house, another stock in each repeat; each law uses its own."""
    house, (episodes, n) = base.params.house, base.params.weights.shape
    stock = jax.random.uniform(jax.random.key(2), (2, repeats, n), float, -1.0, 1.0)
    factor = 1.0 + spread[None, :, None] / 100.0 * stock[:, jnp.arange(episodes) % repeats]
    house = house.replace(Ca=house.Ca[:, None] * factor[0], Ua=house.Ua[:, None] * factor[1])
    return replace(base, params=base.params.replace(house=house))


def catalogue(name: str) -> dict[str, Builder]:
    """Every sweep of a plant: id -> function of whether the grid is coarse. A plant without its own has none.

    Raises:
        ValueError: there is no such plant; lists those that exist.
    """
    resolve(name)
    delays = (_axis("d1", "s", 0.0, 6.0, 25, 0.0), _axis("d2", "s", 0.0, 6.0, 25, 0.0))
    tau, gain = _axis("tau", "s", 0.0, 2.0, 21, 0.5), _axis("gain", "1", 0.5, 1.5, 21, 1.0)
    noise_pitch, noise_heaters = _axis("noise", "crad", 0.0, 1.0, 21, 0.0), _axis("noise", "degC", 0.0, 0.5, 21, 0.0)
    x_out, spread = _axis("x_out", "degC", -20.0, 10.0, 13, -5.0), _axis("spread", "%", 0.0, 50.0, 11, 0.0)
    # The longest delay sets the length of the delay lines, and with it the cost of a step: no longer than needed.
    pitch, heaters = partial(_sweep, "pitch/paper"), partial(_sweep, "heaters/paper-1000")
    own = {
        "pitch": [
            pitch("pilot-delay", (tau,), 5, 1, _parameters("tau", max_delay=2.0, late=None)),
            pitch("controller-delays", delays, 6, 1, _parameters("d1", "d2", max_delay=6.0, late=None)),
            pitch("gain", (gain,), 5, 1, _parameters("gain")),
            pitch("sensor-noise", (noise_pitch,), 5, 8, _noise),
        ],
        "heaters": [
            heaters("houses", (Axis("houses", "1", HOUSES, 1000.0),), 2, 2, _houses),
            heaters("x-out", (x_out,), 3, 4, _x_out),
            heaters("heterogeneity", (spread,), 2, 4, _heterogeneity),
            heaters("sensor-noise", (noise_heaters,), 5, 4, _noise),
        ],
    }
    return dict(own.get(name, []))


def builder(identifier: str) -> Builder:
    """The function that makes the sweep called `identifier`, such as `pitch/pilot-delay`.

    Raises:
        ValueError: there is no such plant or sweep; lists those that exist.
    """
    name = identifier.split("/")[0]
    sweeps = catalogue(name)
    if identifier not in sweeps:
        raise ValueError(f"there is no sweep {identifier!r}; {name} has: {', '.join(sweeps) or 'none'}")
    return sweeps[identifier]


def get(identifier: str, coarse: bool = False) -> Sweep:
    """The sweep called `identifier`.

    Args:
        identifier: plant/sweep.
        coarse: a few of its values only, for policies that solve a program at each step.

    Raises:
        ValueError: there is no such plant or sweep; lists those that exist.
    """
    return builder(identifier)(coarse)
