"""Evaluation of one policy on scenarios."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
from msgspec import Struct

from jaxouter.evaluation import baselines, jobs, pace, scenarios
from jaxouter.evaluation.baselines import CLAIRVOYANT, identified, resolve
from jaxouter.evaluation.baselines.tuning import Report
from jaxouter.evaluation.metrics import FiguresOfMerit, figures_of_merit, mae
from jaxouter.evaluation.rollout import Traces, rollout
from jaxouter.evaluation.scenarios import FAMILY_SEED, Known, Scenario
from jaxouter.evaluation.verdict import Verdict
from jaxouter.loop.policy import Policy, none
from jaxouter.plants import Plant, host, make
from jaxouter.plants.registry import Maker, add, own_errors
from jaxouter.progress import Progress, showing


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
    trained_return: dict[str, float | None] | None = None  # by scenario, of the reward that was trained on
    scenarios: dict[str, FiguresOfMerit]


class TrainedReward(Struct, frozen=True):
    """What was trained on beside what is reported: `return` among the figures of merit is of the latter."""

    trained: dict[str, float | None]  # weights; None is the plant's own
    terms: list[str]  # of the plant, added in training
    reported: dict[str, float | None]  # the paper's weights


class TrainingSummary(Struct, frozen=True, kw_only=True):
    """The content of a run's summary.json."""

    format: int
    median_seed: int  # by the MAE on the first scenario
    training_seconds: float
    steps: int  # environment steps
    identification_steps: int
    updates: int
    reward: TrainedReward
    places: dict[str, str]  # of each scenario's plant among those of the training
    episodes: dict[str, int]  # by scenario
    verdict: Verdict
    results: list[Evaluation]


@dataclass(frozen=True, repr=False)
class NamedPolicy:
    """A policy with its parameters and the name that it has in results."""

    name: str
    policy: Policy
    params: Any
    plant: str
    """Name of the plant that it was made for."""

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name} for {self.plant}>"

    def init(self, r0: Any, y0: Any) -> Any:
        """Carry before the first step, from the first reference and output."""
        return self.policy.init(self.params, *self._given(r0, y0))

    def act(self, carry: Any, r: Any, y: Any) -> tuple[Any, Any]:
        """At t_k, from r_k and y_k: the next carry and r~_k, without exploration."""
        return self.policy.act(self.params, carry, *self._given(r, y))

    def _given(self, *signals: Any) -> Any:
        """Signals as the policy takes them."""
        return signals if self.policy.host else (jnp.asarray(each, float) for each in signals)


def baseline(name: str, of: str | Known, report: Report = lambda text, share: None) -> NamedPolicy:
    """A baseline, identified on a plant unless the cache has it.

    Raises:
        ValueError: unknown name; lists those that exist.
    """
    of = Known(of) if isinstance(of, str) else of
    return NamedPolicy(name, *resolve(name).build(make(of.plant)[0], identified(name, of, report)), of.plant)


def named(policy: NamedPolicy | Policy | str, of: Known, progress: Progress) -> NamedPolicy:
    """The policy for a plant; a baseline is identified unless the cache has it, which is told.

    Raises:
        ValueError: there is no such policy, the plant does not allow it, or it can't be made.
    """
    plant = of.plant
    if isinstance(policy, NamedPolicy):
        return policy
    if not isinstance(policy, str):
        return NamedPolicy(type(policy).__name__, policy, getattr(policy, "params", ()), plant)
    if policy == CLAIRVOYANT:
        raise ValueError(f"{CLAIRVOYANT} is a bound, not a policy; python -m jaxouter.compare shows it")
    found = jobs.entrant(policy, make(plant)[0])
    if found.kind == "user":
        return NamedPolicy(found.name, *jobs.load(found, of), plant)

    def heard(text: str, share: float) -> None:
        if not text:
            note = baselines.resolve(policy).note
            noisy = f" with sensor noise of {of.noise:g}" if of.noise else ""
            progress.print(f"{policy} on {plant}{noisy}: {note} This is done once, and kept.")
        elif share and not progress.done:
            progress.phase(f"tuning {policy}")
        progress.reach(share, at=text)

    progress.phase(f"identifying {policy}", 1.0)
    return baseline(policy, of, heard)


