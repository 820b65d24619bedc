"""Evaluation of one policy on scenarios, as the commands need it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

from msgspec import Struct

from jaxouter.evaluation.baselines import identified, resolve
from jaxouter.evaluation.baselines.tuning import Report
from jaxouter.evaluation.metrics import FiguresOfMerit, figures_of_merit, mae
from jaxouter.evaluation.rollout import Traces, rollout
from jaxouter.evaluation.scenarios import Scenario
from jaxouter.evaluation.verdict import Verdict
from jaxouter.loop.policy import Policy, none
from jaxouter.plants import Plant, host, make


class ScenarioResult(NamedTuple):
    """What a policy did on one scenario."""

    traces: Traces
    figures: FiguresOfMerit


Results = dict[str, ScenarioResult]  # by the scenario's id


class Evaluation(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Figures of merit of one policy, as in the JSON files; what is None is left out of them."""

    policy: str
    run: str | None = None
    seed: int | None = None  # of the run
    places: dict[str, str] | None = None  # of each scenario's plant among those of the training
    family_seed: int | None = None
    episodes: dict[str, int] | None = None  # by scenario
    scenarios: dict[str, FiguresOfMerit]


class TrainingSummary(Struct, frozen=True, kw_only=True):
    """The content of a run's summary.json."""

    format: int
    median_seed: int  # by the MAE on the first scenario
    training_seconds: float
    steps: int  # environment steps
    identification_steps: int
    updates: int
    places: dict[str, str]  # of each scenario's plant among those of the training
    episodes: dict[str, int]  # by scenario
    verdict: Verdict
    results: list[Evaluation]


@dataclass(frozen=True)
class NamedPolicy:
    """A policy with its parameters and the name that it has in results."""

    name: str
    policy: Policy
    params: Any


def baseline(name: str, plant_name: str, report: Report = lambda text, share: None) -> NamedPolicy:
    """A baseline, identified on the nominal plant unless the cache has it.

    Raises:
        ValueError: unknown name; lists those that exist.
    """
    tuned = identified(name, plant_name, report)
    return NamedPolicy(name, *resolve(name).build(make(plant_name)[0], tuned))


def work(name: str, scenario: Scenario) -> int:
    """Control steps that `evaluate` takes, for the policy of that name and for the inner loop alone."""
    return scenario.r.size * (1 if name == "none" else 2)


def counter(plants: Iterable[Plant]) -> Callable[[], float] | None:
    """Control steps that the simulators of plants outside JAX have made so far; None where there are none."""
    simulators = list(filter(None, map(host.of, plants)))
    return (lambda: sum(each.speed.steps for each in simulators)) if simulators else None


def evaluate(
    named: NamedPolicy,
    scenarios: Iterable[Scenario],
    record_members: bool = False,
    alone: Results | None = None,
    report: Callable[[Scenario], None] = lambda scenario: None,
) -> Results:
    """Traces and figures of merit on each scenario.

    Args:
        named: the policy.
        scenarios: on which.
        record_members: with the single outputs.
        alone: what this gave of `none` on the same scenarios; None: it is run here.
        report: hears of each scenario when it is done.
    """
    results = {}
    for scenario in scenarios:
        traces = rollout(named.policy, named.params, scenario, record_members)
        inner = traces if named.name == "none" else None if alone is None else alone[scenario.id].traces
        inner = rollout(*none(scenario.plant), scenario, record_members) if inner is None else inner
        results[scenario.id] = ScenarioResult(traces, figures_of_merit(traces, scenario, mae(inner)))
        report(scenario)
    return results


def result(named: NamedPolicy, results: Results, **about: Any) -> Evaluation:
    """The evaluation as the JSON files hold it, with further fields of it."""
    figures = {identifier: found.figures for identifier, found in results.items()}
    return Evaluation(policy=named.name, scenarios=figures, **about)
