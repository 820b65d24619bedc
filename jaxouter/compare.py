"""`python -m jaxouter.compare`: every policy beside its baselines and beside the limit, on every scenario."""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxouter import cli
from jaxouter.api.learning import Stopped, learners
from jaxouter.evaluation import scenarios, statistics
from jaxouter.evaluation.comparison import REPORT, compare
from jaxouter.evaluation.results import Comparison
from jaxouter.plants.base import in_words
from jaxouter.terminal import console
from jaxouter.training.epochs import NotFiniteError


@dataclass(frozen=True)
class Options:
    """Compare policies with their baselines, with the limit and with a lower bound, and write a report.

    Baselines (none, static, lq, lq-return, pi, mpc, deepc, inverse) are identified and tuned on the training
    distribution of the plant, through r~ and y alone. The limit is the least MAE of `oracle`, `lq-exact`, `mpc-exact`,
    which are made from the true plant, `none` and `static`; `clairvoyant` is a lower bound, with preview. Their
    results are computed once and kept in the cache folder; the first time takes minutes.
    """

    plant: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[PLANT]", help_behavior_hint="")] = None
    """pitch, heaters or your own: FILE.py:NAME, gym:ID, fmu:FILE, log:FILE; default: that of the runs, or pitch."""
    agent: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME|FILE.py:CLASS ...", help_behavior_hint="")] = ()
    """Without --run, agents side by side: each first learns from scratch on the static prefilter, unless its run folder
    runs/PLANT-scratch-AGENT exists. With --run, agents of the runs, if your own."""
    seeds: int = 1
    """Seeds of each agent that learns first."""
    steps: Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="")] = None
    """Environment steps of each agent that learns first; default: those of its preset, some 20 to 180 s a seed."""
    run: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="DIR ...", help_behavior_hint="")] = ()
    """Run folders of `jaxouter.train` (all seeds), or folders of one seed."""
    policy: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME|FILE.py:CLASS ...", help_behavior_hint="")] = ()
    """Baselines and limits to compare with; default: all; none always. FILE.py:CLASS is a policy of your own."""
    scenario: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ID ...", help_behavior_hint="")] = ()
    """Scenarios, such as pitch/paper; default: all of the plant; see --list."""
    set: cli.Settings = ()
    """Parameters of the plant, such as --set tau 0.7; scenarios and sweeps keep those they set."""
    sweep: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="NAME ...", help_behavior_hint="")] = None
    """Sweeps, such as pitch/gain; default: all of the plant; without a name: no sweep."""
    family_seed: int = scenarios.FAMILY_SEED
    """Seed of the reference families."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint="")] = None
    """Folder for the results, which must not exist; default: runs/compare-PLANT."""
    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Also show the traceback of an error."""
    list: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print plants, presets, scenarios, sweeps and policies, and end."""


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    begun, arguments = time.perf_counter(), sys.argv[1:] if arguments is None else arguments
    with cli.user_errors(arguments):
        options = tyro.cli(Options, prog=cli.program("compare"), args=arguments)
        if options.list:
            return cli.print_lists()
        content = compare(
            options.plant,
            options.run or learned(options),
            options.policy,
            options.scenario,
            options.sweep,
            set=cli.settings(options.set),
            agents=options.agent,
            family_seed=options.family_seed,
            out=options.out,
            command=shlex.join(["python", "-m", "jaxouter.compare", *arguments]),
        )
    show(content)
    print(f"{time.perf_counter() - begun:.0f} s in all; report {Path(content.folder) / REPORT}")


def learned(options: Options) -> list[Path]:
    """Run folders of the agents that learn first."""
    if not options.agent:
        if options.seeds != 1 or options.steps is not None:
            raise ValueError("--seeds and --steps are of agents that learn first; name them by --agent")
        return []
    plant = options.plant or "pitch"
    try:
        runs = learners(plant, options.agent, options.seeds, options.steps, cli.settings(options.set))
    except (OSError, NotFiniteError) as error:
        raise SystemExit(f"error: {error}") from None
    except Stopped as stopped:
        print(stopped, file=sys.stderr)
        raise SystemExit(130) from None
    return [run.path for run in runs]


def show(content: Comparison) -> None:
    """Print MAE and ratio to the limit, the best of each scenario in bold."""
    best = "[bold]{}[/bold]" if console.is_terminal else "{}*"
    columns, rows = statistics.table(content.rows, content.policies, best)
    cli.table("MAE" + in_words(content.y_unit, " in {}"), columns, rows)
    legend = {
        " (": "In brackets: ratio to the limit, the least MAE of policies made from the true plant.",
        "[bold]": "Bold: best without the model.",
        "*": "*: best without the model.",
        "!": "!: outside the limits of the plant.",
    }
    if notes := [note for sign, note in legend.items() if any(sign in cell for row in rows for cell in row[1:])]:
        print(" ".join(notes))


if __name__ == "__main__":
    cli.run(main)
