"""Evaluation of one policy on scenarios, as the commands need it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from jaxouter.evaluation.metrics import figures_of_merit, mae
from jaxouter.evaluation.rivals import RIVALS, identified
from jaxouter.evaluation.rollout import Traces, rollout
from jaxouter.evaluation.scenarios import Scenario
from jaxouter.loop.policy import Policy, none
from jaxouter.plants import make

Results = dict[str, tuple[Traces, dict[str, Any]]]  # by the scenario's id


@dataclass(frozen=True)
class Named:
    """A policy with its parameters and the name that it has in results."""

    name: str
    policy: Policy
    params: Any


def rival(name: str, plant_name: str) -> Named:
    """A rival, identified on the nominal plant unless the cache has it.

    Raises:
        ValueError: unknown name; lists those that exist.
    """
    tuned = identified(name, plant_name)
    return Named(name, *RIVALS[name].build(make(plant_name)[0], tuned))


def evaluate(
    named: Named, scenarios: Iterable[Scenario], record_members: bool = False, alone: Results | None = None
) -> Results:
    """Traces and figures of merit on each scenario.

    Args:
        named: the policy.
        scenarios: on which.
        record_members: with the single outputs.
        alone: what this gave of `none` on the same scenarios; None: it is run here.
    """
    results = {}
    for scenario in scenarios:
        traces = rollout(named.policy, named.params, scenario, record_members)
        inner = traces if named.name == "none" else None if alone is None else alone[scenario.id][0]
        inner = rollout(*none(scenario.plant), scenario, record_members) if inner is None else inner
        results[scenario.id] = traces, figures_of_merit(traces, scenario, mae(inner))
    return results


def result(named: Named, results: Results, **extra: Any) -> dict[str, Any]:
    """The evaluation as JSON values."""
    scenarios = {identifier: figures for identifier, (_, figures) in results.items()}
    return {"policy": named.name, **extra, "scenarios": scenarios}
