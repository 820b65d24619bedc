"""`python -m jaxouter.compare`: every policy beside its baselines and beside the limit, on every scenario."""

from __future__ import annotations

import csv
import datetime
import os
import shlex
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import msgspec
import tyro
from msgspec.structs import replace

from jaxouter import cli, plants
from jaxouter.evaluation import comparison_figures, jobs, pace, report, scenarios, statistics, sweeps
from jaxouter.evaluation.baselines import BUDGET, SIMPLE
from jaxouter.evaluation.comparison import Comparison
from jaxouter.evaluation.jobs import Done, Entrant, Job
from jaxouter.evaluation.metrics import FiguresOfMerit
from jaxouter.plants import Plant, host
from jaxouter.plants.registry import REGISTRATIONS
from jaxouter.progress import Progress
from jaxouter.training.run import add_agent, add_plant, open_run, own_agents, surroundings, write_json

COLUMNS = ("policy", "run", "seed", "scenario", "mae", "ratio_to_limit", "ratio_to_bound", "within_limits")
COLUMNS += ("worse_than_static", *FiguresOfMerit.__struct_encode_fields__[:-1])  # `diverged` only where it is
OVERALL = 3  # figures of all scenarios: errors, effort, stability


@dataclass(frozen=True)
class Options:
    """Compare policies with their baselines, with the limit and with a lower bound, and write a report.

    Baselines (none, static, pi, mpc, deepc, inverse) are identified and tuned on the training distribution of the
    plant, through r~ and y alone; `oracle` is the limit for policies without preview, `clairvoyant` a lower bound
    with preview. Their results are computed once and kept in the cache folder; the first time takes minutes.
    """

    plant: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[PLANT]", help_behavior_hint="")] = None
    """pitch, heaters or your own: FILE.py:NAME, gym:ID, fmu:FILE, log:FILE; default: that of the runs, or pitch."""
    agent: Annotated[tuple[str, ...], tyro.conf.arg(metavar="FILE.py:CLASS ...", help_behavior_hint="")] = ()
    """Agents of the runs, if your own."""
    run: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="DIR ...", help_behavior_hint="")] = ()
    """Run folders of `jaxouter.train` (all seeds), or folders of one seed."""
    policy: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME|FILE.py:CLASS ...", help_behavior_hint="")] = ()
    """Baselines and limits to compare with; default: all; none always. FILE.py:CLASS is a policy of your own."""
    scenario: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ID ...", help_behavior_hint="")] = ()
    """Scenarios, such as pitch/paper; default: all of the plant; see --list."""
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


@dataclass(frozen=True)
class Plan:
    """What the options mean."""

    plant: str
    entrants: tuple[Entrant, ...]
    scenarios: tuple[str, ...]
    sweeps: tuple[str, ...]
    family_seed: int
    out: Path


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    begun = time.perf_counter()
    arguments = sys.argv[1:] if arguments is None else arguments
    with ExitStack() as stack:
        with cli.user_errors(arguments):
            options = tyro.cli(Options, prog="python -m jaxouter.compare", args=arguments)
            if options.list:
                return cli.print_lists()
            plan = check(options)
            cli.use_compilation_cache()
            try:
                plan.out.mkdir(parents=True)
            except OSError as error:
                raise ValueError(f"the folder {plan.out} can't be made: {error.strerror}") from None
            progress = stack.enter_context(cli.progress())
            try:
                done = work(plan, progress)
            except BaseException:
                plan.out.rmdir()  # still empty, and its name is wanted again
                raise
        progress.phase("statistics", 0)
        content = assemble(plan, done, shlex.join(["python", "-m", "jaxouter.compare", *arguments]), begun)
        show(content)
        page = write(plan, content, done, progress)
    print(f"{time.perf_counter() - begun:.0f} s in all; report {page}")


