"""Task: everything specific to one plant, how it is trained on and where it is evaluated. Plain data."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

from jaxouter.plants import Plant

Options = Mapping[str, Any]
"""Options of `python -m jaxouter.train` by name, such as `steps` or `pretraining.gradient_steps`."""


@dataclass(frozen=True)
class Scenario:
    """Episodes under one reference, from the plant's own start."""

    reference: Sequence[float]
    """Set-points, each held for an equal part of the episode."""
    set: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of the plant's maker; the rest is nominal."""
    change: Mapping[str, Any] = field(default_factory=dict)
    """Parameters that change half way; empty: none."""
    episodes: int = 1
    noise: float = 0.0
    """Standard deviation of the measurement noise, in the unit of y."""
    smooth: bool = False
    """Whether the plant's own noise is negligible; where the sensor has noise, limits are made without it then."""
    stable_alone: bool = True
    """Whether the inner loop alone is stable; if not, an improvement in % means nothing."""
    paper: tuple[float, float] | None = None
    """MAE in the paper: inner loop alone, its DRL."""
    adapt: Callable[[Any], Any] = lambda params: params
    """`adapt(params) -> params`, each leaf (episodes, ...): changes that the maker's arguments can't express."""


@dataclass(frozen=True)
class Families:
    """How the plant is made for its families of references."""

    set: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of the plant's maker."""
    adapt: Callable[[Any, jax.Array, int], Any] = lambda params, key, episodes: params
    """`adapt(params, key, episodes) -> params`, each leaf (episodes, ...), such as another start for each episode."""


@dataclass(frozen=True)
class Axis:
    """One parameter of a sweep and its values."""

    name: str
    unit: str
    values: tuple[float, ...]
    nominal: float

    def __post_init__(self) -> None:
        if self.nominal not in self.values:
            raise ValueError(f"axis {self.name!r}: nominal is {self.nominal}; it must be one of {self.values}")

    @classmethod
    def linear(cls, name: str, unit: str, low: float, high: float, count: int, nominal: float) -> Axis:
        """`count` evenly spaced values."""
        return cls(name, unit, tuple(np.linspace(low, high, count).round(6).tolist()), nominal)


@dataclass(frozen=True)
class Sweep:
    """A scenario over a grid of one or two parameters, which the policies do not know."""

    scenario: str
    """Name of the scenario that is varied."""
    axes: tuple[Axis, ...]
    vary: Callable[..., Any] | None = None
    """`vary(params, repeats, *values) -> params`, each leaf (episodes, ...); one array of values (episodes,) per axis.
    None: the axis is the standard deviation of the measurement noise."""
    stride: int = 5
    """Every `stride`-th value makes the coarse grid, used for policies that solve an optimisation at each step."""
    repeats: int = 1
    """Noise seeds per grid point."""


@dataclass(frozen=True)
class Task:
    """A plant's maker with everything specific to the plant. Calling the task makes the plant.

    `FILE.py:NAME` may name a task or a maker. All fields but the maker have defaults.
    """

    make: Callable[..., tuple[Plant, Any]]
    """`make(**parameters) -> plant, params`."""
    presets: Mapping[str, Options] = field(default_factory=dict)
    """Options by preset name; they override the preset of that name in `PRESETS`, or else `default`."""
    scenarios: Mapping[str, Scenario] = field(default_factory=dict)
    """Scenarios by name, in addition to the plant's families of references."""
    reported: tuple[str, ...] = ()
    """Scenarios on which a training is evaluated; empty: all."""
    stability: tuple[str, ...] = ()
    """Scenarios for the local stability analysis, one per plant that differs; empty: the first."""
    families: Families = field(default_factory=Families)
    sweeps: Mapping[str, Sweep] = field(default_factory=dict)
    start: tuple[str, ...] = ()
    """Parameters that set where an episode starts, not what the plant is."""

    def __call__(self, **parameters: Any) -> tuple[Plant, Any]:
        """The plant and its parameters."""
        return self.make(**parameters)

    @property
    def __signature__(self) -> inspect.Signature:
        """Signature of the maker, from which parameter names are read."""
        return inspect.signature(self.make)
