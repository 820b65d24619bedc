"""`python -m jaxouter.evaluate`: a trained run, or a baseline, on any evaluation scenario."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import msgspec
import numpy as np
import tyro

from jaxouter import cli, plants
from jaxouter.evaluation import baselines, jobs, pace, scenarios
from jaxouter.evaluation.baselines import BASELINES, CLAIRVOYANT
from jaxouter.evaluation.policies import NamedPolicy, Results, baseline, counter, evaluate, result, work
from jaxouter.progress import Progress
from jaxouter.training.run import add_agent, add_plant, open_run, write_json

SHOWN = (
    "mae",
    "improvement",
    "itae",
    "overshoot",
    "settling_time",
    "steady_state_error",
    "violation_time",
    "r_tilde_tv",
)


@dataclass(frozen=True)
class Options:
    """Evaluate a trained run, or a baseline, on scenarios that training never saw.

    With a run folder the learned policy of its median seed is evaluated; a folder seed-N in it names another seed.
    Without `--scenario` all scenarios of the plant are run, without a folder those of every plant.
    """

    run: Annotated[Path | None, tyro.conf.Positional] = None
    """Run folder, or the folder of one seed in it."""
    plant: str | None = None
    """The run's plant, if your own: FILE.py:NAME, gym:ID, fmu:FILE, log:FILE; without a run, that of the policy."""
    agent: str | None = None
    """The run's agent, if your own: FILE.py:CLASS."""
    policy: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE.py:CLASS")] = None
    """A baseline instead, such as none (r~ = r) or static (inverse of the DC gain), identified once and kept; or your
    own policy."""
    scenario: tuple[str, ...] = ()
    """Scenarios, such as pitch/paper; see --list."""
    episodes: int | None = None
    """Episodes of each scenario; default: its own number (families 64, heaters 32)."""
    family_seed: int = scenarios.FAMILY_SEED
    """Seed of the reference families."""
    json: Path | None = None
    """Write all figures of merit to this file."""
    traces: Path | None = None
    """Write r, y and r~ of each scenario, (episodes, T) each, to this npz file."""
    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Also show the traceback of an error."""
    list: bool = False
    """Print plants, presets, scenarios and policies, and end."""


class Origin(NamedTuple):
    """Where a policy comes from; all None unless from a run."""

    run: str | None = None
    seed: int | None = None
    places: dict[str, str] | None = None  # of each scenario's plant among those of the training


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    with cli.user_errors(arguments), ExitStack() as stack:
        options = tyro.cli(Options, prog="python -m jaxouter.evaluate", args=arguments)
        if options.list:
            return cli.print_lists()
        add_agent(options.agent)
        if options.plant is not None:
            options = replace(options, plant=add_plant(options.plant, options.run))
        check(options)
        progress = stack.enter_context(cli.progress())
        progress.phase("preparing")
        cli.use_compilation_cache()
        policies, origin = choose(options, progress)
        names = options.scenario or [name for plant in policies for name in scenarios.catalogue(plant)]
        foreign = [name for name in names if name.split("/")[0] not in policies]
        if foreign:
            raise ValueError(f"{options.run} is a run on {next(iter(policies))}; {foreign[0]} is another plant's")
        rollouts = 1 if options.policy == "none" else 2
        if pace.seconds(names, options.episodes, rollouts) > pace.SAID:
            progress.print(f"{pace.told(names, options.episodes, rollouts)}; --episodes N is N of each")
        selected = [scenarios.get(name, options.episodes, options.family_seed) for name in names]
        results = evaluated(policies, selected, options.policy, progress)
    named = next(iter(policies.values()))
    show(named.name, results, origin.places or {})
    if options.json is not None:
        episodes = {name: len(traces.y) for name, (traces, _) in results.items()}
        found = result(named, results, **origin._asdict(), family_seed=options.family_seed, episodes=episodes)
        write_json(options.json, msgspec.to_builtins(found))
        print(f"figures of merit: {options.json}")
    if options.traces is not None:
        arrays = {f"{name}/{key}": getattr(t, key) for name, (t, _) in results.items() for key in ("r", "y", "r_tilde")}
        with options.traces.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        print(f"traces: {options.traces}")


def check(options: Options) -> None:
    """Everything that can be wrong and found without work.

    Raises:
        ValueError: the options do not fit together, or name what does not exist.
    """
    if options.run is None and options.policy is None:
        raise ValueError(
            f"say what to evaluate: a run folder, or --policy with FILE.py:CLASS or one of {', '.join(BASELINES)}"
        )
    if options.policy == CLAIRVOYANT:
        raise ValueError(f"{CLAIRVOYANT} is a bound, not a policy; python -m jaxouter.compare shows it")
    if options.episodes is not None and options.episodes < 1:
        raise ValueError(f"--episodes is {options.episodes}; it must be at least 1")
    if not 0 <= options.family_seed < 2**32:
        raise ValueError(f"--family-seed is {options.family_seed}; it must lie in [0, 2^32)")
    for path in (options.json, options.traces):
        if path is not None and (path.is_dir() or not path.resolve().parent.is_dir()):
            raise ValueError(f"{path} can't be written: it must be a file in a folder that exists")
    for name in options.scenario:
        scenarios.builder(name)


def choose(options: Options, progress: Progress) -> tuple[dict[str, NamedPolicy], Origin]:
    """The policy for each plant, and where it comes from.

    Raises:
        ValueError: the folder is no run, or has no checkpoint.
    """
    if options.policy is not None:
        every = set(plants.REGISTRY) if options.plant is None else {options.plant}
        given = {name.split("/")[0] for name in options.scenario} or every
        names = sorted(given) if options.run is None else [open_run(options.run)[0].config.plant]
        return {name: chosen(options.policy, name, progress) for name in names}, Origin()
    assert options.run is not None  # as `check` found
    run, seed, _ = open_run(options.run)
    named = NamedPolicy("learned", *run.policy(seed))
    places = None
    if run.config.randomise:
        selected = [scenarios.get(name, 1) for name in scenarios.catalogue(run.config.plant)]
        places = {scenario.id: scenarios.place(scenario, *run.drawn) for scenario in selected}
    return {run.config.plant: named}, Origin(str(run.path), seed, places)


def chosen(policy: str, plant_name: str, progress: Progress) -> NamedPolicy:
    """The user's own policy, or a baseline, which is identified unless the cache has it; that is told.

    Raises:
        ValueError: there is no such policy, the plant does not allow it, or it can't be made.
    """
    found = jobs.entrant(policy, plants.make(plant_name)[0])
    if found.kind == "user":
        return NamedPolicy(found.name, *jobs.load(found, plant_name))

    def heard(text: str, share: float) -> None:
        if not text:
            note = baselines.resolve(policy).note
            progress.print(f"{policy} on {plant_name}: {note} This is done once, and kept.")
        elif share and not progress.done:
            progress.phase(f"tuning {policy}")
        progress.reach(share, at=text)

    progress.phase(f"identifying {policy}", 1.0)
    return baseline(policy, plant_name, heard)


def evaluated(
    policies: Mapping[str, NamedPolicy], selected: Sequence[scenarios.Scenario], asked: str | None, progress: Progress
) -> Results:
    """The policy of each plant on its scenarios.

    Raises:
        ValueError: a user's policy, `asked` for on the command line, failed.
    """
    pairs = [(policies[scenario.plant.name], scenario) for scenario in selected]
    plants_selected = {scenario.plant.name: scenario.plant for scenario in selected}.values()
    total = sum(work(named.name, scenario) for named, scenario in pairs)
    progress.phase("evaluating", total, counter=counter(plants_selected))
    results: Results = {}
    for i, (named, scenario) in enumerate(pairs):
        progress.say(scenario=f"{scenario.id}, {i + 1} of {len(selected)} scenarios")
        with jobs.blamed(named.name, f"failed on {scenario.id}", jobs.is_own(asked)):
            results |= evaluate(named, [scenario])
        progress.advance(work(named.name, scenario))
    return results


def show(policy: str, results: Results, places: Mapping[str, str]) -> None:
    """Print the table; with where each plant lies among those of the training, where that is known."""
    rows = [
        [name, *filter(None, [places.get(name)])]
        + ["diverged" if figures.diverged else cli.number(getattr(figures, key)) for key in SHOWN]
        for name, (_, figures) in results.items()
    ]
    columns = ["scenario", *(["plant"] if places else []), *(key.replace("_", " ") for key in SHOWN)]
    cli.table(f"policy {policy}", columns, rows)
    if places:
        print("plant: where it lies among those of the training")


if __name__ == "__main__":
    cli.run(main)