def check(options: Options) -> Plan:
    """Everything that can be wrong and found without work.

    Raises:
        ValueError: the options do not fit together, or name what does not exist.
    """
    for reference in options.agent:
        add_agent(reference)
    named_plant = None if options.plant is None else add_plant(options.plant, *options.run[:1] or (None,))
    runs = [open_run(path) for path in options.run]
    plant = named_plant or (runs[0][0].config.plant if runs else "pitch")
    for path, (run, _, _) in zip(options.run, runs, strict=True):
        if run.config.plant != plant:
            raise ValueError(f"{path} is a run on {run.config.plant}; the comparison is on {plant}")
    for name in options.scenario:
        scenarios.builder(name)
    for name in options.sweep or ():
        sweeps.builder(name)
    foreign = [name for name in (*options.scenario, *(options.sweep or ())) if name.split("/")[0] != plant]
    if foreign:
        raise ValueError(f"the comparison is on {plant}; {foreign[0]} is another plant's")
    if not 0 <= options.family_seed < 2**32:
        raise ValueError(f"--family-seed is {options.family_seed}; it must lie in [0, 2^32)")
    entrants = [
        Entrant("learned", "learned", str(run.path), seed)
        for run, median, chosen in runs
        for seed in (chosen if len(chosen) == 1 else sorted(chosen, key=lambda seed: seed != median))
    ]
    entrants = list(dict.fromkeys([*entrants, *named(options.policy, plants.make(plant)[0])]))
    for entrant in entrants:
        if entrant.kind in ("learned", "user"):
            jobs.load(entrant, plant)  # what can't be loaded is said before minutes of tuning
    return Plan(
        plant,
        tuple(entrants),
        tuple(dict.fromkeys(options.scenario or scenarios.catalogue(plant))),
        tuple(dict.fromkeys(sweeps.catalogue(plant) if options.sweep is None else options.sweep)),
        options.family_seed,
        folder(options.out, plant),
    )


def named(names: Sequence[str], plant: Plant) -> list[Entrant]:
    """The policies with these names, and a user's own; where no name is given, all that the plant allows.

    Raises:
        ValueError: there is no such policy or file, or the plant does not allow it.
    """
    own, built_in = [], []
    for name in dict.fromkeys(names):
        found = jobs.entrant(name, plant)
        if jobs.is_own(name):
            same = found.kind == "user" and any(
                found.name == other.name for other in own
            )  # of several files with this name
            own.append(found._replace(name=name) if same else found)
        else:
            built_in.append(name)
    chosen = [name for name in jobs.possible(plant) if name == "none" or not built_in or name in built_in]
    return own + [jobs.entrant(name, plant) for name in chosen]


def folder(out: Path | None, plant: str) -> Path:
    """The folder to write to; by default runs/compare-PLANT, with -2, -3, ... where that exists.

    Raises:
        ValueError: `out` exists.
    """
    if out is not None:
        if out.exists():
            raise ValueError(f"{out} exists; choose another --out")
        return out
    base = Path("runs") / f"compare-{plant}"
    return next(p for p in (base, *(base.with_name(f"{base.name}-{i}") for i in range(2, 10_000))) if not p.exists())


def told(plan: Plan) -> str | None:
    """How long a plant outside JAX is going to take, where that is long."""
    each = host.step_seconds(plants.make(plan.plant)[0])
    if each is None:
        return None
    tuned = [c for c in plan.entrants if c.kind == "baseline" and c.name not in SIMPLE]
    seconds = each * BUDGET * len(tuned) + pace.seconds(plan.scenarios, None, len(plan.entrants))
    seconds /= min(os.cpu_count() or 1, len(plan.entrants))
    if seconds < pace.SAID:
        return None
    return (
        f"the plant takes {1e3 * each:.2g} ms a control step: up to {pace.duration(seconds)}, where nothing of it is "
        "in the cache; --policy and --scenario take fewer"
    )


