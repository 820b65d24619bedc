"""Evaluation of one policy on scenarios, as the commands need it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from jaxouter.evaluation.baselines import identified, resolve
from jaxouter.evaluation.baselines.tuning import Report
from jaxouter.evaluation.metrics import figures_of_merit, mae
from jaxouter.evaluation.rollout import Traces, rollout
from jaxouter.evaluation.scenarios import Scenario
from jaxouter.loop.policy import Policy, none
from jaxouter.plants import Plant, host, make

Results = dict[str, tuple[Traces, dict[str, Any]]]  # by the scenario's id


@dataclass(frozen=True)
class Named:
    """A policy with its parameters and the name that it has in results."""

    name: str
    policy: Policy
    params: Any


def baseline(name: str, plant_name: str, report: Report = lambda text, share: None) -> Named:
    """A baseline, identified on the nominal plant unless the cache has it.

    Raises:
        ValueError: unknown name; lists those that exist.
    """
    tuned = identified(name, plant_name, report)
    return Named(name, *resolve(name).build(make(plant_name)[0], tuned))


def work(name: str, scenario: Scenario) -> int:
    """Control steps that `evaluate` takes, for the policy of that name and for the inner loop alone."""
    return scenario.r.size * (1 if name == "none" else 2)


def counter(plants: Iterable[Plant]) -> Callable[[], float] | None:
    """Control steps that the simulators of plants outside JAX have made so far; None where there are none."""
    simulators = list(filter(None, map(host.of, plants)))
    return (lambda: sum(each.speed.steps for each in simulators)) if simulators else None


def evaluate(
    named: Named,
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
        inner = traces if named.name == "none" else None if alone is None else alone[scenario.id][0]
        inner = rollout(*none(scenario.plant), scenario, record_members) if inner is None else inner
        results[scenario.id] = traces, figures_of_merit(traces, scenario, mae(inner))
        report(scenario)
    return results


def result(named: Named, results: Results, **extra: Any) -> dict[str, Any]:
    """The evaluation as JSON values."""
    scenarios = {identifier: figures for identifier, (_, figures) in results.items()}
    return {"policy": named.name, **extra, "scenarios": scenarios}