def evaluate(
    policy: NamedPolicy | Policy | str,
    plant: str | Maker | None = None,
    scenario: str | Sequence[str] = (),
    *,
    set: Mapping[str, Any] | None = None,
    episodes: int | None = None,
    family_seed: int = FAMILY_SEED,
    progress: bool | Progress = True,
) -> Results:
    """Evaluate a policy on scenarios that training never saw.

    For example: `evaluate("pi", "pitch", "paper")["pitch/paper"].figures.mae`.

    Args:
        policy: that of a run, a baseline's name, `FILE.py:CLASS`, or an object that follows `Policy` (its parameters
            are its attribute `params`, if it has any).
        plant: as a command names it, such as `pitch` or `FILE.py:NAME`; None: the one that the policy was made for.
        scenario: ids, such as `pitch/paper` or `paper`; empty: all of the plant.
        set: parameters of the plant; scenarios that set one themselves keep theirs.
        episodes: of each scenario; None: its own number.
        family_seed: of the families of references.
        progress: whether to show progress.

    Returns:
        Traces and figures of merit by scenario id.

    Raises:
        ValueError: there is no such policy, plant or scenario, or the policy failed.
    """
    check(episodes, family_seed)
    with own_errors(), showing(progress) as progress:
        default = policy.plant if isinstance(policy, NamedPolicy) else "pitch"
        plant = add(plant or default, parameters=set)
        names = scenarios.identifiers(plant, several(scenario))
        limit = isinstance(policy, str) and policy in baselines.LIMITS  # which is made for the plant of each scenario
        chosen = named(policy, scenarios.known(names[0]) if limit else Known(plant), progress)
        rollouts = 1 if chosen.name == "none" else 2
        if pace.seconds(names, episodes, rollouts) > pace.SAID:
            progress.print(f"{pace.told(names, episodes, rollouts)}; --episodes N is N of each")
        selected = [scenarios.get(name, episodes, family_seed) for name in names]
        total = sum(work(chosen.name, each) for each in selected)
        progress.phase("evaluating", total, counter=counter(each.plant for each in selected))
        own = jobs.is_own(policy) if isinstance(policy, str) else not isinstance(policy, NamedPolicy)
        results: Results = {}
        for i, each in enumerate(selected):
            progress.say(scenario=f"{each.id}, {i + 1} of {len(selected)} scenarios")
            acting = named(policy, scenarios.known(each.id), progress) if limit else chosen
            with jobs.blamed(chosen.name, f"failed on {each.id}", own):
                results |= evaluate_on(acting, [each])
            progress.advance(work(chosen.name, each))
    return results


def several(given: Any) -> tuple[Any, ...]:
    """What is given, one text or path or many of them, as a tuple."""
    return (given,) if isinstance(given, str | Path) else tuple(given)


def check(episodes: int | None, family_seed: int) -> None:
    """Raises ValueError if there is no such number of episodes or seed."""
    if episodes is not None and episodes < 1:
        raise ValueError(f"--episodes is {episodes}; it must be at least 1")
    if not 0 <= family_seed < 2**32:
        raise ValueError(f"--family-seed is {family_seed}; it must lie in [0, 2^32)")


def work(name: str, scenario: Scenario) -> int:
    """Control steps that `evaluate_on` takes, for the policy of that name and for the inner loop alone."""
    return scenario.r.size * (1 if name == "none" else 2)


def counter(plants: Iterable[Plant]) -> Callable[[], float] | None:
    """Control steps that the simulators of plants outside JAX have made so far; None where there are none."""
    simulators = list(filter(None, map(host.of, plants)))
    return (lambda: sum(each.speed.steps for each in simulators)) if simulators else None


def evaluate_on(
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


def result(policy: str, results: Results, **about: Any) -> Evaluation:
    """The evaluation as the JSON files hold it, with further fields of it."""
    figures = {identifier: found.figures for identifier, found in results.items()}
    return Evaluation(policy=policy, scenarios=figures, **about)