def work(plan: Plan, progress: Progress) -> list[Done]:
    """All jobs done, in their order, with progress."""
    if (text := told(plan)) is not None:
        print(text, flush=True)
    every = jobs.jobs(plan.plant, plan.entrants, plan.scenarios, plan.sweeps, plan.family_seed)
    done: dict[Job, Done] = {}
    shares: dict[Job, float] = {}  # of each that has begun
    progress.phase("comparing", sum(job.work for job in every))

    def heard(job: Job, text: str, share: float) -> None:
        shares[job] = share
        progress.reach(
            sum(share * job.work for job, share in shares.items()),
            count=f"{len(done)} of {len(every)} jobs",
            job=f"{job}: {text}" if text else str(job),
        )

    for finished in jobs.spread(every, partial(cli.use_own, tuple(REGISTRATIONS.values()), own_agents()), heard):
        done[finished.job] = finished
        heard(finished.job, f"{finished.seconds:.0f} s", 1.0)
    return [done[job] for job in every]


def assemble(plan: Plan, done: Sequence[Done], command: str, begun: float) -> Comparison:
    """What the jobs gave, with its statistics.

    Args:
        plan, done: what was asked for, and all of it done.
        command: of the user.
        begun: when, of `time.perf_counter`.
    """
    known = jobs.policies(plan.entrants, done)
    rows = statistics.ranks(jobs.rows(done), known)
    label = {(line.policy, line.run): line.label for line in statistics.lines(rows, known)}
    plant, _ = plants.make(plan.plant)
    swept = jobs.swept(done, plan.sweeps, label)
    return Comparison(
        plant=plan.plant,
        y_unit=plant.y_unit,
        time_unit=plant.time_unit,
        family_seed=plan.family_seed,
        date=datetime.date.today().isoformat(),
        machine=surroundings(),
        policies=known,
        rows=rows,
        statistics=statistics.summarise(rows, known),
        sweeps={
            name: replace(sweep, best_baseline=statistics.best_baseline(sweep, known)) for name, sweep in swept.items()
        },
        stability=jobs.stabilities(done, label),
        seconds=time.perf_counter() - begun,
        command=command,
    )


def write(plan: Plan, content: Comparison, done: Sequence[Done], progress: Progress) -> Path:
    """comparison.json, comparison.csv, figures and the report; returns the report's path."""
    values = msgspec.to_builtins(content, enc_hook=float)  # a user's settings may hold numbers of NumPy
    write_json(plan.out / "comparison.json", values)
    with (plan.out / "comparison.csv").open("w", newline="", encoding="utf-8") as file:
        keys = (key for row in values["rows"] for key in row)
        table = csv.DictWriter(file, list(dict.fromkeys([*COLUMNS, *keys])))
        table.writeheader()
        table.writerows(values["rows"])
    figures: dict[str, Path] = {}
    responses: dict[str, Path] = {}
    lines = statistics.lines(content.rows, content.policies)
    label = {(line.policy, line.run): line.label for line in lines}
    overall = OVERALL + len(plan.sweeps)
    progress.phase("drawing", overall + len(plan.scenarios))
    with cli.optional("figures"):
        figures |= comparison_figures.draw(plan.out / "figures", content)
        progress.advance(overall)
        for name in plan.scenarios:
            traces = {label[c.line]: t for c, t in jobs.first_episodes(done, name).items()}
            traces = {line.label: traces[line.label] for line in lines}
            path = plan.out / "figures" / f"{name.replace('/', '-')}.png"
            scenario = scenarios.get(name, family_seed=plan.family_seed)
            responses[name] = comparison_figures.responses(path, scenario, traces, [line.label for line in lines])
            progress.advance()
    return report.write(plan.out / "report.html", content, figures, responses)


def show(content: Comparison) -> None:
    """Print MAE and ratio to the limit, the best of each scenario in bold."""
    best = "[bold]{}[/bold]" if cli.console.is_terminal else "{}*"
    columns, rows = statistics.table(content.rows, content.policies, best)
    cli.table(f"MAE, {content.y_unit}", columns, rows)
    legend = {
        " (": "In brackets: ratio to the limit (oracle).",
        "[bold]": "Bold: best without the model.",
        "*": "*: best without the model.",
        "!": "!: outside the limits of the plant.",
    }
    if notes := [note for sign, note in legend.items() if any(sign in cell for row in rows for cell in row[1:])]:
        print(" ".join(notes))


if __name__ == "__main__":
    cli.run(main)
