"""The content of comparison.json."""

from __future__ import annotations

from typing import Any

import numpy as np
from msgspec import Struct

from jaxouter.evaluation.baselines import Kind
from jaxouter.evaluation.metrics import FiguresOfMerit
from jaxouter.evaluation.stability import LocalStability
from jaxouter.tasks import Axis

FORMAT = 1
Interval = tuple[float, float]  # lowest and highest value


class PolicyInfo(Struct, frozen=True):
    """What a policy is, and what its identification and tuning took."""

    kind: Kind
    steps: int | None = None  # environment steps
    seconds: float | None = None
    settings: dict[str, Any] = {}
    note: str = ""


class Row(FiguresOfMerit, frozen=True):
    """One policy, or one seed of a run, on one scenario."""

    policy: str
    run: str | None  # folder
    seed: int | None
    scenario: str
    ratio_to_limit: float | None  # MAE over the limit
    ratio_to_bound: float | None  # MAE over that of the policy with preview
    within_limits: bool
    worse_than_static: float | None  # share of the episodes whose MAE is above that of `static`
    rank: int | None = None  # by MAE on the scenario; None where not ranked
    best: bool = False  # whether the rank is 1


class GridErrors(Struct, frozen=True):
    """MAE of one policy over the grid of a sweep."""

    values: list[list[float]]  # of the parameters, a list an axis
    mae: list[Any]  # a nested list an axis; None where diverged

    @property
    def grid(self) -> np.ndarray:
        """MAE, of the grid's shape; nan where diverged."""
        return np.array(self.mae, float)


class BestBaseline(GridErrors, frozen=True):
    """The least MAE of all baselines over the points of a sweep that they have in common."""

    policy: list[Any]  # that has it, nested as the MAE; None where every baseline diverged


class SweepErrors(Struct, frozen=True):
    """A sweep under every policy."""

    axes: tuple[Axis, ...]  # one or two
    policies: dict[str, GridErrors]  # by label
    best_baseline: BestBaseline | None = None


class StabilityRow(LocalStability, frozen=True, kw_only=True):
    """Local stability of one policy on the plant of one scenario, at one set-point."""

    policy: str  # label
    scenario: str


class Location(Struct, frozen=True):
    """Median and interquartile mean over seeds, with 95 % intervals; None where missing or infinite."""

    median: float | None = None
    median_interval: Interval | None = None
    iqm: float | None = None
    iqm_interval: Interval | None = None


class Improvement(Struct, frozen=True):
    """Probability that a seed of one line has a lower error than one of another."""

    probability: float
    interval: Interval | None  # 95 %; None where both have one seed


class LineSummary(Struct, frozen=True):
    """What is said of one line over seeds; of its ranks None where it is not ranked at all."""

    policy: str
    run: str | None
    kind: Kind
    seeds: int
    mean_rank: float | None  # over all scenarios; without a rank it counts as the last
    first: int | None  # scenarios in which it has rank 1
    unranked: int | None  # scenarios in which it has no rank
    scenarios: dict[str, Location]  # of the MAE's ratio to the limit, by scenario
    mean: Location  # over the scenarios with a limit


class Summary(Struct, frozen=True):
    """Everything that is said over seeds."""

    scenarios: list[str]  # those with a limit
    lines: dict[str, LineSummary]  # by label
    improvement: dict[str, dict[str, Improvement]]  # of each learned line over each baseline or user's line


class Comparison(Struct, frozen=True, kw_only=True):
    """A comparison of policies on one plant."""

    format: int = FORMAT
    plant: str
    y_unit: str
    time_unit: str
    family_seed: int
    date: str  # ISO
    machine: dict[str, Any]
    policies: dict[str, PolicyInfo]
    rows: list[Row]
    statistics: Summary
    sweeps: dict[str, SweepErrors]
    stability: list[StabilityRow]
    seconds: float
    command: str
    folder: str  # of the report

    def __repr__(self) -> str:
        return f"<Comparison of {', '.join(self.policies)} on {self.plant}: {self.folder}>"
