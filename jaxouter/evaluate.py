"""`python -m jaxouter.evaluate`: a trained run, or a baseline, on any evaluation scenario."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import msgspec
import numpy as np
import tyro

from jaxouter import cli, plants
from jaxouter.api import Run, load
from jaxouter.evaluation import jobs, policies, scenarios
from jaxouter.evaluation.baselines import BASELINES
from jaxouter.evaluation.cache import use_compilation_cache
from jaxouter.evaluation.metrics import number
from jaxouter.evaluation.policies import Results, result
from jaxouter.plants.registry import add
from jaxouter.progress import Progress, showing
from jaxouter.training.run import write_json

SHOWN = (
    "mae",
    "improvement",
    "itae",
    "overshoot",
    "settling_time",
    "steady_state_error",
    "violation_time",
    "swing",
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
    set: cli.Settings = ()
    """Parameters of the plant, such as --set tau 0.7 or --set W 0.1 0.003 -0.01, beside those that the run was trained
    on; scenarios keep those they set."""
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
    """Episodes of each scenario; default: its own number."""
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
        options = tyro.cli(Options, prog=cli.program("evaluate"), args=arguments)
        if options.list:
            return cli.print_lists()
        progress = stack.enter_context(showing(True))
        run = check(options)
        use_compilation_cache()
        results, origin = evaluated(options, run, progress), Origin()
        if run is not None and options.policy is None:
            origin = Origin(str(run.path), run.seed, places(run, results))
    name = "learned" if options.policy is None else jobs.short(options.policy)
    show(name, results, origin.places or {})
    if options.json is not None:
        episodes = {scenario: len(found.traces.y) for scenario, found in results.items()}
        found = result(name, results, **origin._asdict(), family_seed=options.family_seed, episodes=episodes)
        write_json(options.json, msgspec.to_builtins(found))
        print(f"figures of merit: {options.json}")
    if options.traces is not None:
        arrays = {f"{name}/{key}": getattr(t, key) for name, (t, _) in results.items() for key in ("r", "y", "r_tilde")}
        with options.traces.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        print(f"traces: {options.traces}")


def check(options: Options) -> Run | None:
    """Everything that can be wrong and found without work; returns the run, if one is named.

    Raises:
        ValueError: the options do not fit together, or name what does not exist.
    """
    if options.run is None and options.policy is None:
        raise ValueError(
            f"say what to evaluate: a run folder, or --policy with FILE.py:CLASS or one of {', '.join(BASELINES)}"
        )
    policies.check(options.episodes, options.family_seed)
    for path in (options.json, options.traces):
        if path is not None and (path.is_dir() or not path.resolve().parent.is_dir()):
            raise ValueError(f"{path} can't be written: it must be a file in a folder that exists")
    if options.run is not None:
        return load(options.run, plant=options.plant, agent=options.agent)
    return None


def evaluated(options: Options, run: Run | None, progress: Progress) -> Results:
    """The policy on the scenarios, of one plant after the other.

    Raises:
        ValueError: there is no such policy, plant or scenario, or the policy failed.
    """
    policy = options.policy or (None if run is None else run.policy)
    assert policy is not None  # as `check` found
    if run is not None:
        names = [run.config.plant]
    elif options.plant is not None:
        names = [add(options.plant)]
    else:
        names = list(dict.fromkeys(name.rpartition("/")[0] for name in options.scenario)) or list(plants.REGISTRY)
    results: Results = {}
    for name in names:
        of_plant = [each for each in options.scenario if len(names) == 1 or each.rpartition("/")[0] == name]
        results |= policies.evaluate(
            policy,
            name,
            of_plant,
            set=cli.settings(options.set),
            episodes=options.episodes,
            family_seed=options.family_seed,
            progress=progress,
        )
    return results


def places(run: Run, results: Results) -> dict[str, str] | None:
    """Where the scenarios' plants lie among those of a training that drew its plants; None: it drew none."""
    if not run.config.ranges:
        return None
    return {name: scenarios.place(scenarios.get(name, 1), *run.drawn) for name in results}


def show(policy: str, results: Results, places: Mapping[str, str]) -> None:
    """Print the table; with where each plant lies among those of the training, where that is known."""
    rows = [
        [name, *filter(None, [places.get(name)])]
        + ["diverged" if figures.diverged else number(getattr(figures, key)) for key in SHOWN]
        for name, (_, figures) in results.items()
    ]
    columns = ["scenario", *(["plant"] if places else []), *(key.replace("_", " ") for key in SHOWN)]
    cli.table(f"policy {policy}", columns, rows)
    if places:
        print("plant: inside, at the edge of, or outside the range of plants trained on")


if __name__ == "__main__":
    cli.run(main)
