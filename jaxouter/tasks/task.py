"""What is declared of one plant and of no other: how it is trained on, and where it is evaluated. Plain data."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

from jaxouter.plants import Plant

Options = Mapping[str, Any]
"""Options of `python -m jaxouter.train` by their names, such as `steps` or `pretraining.gradient_steps`."""


@dataclass(frozen=True)
class Scenario:
    """Episodes under one reference, from the plant's own start."""

    reference: Sequence[float]
    """Set-points, each held for an equal part of an episode."""
    set: Mapping[str, Any] = field(default_factory=dict)
    """Parameters of the plant, as its maker takes them; the rest is nominal."""
    change: Mapping[str, Any] = field(default_factory=dict)
    """What changes half way; none if empty."""
    episodes: int = 1
    noise: float = 0.0
    """Standard deviation of the measurement noise, in the unit of y."""
    stable_alone: bool = True
    """Whether the inner loop alone is stable; else an improvement in % means nothing."""
    paper: tuple[float, float] | None = None
    """MAE in the paper: inner loop alone, its DRL."""
    adapt: Callable[[Any], Any] = lambda params: params
    """`adapt(params) -> params` of all episodes, each leaf (episodes, ...): what a maker's arguments can't say."""


@dataclass(frozen=True)
class Families:
    """How the plant is made for the families of references that it declares."""

    set: Mapping[str, Any] = field(default_factory=dict)
    """Parameters of the plant, as its maker takes them."""
    adapt: Callable[[Any, jax.Array, int], Any] = lambda params, key, episodes: params
    """`adapt(params, key, episodes) -> params`, each leaf (episodes, ...), such as a start of its own for each."""


@dataclass(frozen=True)
class Axis:
    """One parameter of a sweep and the values that it takes."""

    name: str
    unit: str
    values: tuple[float, ...]
    nominal: float

    def __post_init__(self) -> None:
        if self.nominal not in self.values:
            raise ValueError(f"axis {self.name!r}: nominal is {self.nominal}; it must be one of {self.values}")

    @classmethod
    def linear(cls, name: str, unit: str, low: float, high: float, count: int, nominal: float) -> Axis:
        """So many values, evenly spaced."""
        return cls(name, unit, tuple(np.linspace(low, high, count).round(6).tolist()), nominal)


@dataclass(frozen=True)
class Sweep:
    """A scenario over a grid of one or two parameters that no policy is told of."""

    scenario: str
    """Name of the scenario whose episodes are varied."""
    axes: tuple[Axis, ...]
    vary: Callable[..., Any] | None = None
    """`vary(params, repeats, *values) -> params`, each leaf (episodes, ...), with a value of each axis (episodes,).
    None: the axis is the standard deviation of the measurement noise."""
    stride: int = 5
    """Of a coarse grid, for policies that solve a programme at each step, every so many-th value is taken."""
    repeats: int = 1
    """Noise seeds a point."""


@dataclass(frozen=True)
class Task:
    """A plant's maker with all that is declared of the plant. Called, it makes the plant.

    A file of one's own may name one in place of a maker: `FILE.py:NAME`. What is not declared has its default, so that
    a maker alone is a task too.
    """

    make: Callable[..., tuple[Plant, Any]]
    """`make(**parameters) -> plant, params`."""
    presets: Mapping[str, Options] = field(default_factory=dict)
    """Options by the preset's name, on top of those of the same name that all plants have, or else of `default`."""
    scenarios: Mapping[str, Scenario] = field(default_factory=dict)
    """By their names, beside the families that the plant declares."""
    reported: tuple[str, ...] = ()
    """Scenarios on which a training is evaluated; none: all."""
    stability: tuple[str, ...] = ()
    """Scenarios that stand for the plants whose local stability differs; none: the first."""
    families: Families = field(default_factory=Families)
    sweeps: Mapping[str, Sweep] = field(default_factory=dict)
    start: tuple[str, ...] = ()
    """Parameters that say where an episode starts, not what the plant is."""

    def __call__(self, **parameters: Any) -> tuple[Plant, Any]:
        """The plant and its parameters."""
        return self.make(**parameters)

    @property
    def __signature__(self) -> inspect.Signature:
        """That of the maker, from which the names of parameters are known."""
        return inspect.signature(self.make)
